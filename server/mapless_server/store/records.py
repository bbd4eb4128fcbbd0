"""What goes into the store and what comes out of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from mapless.geodesy import Datum
from mapless.geometry import Array, Camera, RigidTransform
from mapless.scenes import Calibration, Vector
from mapless_server.method.views import View
from mapless_server.security.tenancy import SceneKey, scene_id_of

MAX_DOWN_DISAGREEMENT_DEG = 10.0
"""Datums are turned by compass or by hand, so some degrees are no wonder; 90 are a world whose y is up, not its z."""


class ContradictingDown(ValueError):
    """A scene's datum says that another way is down than its own down."""


@dataclass(frozen=True)
class SceneAttributes:
    """What is known of a scene as a whole; each may be unknown.

    Attributes:
        datum: where its world is on the Earth.
        down_in_world: unit vector to where things fall; None: what the datum says, if there is one.
        calibration: how far off answers were found to be.

    Raises:
        ContradictingDown: datum and down_in_world do not belong to the same world.
    """

    datum: Datum | None = None
    down_in_world: Vector | None = None
    calibration: Calibration | None = None

    def __post_init__(self) -> None:
        if self.datum is None or self.down_in_world is None:
            return
        cosine = float(self.datum.down_in_world() @ self.down_in_world)
        angle_deg = math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
        if angle_deg > MAX_DOWN_DISAGREEMENT_DEG:
            raise ContradictingDown(
                f"is {angle_deg:.0f} degrees off what the datum says is down; its enu_from_world must turn the world's "
                "axes to east, north and up"
            )

    def down(self) -> Array | None:
        """Unit vector (3,) to where things fall, in the world; None if nobody has said."""
        if self.down_in_world is not None:
            return np.array(self.down_in_world)
        return None if self.datum is None else self.datum.down_in_world()


@dataclass(frozen=True)
class SceneRecord:
    """A stored scene.

    Attributes:
        scene_key: unique among the scenes that exist.
        generation: raised by every change of the scene or its references. A scene that is deleted and created again
            counts on, so (scene_key, generation) never means two different contents. Features of one more extractor
            are no change: they follow from the image and the extractor's name, and answers are named after both. One
            more global descriptor is: which references are found depends on which of them have it.
        reference_count: number of references.
        create_time: UTC.
        attributes: what is known of it as a whole.
    """

    scene_key: SceneKey
    generation: int
    reference_count: int
    create_time: datetime
    attributes: SceneAttributes = SceneAttributes()

    @property
    def scene_id(self) -> str:
        """What its tenant calls it."""
        return scene_id_of(self.scene_key)


@dataclass(frozen=True, eq=False)
class NewReference:
    """A reference to be stored.

    Attributes:
        reference_id: unique within its scene.
        image: the file's bytes as they came.
        camera: in pixels of that image.
        world_from_camera: its pose, metric.
        views: by the name of the extractor, "sift-2048-1024px-0.02": processed camera and features, float32 arrays. At
            least one; the first one's features are those that are counted.
        descriptors: global descriptors by name, (D,) each; kept as float16.
    """

    reference_id: str
    image: bytes
    camera: Camera
    world_from_camera: RigidTransform
    views: Mapping[str, View]
    descriptors: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ReferenceRecord:
    """A stored reference without its image and features.

    Attributes:
        scene_key: of its scene.
        reference_id: unique within the scene.
        key: identifies this very reference for good; one that is deleted and added again has another key.
        camera: in pixels of the stored image.
        world_from_camera: its pose, metric.
        image_sha256: of the image's bytes, hexadecimal.
        feature_count: number of features that the first extractor found when it was added.
        create_time: UTC.
    """

    scene_key: SceneKey
    reference_id: str
    key: str
    camera: Camera
    world_from_camera: RigidTransform
    image_sha256: str
    feature_count: int
    create_time: datetime

    @property
    def scene_id(self) -> str:
        """What its tenant calls the scene."""
        return scene_id_of(self.scene_key)


@dataclass(frozen=True, eq=False)
class DescribedReference:
    """A stored reference and what one extractor found in its image; read-only arrays."""

    record: ReferenceRecord
    view: View


@dataclass(frozen=True, eq=False)
class SceneSnapshot:
    """References and the generation of their scene, read at one moment.

    Attributes:
        generation: of the scene.
        references: those that have features of the extractor asked for, in the order asked for.
        undescribed: those that have none, likewise.
    """

    generation: int
    references: tuple[DescribedReference, ...]
    undescribed: tuple[ReferenceRecord, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class IndexedReference:
    """What choosing among references needs to know of one.

    Attributes:
        reference_id: unique within the scene.
        key: identifies this very reference for good.
        world_from_camera: its pose, metric; read-only arrays.
        descriptor: the global descriptor of the name asked for, (D,), read-only, as float16 keeps it; None where there
            is none.
    """

    reference_id: str
    key: str
    world_from_camera: RigidTransform
    descriptor: NDArray[np.float32] | None


@dataclass(frozen=True, eq=False)
class SceneChanges:
    """What became of a scene since a generation, read at one moment.

    Attributes:
        generation: of the scene at that moment; the one to ask with next time.
        added: references to put in, by id. One that is known already has got a descriptor since and takes the place of
            what was known.
        removed: keys of references that are gone; they may never have been known.
        is_whole: what was known before is void, and `added` is the whole scene.
        damaged: ids of references whose pose or descriptor is not what was stored; they are left out, by id.
    """

    generation: int
    added: tuple[IndexedReference, ...]
    removed: frozenset[str]
    is_whole: bool
    damaged: tuple[str, ...] = ()
