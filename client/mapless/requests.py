"""A new reference, and the bytes of a photograph."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from . import wire
from .geometry import Camera, RigidTransform
from .v1 import reference_service_pb2 as reference_pb

ImageSource = bytes | str | os.PathLike[str]
"""The bytes of a JPEG, PNG or WebP file, or its path. They are sent as they are."""


@dataclass(frozen=True, eq=False)
class NewReference:
    """A reference to be stored: id within the scene, photograph, its camera and its pose (metric)."""

    reference_id: str
    image: ImageSource
    camera: Camera
    world_from_camera: RigidTransform


def create_request(scene_name: str, reference: NewReference) -> reference_pb.CreateReferenceRequest:
    """The request that stores a reference; reads the photograph's file."""
    return reference_pb.CreateReferenceRequest(
        scene=scene_name,
        reference_id=reference.reference_id,
        reference=reference_pb.Reference(
            image=read_image(reference.image),
            intrinsics=wire.camera_to_message(reference.camera),
            world_from_camera=wire.transform_to_message(reference.world_from_camera),
        ),
    )


def read_image(image: ImageSource) -> bytes:
    """The file's bytes; TypeError for pixels, which have to be encoded first."""
    if isinstance(image, bytes):
        return image
    try:
        path = Path(image)
    except TypeError:
        kind = f"{type(image).__module__}.{type(image).__qualname__}"
        raise TypeError(
            f"image is the path or the bytes of a JPEG, PNG or WebP file, not {kind}: encode pixels first, "
            'for instance with cv2.imencode(".jpg", pixels)[1].tobytes()'
        ) from None
    return path.read_bytes()
