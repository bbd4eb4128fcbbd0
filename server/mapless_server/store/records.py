"""The values that the store takes and returns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapless.depth import DepthImage
from mapless.geometry import Camera, RigidTransform
from mapless.provenance import GIVEN_POSE, Provenance
from mapless_server.method.features.views import View
from mapless_server.security import SceneKey, scene_id_of

from .attributes import SceneAttributes


@dataclass(frozen=True)
class SceneRecord:
    """A stored scene.

    Attributes:
        scene_key: its key, unique among the scenes that exist.
        generation: raised by every change of the scene or its references. A scene that is deleted and created again
            continues its count, so (scene_key, generation) never identifies two different contents. Adding features of
            another extractor is no change: they follow from the image and the extractor's name. Adding a global
            descriptor is one: the references that are retrieved depend on which of them have it.
        reference_count: number of references.
        create_time: when it was created, UTC.
        attributes: attributes of the scene.
        labels: what groups it with other scenes, value by name.
    """

    scene_key: SceneKey
    generation: int
    reference_count: int
    create_time: datetime
    attributes: SceneAttributes = field(default_factory=SceneAttributes)
    labels: Mapping[str, str] = field(default_factory=dict)

    @property
    def scene_id(self) -> str:
        """The scene's id within its tenant."""
        return scene_id_of(self.scene_key)


@dataclass(frozen=True, eq=False)
class NewReference:
    """A reference to be stored.

    Attributes:
        reference_id: its id, unique within its scene.
        image: the image file's bytes, unchanged.
        camera: its camera, in pixels of that image.
        world_from_camera: its pose, metric.
        views: processed camera and features (float32 arrays) by the name of the extractor, "sift-2048-1024px-0.02". At
            least one; the features of the first are counted.
        descriptors: global descriptors (D,) by name; stored as float16.
        mask: the bytes of its mask's file, unchanged; empty for none.
        provenance: how its pose is known.
        depth: the depth that was measured with it; None without one.
        place_key: of an adopted one, the key of the surveyed reference that is nearest; empty if unknown.
        usefulness: of an adopted one, see `Adopted`.
        adopted_by: of an adopted one, by whom and on which day; at each place once. Empty where it does not matter.
    """

    reference_id: str
    image: bytes
    camera: Camera
    world_from_camera: RigidTransform
    views: Mapping[str, View]
    descriptors: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    mask: bytes = b""
    provenance: Provenance = GIVEN_POSE
    depth: DepthImage | None = None
    place_key: str = ""
    usefulness: float = 0.0
    adopted_by: str = ""


class RetirementReason(str, Enum):
    """Reasons why a reference is not chosen any more."""

    CONTRADICTED = "contradicted"
    """Photographs that should show what it shows do not, again and again."""
    SURVEY_OUTDATED = "survey_outdated"
    """Of an adopted one: photographs of its place show too little of what was surveyed."""
    VOUCHERS_GONE = "vouchers_gone"
    """The surveyed references that the pose of an adopted one rests on were deleted or retired."""
    PLACE_FULL = "place_full"
    """An adopted one got another place, which has as many as it may, all more useful."""
    BY_OPERATOR = "by_operator"
    """A caller who may change the scene has asked for it."""


@dataclass(frozen=True)
class Retirement:
    """Since when, UTC, and why a reference is not chosen for photographs any more."""

    time: datetime
    reason: RetirementReason


@dataclass(frozen=True)
class Adopted:
    """An adopted reference of a scene.

    Attributes:
        reference_id, key: of the reference.
        place_key: key of the surveyed reference that is nearest; empty if unknown.
        usefulness: share of what photographs of its place matched that it gave, a running mean, 0 to 1.
        is_retired: whether it is not chosen any more.
        adopted_by: by whom and on which day, see `NewReference`.
    """

    reference_id: str
    key: str
    place_key: str
    usefulness: float
    is_retired: bool
    adopted_by: str = ""


@dataclass(frozen=True)
class Standing:
    """Findings of photographs about a reference since it was added or restored.

    Attributes:
        contradiction_count: photographs in a row that should show what it shows, and do not.
        contradiction_time_us: when the last one was counted, microseconds since 1970.
        contradicted_by: the day and the holder of each of the last ones, see `adoption.policy.with_photograph`.
        surveyed_share: of a surveyed one, the share of what answers of its place explain that the survey explains
            alone: the median of the last ones; None without any.
        photograph_count: photographs of its place that were counted.
        surveyed_by: day, holder and share of the last ones, see `adoption.policy.with_share`.
        outdate_time_us: since when its place needs a new survey, microseconds since 1970; None if it does not.
    """

    contradiction_count: int = 0
    contradiction_time_us: int = 0
    surveyed_share: float | None = None
    photograph_count: int = 0
    contradicted_by: tuple[str, ...] = ()
    surveyed_by: tuple[str, ...] = ()
    outdate_time_us: int | None = None


