"""Further features of references, made in the background; and the order in which the rest is made."""

from collections.abc import Sequence
from dataclasses import dataclass

from mapless_server.errors import NotFound
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.options import StageContext
from mapless_server.store.pairs import Claim

from .indexes import SceneIndexes
from .library import ReferenceLibrary
from .stored import TierMatching, matching_name


@dataclass(frozen=True, eq=False)
class LaterFeatures:
    """Features that further attempts use, and the descriptor for choosing references that is made of them.

    `indexes` are of that descriptor; None if there is none.
    """

    extractor: FeatureExtractor
    indexes: SceneIndexes | None = None

    @property
    def name(self) -> str:
        """Name of the work, as `PairStore` expects it."""
        return matching_name(self.extractor.name, "features")

    def make(self, library: ReferenceLibrary, claim: Claim, context: StageContext) -> None:
        """Stores what the claimed reference lacks; NotFound if it was deleted, DataLoss if it is damaged."""
        _, (subject,) = library.load(claim.scene_key, [claim.reference_id], self.extractor, context)
        if subject.key != claim.key:
            raise NotFound("the reference was replaced")
        if self.indexes is not None:
            self.indexes.describe_stored(library, claim.scene_key, claim.reference_id, claim.key, context)


Work = TierMatching | LaterFeatures
"""One kind of work on each reference."""


FEATURES, MATCHES, CALIBRATION = "features", "matches", "calibration"
"""Kinds of work, for `Pending`."""


@dataclass(frozen=True)
class Pending:
    """Work that is left to the background in a scene.

    Attributes:
        work: `FEATURES`, `MATCHES` of references with one another, or `CALIBRATION` of the scene.
        name: the features, for matches with how they are made; the kind of answers that is calibrated.
        reference_count: number of references that wait for it.
    """

    work: str
    name: str
    reference_count: int


def what_of(work: Work) -> str:
    """Kinds of work, for `Pending`."""
    return FEATURES if isinstance(work, LaterFeatures) else MATCHES


def name_of(work: Work) -> str:
    """A name of the work for a person, such as "aliked-... (network, wide)"."""
    return work.extractor.name if isinstance(work, LaterFeatures) else f"{work.extractor.name} ({work.kind.value})"


def in_order(matchings: Sequence[TierMatching], features: Sequence[LaterFeatures]) -> tuple[list[Work], list[Work]]:
    """Returns what is made before depths and calibrations, and what after them, each in order.

    Every query needs matches of the first features. Of further features, those with a descriptor of their own are
    needed of all references of a scene, the others of those that a doubtful photograph resembles. Without them an
    attempt is left out, while matches take a query milliseconds, except those by a network.
    """
    if not matchings:
        return list(features), []
    first = matchings[0].extractor
    own = [it for it in matchings if it.extractor is first and not it.kind.is_strong]
    needed_of_all = sorted(features, key=lambda it: it.indexes is None)
    return [*own[:1], *needed_of_all, *own[1:]], [it for it in matchings if it not in own]
