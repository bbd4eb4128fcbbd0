"""A scene's references as a folder of files: images, and a description of their cameras and poses."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from mapless import Scene
from mapless.cameras import FOLDER_FILE
from mapless.geometry import Camera, RigidTransform
from mapless.lenses import DEFAULT_LENS_MODEL, lens_model_of
from mapless.masks import FOLDER as MASKS
from mapless.masks import mask_name
from mapless.provenance import GIVEN_POSE, Provenance, provenance_to_json

from .colmap.cameras import from_camera
from .depths import WrittenDepth, depth_entry
from .kapture import PROPERTIES

IMAGES = "images"


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image that is stored under `name` in the layout's folder of images, with its camera and pose.

    If it `has_mask`, that is stored in the folder `mapless.masks.FOLDER` under COLMAP's name. `provenance` says how the
    pose is known; only `cameras.json` has it. `depth` is in the layout's form, None without one or in a layout that has
    none.
    """

    name: str
    camera: Camera
    world_from_camera: RigidTransform
    has_mask: bool = False
    provenance: Provenance = GIVEN_POSE
    depth: WrittenDepth | None = None


Describe = Callable[..., dict[str, str]]
"""Returns a layout's files by their paths: of images, their origin as a text, and perhaps their scene."""


class DepthForm(Enum):
    """How depths are written: not at all, as they came, or as values in metres of those that are used."""

    NONE = "none"
    AS_STORED = "as stored"
    METRES = "metres"


@dataclass(frozen=True)
class Layout:
    """A layout that can be written: its function that describes images, the folder of the images, and how depth is."""

    files: Describe
    images: str = IMAGES
    depths: DepthForm = DepthForm.NONE


def _properties(scene: Scene | None) -> dict[str, Any]:
    content: dict[str, Any] = {"metric": scene is None or not scene.arbitrary_unit}
    if scene is not None and scene.datum is not None:
        content["datum"] = scene.datum.to_json()
    if scene is not None and scene.down_in_world is not None:
        content["down_in_world"] = scene.down_in_world
    return content


def cameras_files(images: Sequence[PosedImage], source: str, scene: Scene | None = None) -> dict[str, str]:
    """`cameras.json`, with the scene's datum, down and unit."""
    properties = _properties(scene)
    unit = "metre" if properties["metric"] else "arbitrary"
    content: dict[str, Any] = {"source": source, "units": unit, **properties}
    content["frames"] = [_entry(image) for image in images]
    return {FOLDER_FILE: json.dumps(content, indent=1, allow_nan=False) + "\n"}


def colmap_files(images: Sequence[PosedImage], source: str, scene: Scene | None = None) -> dict[str, str]:
    """A COLMAP text model, in the folder where COLMAP writes it."""
    return {f"sparse/0/{name}": f"# {source}\n{text}" for name, text in model_texts(images).items()}


def model_texts(images: Sequence[PosedImage]) -> dict[str, str]:
    """The files of a COLMAP text model by name; images with equal cameras share one, and there are no points."""
    camera_ids: dict[Camera, int] = {}
    for image in images:
        camera_ids.setdefault(image.camera, len(camera_ids) + 1)
    cameras = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    for camera, camera_id in camera_ids.items():
        it = from_camera(camera_id, camera)
        cameras.append(f"{camera_id} {it.model} {it.width_px} {it.height_px} {_words(it.parameters)}")
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; then its observations, none here"]
    for image_id, image in enumerate(images, 1):
        lines += [f"{image_id} {_camera_from_world(image)} {camera_ids[image.camera]} {image.name}", ""]
    contents = {"cameras": cameras, "images": lines, "points3D": ["# POINT3D_ID X Y Z R G B ERROR TRACK[]: none"]}
    return {f"{name}.txt": "\n".join(it) + "\n" for name, it in contents.items()}


