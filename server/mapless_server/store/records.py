"""What goes into the store and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from mapless.geometry import Camera, RigidTransform
from mapless_server.views import PosedView, View


@dataclass(frozen=True)
class SceneRecord:
    """A stored scene.

    Attributes:
        scene_id: unique among the scenes that exist.
        generation: raised by every change of the scene or its references. A scene that is deleted and created again
            counts on, so (scene_id, generation) never means two different contents.
        reference_count: number of references.
        create_time: UTC.
    """

    scene_id: str
    generation: int
    reference_count: int
    create_time: datetime


@dataclass(frozen=True, eq=False)
class NewReference:
    """A reference to be stored.

    Attributes:
        reference_id: unique within its scene.
        image: the file's bytes as they came.
        camera: in pixels of that image.
        world_from_camera: its pose, metric.
        view: processed camera and features; float32 arrays.
        extractor: name of what computed the features, "sift-2048-1024px-0.02".
    """

    reference_id: str
    image: bytes
    camera: Camera
    world_from_camera: RigidTransform
    view: View
    extractor: str


@dataclass(frozen=True, eq=False)
class ReferenceRecord:
    """A stored reference without its image and features.

    Attributes:
        scene_id, reference_id: its name.
        key: identifies this very reference for good; one that is deleted and added again has another key.
        camera: in pixels of the stored image.
        world_from_camera: its pose, metric.
        image_sha256: of the image's bytes, hexadecimal.
        feature_count: number of features it was added with.
        create_time: UTC.
    """

    scene_id: str
    reference_id: str
    key: str
    camera: Camera
    world_from_camera: RigidTransform
    image_sha256: str
    feature_count: int
    create_time: datetime


@dataclass(frozen=True, eq=False)
class ReferencePose:
    """Where a reference stands; enough to choose among references without loading their features."""

    reference_id: str
    key: str
    world_from_camera: RigidTransform


@dataclass(frozen=True, eq=False)
class SceneSnapshot:
    """References and the generation of their scene, read at one moment."""

    generation: int
    references: tuple[PosedView, ...]
