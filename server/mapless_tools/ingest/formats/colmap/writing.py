"""COLMAP text models of cameras and poses: what other tools read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mapless.geometry import Camera, RigidTransform

from .cameras import from_camera

FILES = ("cameras.txt", "images.txt", "points3D.txt")


@dataclass(frozen=True, eq=False)
class PosedImage:
    """What a model says of an image.

    Attributes:
        name: of its file, from the images' folder.
        camera, world_from_camera: ours.
    """

    name: str
    camera: Camera
    world_from_camera: RigidTransform


def model_texts(images: Sequence[PosedImage]) -> dict[str, str]:
    """The model's files by name; images of one camera share it, and there are no points."""
    camera_ids: dict[Camera, int] = {}
    for image in images:
        camera_ids.setdefault(image.camera, len(camera_ids) + 1)
    cameras = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    for camera, camera_id in camera_ids.items():
        written = from_camera(camera_id, camera)
        cameras.append(
            f"{camera_id} {written.model} {written.width_px} {written.height_px} {_words(written.parameters)}"
        )
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; then its observations, none here"]
    for image_id, image in enumerate(images, 1):
        camera_from_world = image.world_from_camera.inverse()
        q = camera_from_world.quaternion()
        pose = _words([q.w, q.x, q.y, q.z, *camera_from_world.translation.tolist()])
        lines += [f"{image_id} {pose} {camera_ids[image.camera]} {image.name}", ""]
    contents = (cameras, lines, ["# POINT3D_ID X Y Z R G B ERROR TRACK[]: none"])
    return {name: "\n".join(content) + "\n" for name, content in zip(FILES, contents, strict=True)}


def _words(numbers: Sequence[float]) -> str:
    """Numbers that are read back as they were."""
    return " ".join(repr(float(number)) for number in numbers)