def kapture_files(images: Sequence[PosedImage], source: str, scene: Scene | None = None) -> dict[str, str]:
    """The tables of a kapture 1.1; each image has its own time, and images with equal cameras share one."""
    sensors: dict[Camera, str] = {}
    trajectories, records, depths = [], [], _DepthTables()
    for time, image in enumerate(images):
        sensor = sensors.setdefault(image.camera, f"camera{len(sensors) + 1}")
        trajectories.append(f"{time}, {sensor}, {_camera_from_world(image, ', ')}")
        records.append(f"{time}, {sensor}, {image.name}")
        trajectories += depths.add(time, image)
    cameras = [_sensor_row(sensor, "", "camera", camera) for camera, sensor in sensors.items()]
    known = {it.name: provenance_to_json(it.provenance) for it in images}
    provenance = {name: it for name, it in known.items() if it is not None}
    properties = _properties(scene) | ({"provenance": provenance} if provenance else {})
    notes = [f"# {source}", f"{PROPERTIES}{json.dumps(properties)}"]
    tables = {
        "sensors": [*notes, "# sensor_id, name, sensor_type, [sensor_params]+", *cameras, *depths.sensor_rows()],
        "trajectories": ["# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz", *trajectories],
        "records_camera": ["# timestamp, device_id, image_path", *records],
    }
    if depths.records:
        tables["records_depth"] = ["# timestamp, device_id, depth_map_path", *depths.records]
    return {f"sensors/{name}.txt": "\n".join(["# kapture format: 1.1", *it]) + "\n" for name, it in tables.items()}


class _DepthTables:
    """Depth sensors of a kapture, one for each kind and camera, and the records of their depths."""

    def __init__(self) -> None:
        self.records: list[str] = []
        self._sensors: dict[tuple[str, Camera], str] = {}

    def add(self, time: int, image: PosedImage) -> list[str]:
        """Records the depth of an image; returns the pose of its sensor as a row of trajectories, if it has one."""
        if image.depth is None:
            return []
        depth = image.depth.image
        assert depth.size is not None
        camera = depth.camera or image.camera.resized(*depth.size)
        sensor = self._sensors.setdefault((depth.sensor.value, camera), f"depth{len(self._sensors) + 1}")
        self.records.append(f"{time}, {sensor}, {image.depth.path}")
        pose = image.world_from_camera
        if depth.camera_from_depth_camera is not None:
            pose = pose.compose(depth.camera_from_depth_camera)
        return [f"{time}, {sensor}, {_inverse_words(pose, ', ')}"]

    def sensor_rows(self) -> list[str]:
        """Rows of sensors.txt."""
        return [_sensor_row(sensor, name, "depth", camera) for (name, camera), sensor in self._sensors.items()]


def _sensor_row(sensor: str, name: str, kind: str, camera: Camera) -> str:
    it = from_camera(sensor, camera)
    return f"{sensor}, {name}, {kind}, {it.model}, {it.width_px}, {it.height_px}, {_words(it.parameters, ', ')}"


LAYOUTS: Mapping[str, Layout] = {
    "cameras": Layout(cameras_files, depths=DepthForm.AS_STORED),
    "colmap": Layout(colmap_files),
    "kapture": Layout(kapture_files, "sensors/records_data", DepthForm.METRES),
}
"""Layouts that are written, by name."""


def image_name(reference_id: str, image: bytes) -> str:
    """File name of a reference's image: its id, and the ending of its format."""
    if image.startswith(b"\x89PNG"):
        return f"{reference_id}.png"
    return f"{reference_id}.webp" if image.startswith(b"RIFF") else f"{reference_id}.jpg"


def _entry(image: PosedImage) -> dict[str, Any]:
    camera, lens = image.camera, image.camera.distortion
    entry: dict[str, Any] = {
        "image": f"{IMAGES}/{image.name}",
        "width": camera.width_px,
        "height": camera.height_px,
        "K": camera.matrix().tolist(),
        "dist": None if lens is None else list(vars(lens).values()),
        "world_from_camera": image.world_from_camera.matrix().tolist(),
    }
    if image.has_mask:
        entry["mask"] = f"{MASKS}/{mask_name(image.name)}"
    if provenance := provenance_to_json(image.provenance):
        entry["provenance"] = provenance
    entry |= {} if image.depth is None else depth_entry(image.depth)
    model = DEFAULT_LENS_MODEL if lens is None else lens_model_of(lens)
    return entry if model == DEFAULT_LENS_MODEL else entry | {"lens": model}


def _camera_from_world(image: PosedImage, separator: str = " ") -> str:
    return _inverse_words(image.world_from_camera, separator)


def _inverse_words(world_from_camera: RigidTransform, separator: str) -> str:
    """The pose in the form of COLMAP and kapture: qw qx qy qz tx ty tz."""
    pose = world_from_camera.inverse()
    q = pose.quaternion()
    return _words([q.w, q.x, q.y, q.z, *pose.translation.tolist()], separator)


def _words(numbers: Sequence[float], separator: str = " ") -> str:
    """Numbers as text that is read back to the same numbers."""
    return separator.join(repr(float(number)) for number in numbers)
