"""What is sent to the server, as values, and the messages they become."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from . import wire
from .geometry import Array, Camera, RigidTransform
from .v1 import geometry_pb2
from .v1 import localization_service_pb2 as localization_pb
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


@dataclass(frozen=True, eq=False)
class PositionPrior:
    """The camera is known to be within `radius_m` of `position_m` (3,), world frame."""

    position_m: Array
    radius_m: float


@dataclass(frozen=True, eq=False)
class HeadingPrior:
    """The camera is known to look within `max_angle_deg` of `direction` (3,), world frame, of any length but 0."""

    direction: Array
    max_angle_deg: float


def create_request(scene_name: str, reference: NewReference) -> reference_pb.CreateReferenceRequest:
    """The message that asks to store a reference; reads its file."""
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
    """The file's bytes."""
    return image if isinstance(image, bytes) else Path(image).read_bytes()


def set_priors(
    request: localization_pb.LocalizeRequest | reference_pb.RetrieveReferencesRequest,
    position: PositionPrior | None,
    heading: HeadingPrior | None,
) -> None:
    """Puts what is known of the camera into a request."""
    if position is not None:
        request.position_prior.position_m.CopyFrom(_vector(position.position_m))
        request.position_prior.radius_m = position.radius_m
    if heading is not None:
        request.heading_prior.direction.CopyFrom(_vector(heading.direction))
        request.heading_prior.max_angle_deg = heading.max_angle_deg


def _vector(xyz: Array) -> geometry_pb2.Vector3:
    x, y, z = map(float, xyz)
    return geometry_pb2.Vector3(x=x, y=y, z=z)
