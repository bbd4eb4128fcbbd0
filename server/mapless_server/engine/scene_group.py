"""The scenes of a query among several, and the order in which its photograph is looked for in them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mapless_server.method.judge.decide import PLACES
from mapless_server.method.judge.hypothesis import Attempt, Where
from mapless_server.method.promise import PROMISE

from .query import Query, SceneQuestion, SceneTried

if TYPE_CHECKING:
    from mapless_server.method.features.views import View
    from mapless_server.method.pairs.correspond import Compared

    from .photo_views import QueryViews

SCENES = 2
"""A photograph is looked for in so many scenes. Evidence: scenes-tried."""


@dataclass(frozen=True, eq=False)
class RankedScene:
    """A scene of those whose references resemble a photograph most.

    Attributes:
        question: the scene, and what the priors say in it.
        reference_count, similarity, match_count: as of `SceneTried`.
        agreement: the largest that the photograph's matches with them show, see `choosing.agreement_of`; 0 where no
            other scene had any.
        agreeing_count: most matches with one of them that agree with one another.
    """

    question: SceneQuestion
    reference_count: int
    similarity: float
    match_count: int = 0
    agreement: float = 0.0
    agreeing_count: int = 0

    def may_rival(self, other: RankedScene) -> bool:
        """Whether a pose in it may explain the photograph about as well as one in another scene.

        Its score must not be clearly less. Matches that agree in the image show that roughly, so it may be so much less
        twice.
        """
        is_alike = self.agreeing_count * PLACES.clearly_more**2 >= other.agreeing_count
        return is_alike and self.agreement >= PROMISE.agreement


@dataclass(frozen=True, eq=False)
class SceneGroup:
    """The scenes of a query.

    Attributes:
        query, views: the query and its photograph, in none of the scenes.
        ranking: the scenes with references that resemble the photograph, the best first; empty until they are found.
        searched_count: number of scenes in which references were looked for.
        left_out: ranks of the scenes that could not be read.
        compared: comparisons of the photograph with references, by which the scenes were ranked; None without any.
    """

    query: Query
    views: QueryViews
    ranking: tuple[RankedScene, ...] = ()
    searched_count: int = 1
    left_out: frozenset[int] = frozenset()
    compared: Compared | None = None

    def compared_with(self, view: View) -> Compared | None:
        """The comparisons, if they are of this view."""
        return self.compared if self.compared is not None and self.compared.query is view else None

    def next_scene(self, tried: Collection[Attempt]) -> int | None:
        """Rank of the scene that is tried next, after these attempts; None if none is."""
        begun = begun_scenes(tried) - self.left_out
        if len(begun) >= SCENES:
            return None
        return next((i for i in range(len(self.ranking)) if i not in begun and i not in self.left_out), None)

    def tried_scenes(self, tried: Collection[Attempt]) -> tuple[SceneTried, ...]:
        """The scenes in the order of their ranks, after these attempts."""
        begun = begun_scenes(tried)
        return tuple(
            SceneTried(
                it.question.scene_key, it.reference_count, it.similarity, it.match_count, rank in begun, it.agreement
            )
            for rank, it in enumerate(self.ranking)
            if it.reference_count
        )


def begun_scenes(tried: Collection[Attempt]) -> frozenset[int]:
    """Ranks of the scenes that were tried; the attempt near a prior was made before there were ranks."""
    return frozenset(it.scene for it in tried if it.where is not Where.NEAR_PRIOR)
