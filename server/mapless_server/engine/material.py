"""What attempts of one basis are computed from: features of the photograph, its references, and their matches."""

from dataclasses import dataclass, replace

from mapless_server.method.features.views import Matches, PosedView, View
from mapless_server.method.judge.attempt import Attempt
from mapless_server.method.rejection import PoseHypothesis
from mapless_server.scenes import Choice

from .photos import QueryViews


@dataclass(frozen=True, eq=False)
class Material:
    """A photograph and its references, described with the same features.

    Attributes:
        basis: the basis of the attempts that it serves.
        views: the photograph in their raster.
        view: its features.
        references: the references that are used, in order.
        generation: generation of the scene when they were read.
        choice: how they were chosen; None if the caller named them.
        query_matches: matches of the photograph with each reference, if they were chosen by these.
        is_strong: whether these are to be those of a network, as far as nearest neighbours find few.
        unmatched: indices of the references that the network has still to match, each in a step of its own, so that a
            busy server computes for other callers in between.
    """

    basis: Attempt
    views: QueryViews
    view: View
    references: tuple[PosedView, ...]
    generation: int
    choice: Choice | None = None
    query_matches: tuple[Matches, ...] | None = None
    is_strong: bool = False
    unmatched: tuple[int, ...] = ()

    def serves(self, attempt: Attempt) -> bool:
        """Whether an attempt is computed from it."""
        return attempt.basis == self.basis and attempt.matching.is_strong == self.is_strong

    @property
    def is_searched(self) -> bool:
        """Whether the scene has references to choose from."""
        return self.choice is not None and bool(self.choice.descriptor)

    @property
    def missing(self) -> str:
        """Says why there are no references."""
        if self.choice is not None and self.choice.references:
            return "what is stored of the references that resemble the photograph is damaged"
        return "no reference is where the prior says" if self.is_searched else "the scene has no references"

    def of_place(self, place: PoseHypothesis, basis: Attempt) -> "Material":
        """The same with the references of one place alone."""
        kept = [i for i, it in enumerate(self.references) if it.name in place.references]
        matches = None if self.query_matches is None else tuple(self.query_matches[i] for i in kept)
        references = tuple(self.references[i] for i in kept)
        return replace(self, basis=basis, references=references, query_matches=matches, is_strong=False, unmatched=())