@dataclass(frozen=True, eq=False)
class ReferenceRecord:
    """A stored reference without its image and features.

    Attributes:
        scene_key: key of its scene.
        reference_id: its id, unique within the scene.
        key: its key, never used again; a reference that is deleted and added again has another key.
        camera: its camera, in pixels of the stored image.
        world_from_camera: its pose, metric.
        image_sha256: hash of the image's bytes, hexadecimal.
        feature_count: number of features that the first extractor found when it was added.
        create_time: when it was created, UTC.
        mask_sha256: hash of its mask's bytes, hexadecimal; empty without a mask.
        provenance: how its pose is known.
        depth_sha256: `DepthImage.sha256` of its depth; empty without one.
        retired: since when, UTC, and why it is not chosen any more; None if it is. Of those that are listed or got one
            by one, as the next two.
        standing: what photographs said of it, or of the place of an adopted one; None if there were none.
        place_id: of an adopted one, the id of the surveyed reference whose place it is at; empty if that one is not
            known or was deleted. Of others empty.
    """

    scene_key: SceneKey
    reference_id: str
    key: str
    camera: Camera
    world_from_camera: RigidTransform
    image_sha256: str
    feature_count: int
    create_time: datetime
    mask_sha256: str = ""
    provenance: Provenance = GIVEN_POSE
    depth_sha256: str = ""
    retired: Retirement | None = None
    standing: Standing | None = None
    place_id: str = ""

    @property
    def scene_id(self) -> str:
        """The scene's id within its tenant."""
        return scene_id_of(self.scene_key)


@dataclass(frozen=True, eq=False)
class DescribedReference:
    """A stored reference with one extractor's features of its image; read-only arrays."""

    record: ReferenceRecord
    view: View


@dataclass(frozen=True, eq=False)
class SceneState:
    """A scene at one moment.

    Attributes:
        generation: see `SceneRecord`.
        create_time_us: when it was created, microseconds since 1970; other scenes of its key have another.
        read: reads its attributes from what is stored; DataLoss if they are damaged.
    """

    generation: int
    create_time_us: int
    read: Callable[[], SceneAttributes]

    @cached_property
    def attributes(self) -> SceneAttributes:
        """Its attributes, with its self-calibrations; DataLoss if they are damaged."""
        return self.read()


@dataclass(frozen=True, eq=False)
class GroupedScene(SceneState):
    """One of the scenes that a query may search, by its key; its attributes are without self-calibrations.

    While a scene does not change, the store returns the same object, so that its attributes are read once.
    """

    scene_key: SceneKey

    @property
    def scene_id(self) -> str:
        """The scene's id within its tenant."""
        return scene_id_of(self.scene_key)


@dataclass(frozen=True, eq=False)
class NamedScenes:
    """Scenes that were asked for by their keys; found and missing ones are each in the order of the keys."""

    found: tuple[GroupedScene, ...]
    missing: tuple[SceneKey, ...]


@dataclass(frozen=True, eq=False)
class SceneSnapshot:
    """References and their scene, read at one moment; the references are in the order requested.

    Undescribed are those without features of the requested extractor.
    """

    scene: SceneState
    references: tuple[DescribedReference, ...]
    undescribed: tuple[ReferenceRecord, ...] = ()

    @property
    def generation(self) -> int:
        """The scene's generation."""
        return self.scene.generation


@dataclass(frozen=True, eq=False, slots=True)
class IndexedReference:
    """The data of a reference that retrieval needs; arrays are read-only.

    The key is never used again. The pose is metric; the requested global descriptor (D,), rounded to float16, is None
    if there is none.
    """

    reference_id: str
    key: str
    world_from_camera: RigidTransform
    descriptor: NDArray[np.float32] | None


@dataclass(frozen=True, eq=False)
class SceneChanges:
    """The changes of a scene since a generation, read at one moment.

    Attributes:
        generation: generation of the scene at that moment, for the next request.
        added: references to add, ordered by id. One that the caller knows already now has a descriptor, and is
            replaced.
        removed: keys of references that were deleted; the caller may not know some of them.
        is_whole: whether `added` is the whole scene, and replaces everything that the caller knows.
        damaged: ids of references that are omitted because their pose or descriptor is damaged, ordered.
    """

    generation: int
    added: tuple[IndexedReference, ...]
    removed: frozenset[str]
    is_whole: bool
    damaged: tuple[str, ...] = ()
