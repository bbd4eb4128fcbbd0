"""A new reference, how far intrinsics may be off, and the bytes of a photograph."""

import os
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from . import wire
from .depth import DepthImage, depth_to_message
from .geometry import Camera, RigidTransform, nearest_rotation
from .names import shown
from .provenance import GIVEN_POSE, Provenance, provenance_to_message
from .v1 import reference_service_pb2 as reference_pb

ImageSource = bytes | str | os.PathLike[str]
"""The bytes of a JPEG, PNG or WebP file, or its path. They are sent as they are."""


@dataclass(frozen=True, eq=False)
class NewReference:
    """A reference to be stored: id within the scene, photograph, its camera and its pose (metric).

    The mask, a PNG of the photograph's size or its path, is 0 at the pixels to ignore; None: all are used. `provenance`
    says how the pose is known. The depth was measured with the photograph; None without one.
    """

    reference_id: str
    image: ImageSource
    camera: Camera
    world_from_camera: RigidTransform
    mask: ImageSource | None = None
    provenance: Provenance = GIVEN_POSE
    depth: DepthImage | None = None


class ReadoutDirection(str, Enum):
    """Sides of a photograph's raster, as it is stored, that a rolling shutter reads first and last."""

    TOP_TO_BOTTOM = "top_to_bottom"
    BOTTOM_TO_TOP = "bottom_to_top"
    LEFT_TO_RIGHT = "left_to_right"
    RIGHT_TO_LEFT = "right_to_left"
    """The raster was turned clockwise by a quarter, as upright photographs of phones held upright."""


@dataclass(frozen=True)
class IntrinsicsUncertainty:
    """Standard deviations of a photograph's intrinsics, and the read-out of its shutter; 0 for the server's default.

    Attributes:
        focal_sigma_px: standard deviation of both focal lengths together, pixels along x; by default 0.3 % of it.
        principal_sigma_px: standard deviation of each coordinate of the principal point; by default 0.3 % of the width.
        k1_sigma: standard deviation of the first distortion coefficient; by default 0.01.
        readout_s: time from reading the first row to reading the last one, seconds, at most 0.2; 0 for a global
            shutter, or if nothing is known of it.
        readout_direction: which side is read first.
        speed_m_per_s: standard deviation of each component of the camera's speed while it moves; by default the one
            that moves the image as much as the angular speed.
        turn_deg_per_s: standard deviation of its angular speed about each axis; by default 90.
    """

    focal_sigma_px: float = 0.0
    principal_sigma_px: float = 0.0
    k1_sigma: float = 0.0
    readout_s: float = 0.0
    readout_direction: ReadoutDirection | str = ReadoutDirection.TOP_TO_BOTTOM
    speed_m_per_s: float = 0.0
    turn_deg_per_s: float = 0.0


def create_request(
    scene_name: str, reference: NewReference, field: str = "reference"
) -> reference_pb.CreateReferenceRequest:
    """The request that stores a reference; reads the photograph's file.

    TypeError names a value of another type by its field; ValueError if the pose's rotation is not a rotation.
    """
    wire.require(
        reference, NewReference, field, "one is made by NewReference(reference_id, image, camera, world_from_camera)"
    )
    if not isinstance(reference.reference_id, str):
        raise TypeError(f"{field}.reference_id must be a text, is {reference.reference_id!r}")
    world_from_camera = wire.transform_to_message(reference.world_from_camera, f"{field}.world_from_camera")
    try:
        nearest_rotation(reference.world_from_camera.rotation)
    except ValueError as error:
        raise ValueError(f"world_from_camera of reference {shown(reference.reference_id)}: {error}") from None
    return reference_pb.CreateReferenceRequest(
        scene=scene_name,
        reference_id=reference.reference_id,
        reference=reference_pb.Reference(
            image=read_image(reference.image, f"{field}.image"),
            intrinsics=wire.camera_to_message(reference.camera, f"{field}.camera"),
            world_from_camera=world_from_camera,
            mask=read_mask(reference.mask, f"{field}.mask"),
            provenance=provenance_to_message(reference.provenance),
            depth=None if reference.depth is None else depth_to_message(reference.depth, f"{field}.depth"),
        ),
    )


def read_mask(mask: ImageSource | None, field: str = "mask") -> bytes | None:
    """Reads a mask's bytes, None for none; TypeError as `read_image`."""
    return None if mask is None else read_image(mask, field)


def read_image(image: ImageSource, field: str = "image") -> bytes:
    """Reads the file's bytes; TypeError, with the field, for an array of pixels, which has to be encoded first."""
    if isinstance(image, bytes):
        return image
    try:
        path = Path(image)
    except TypeError:
        kind = f"{type(image).__module__}.{type(image).__qualname__}"
        raise TypeError(
            f"{field} is the path or the bytes of a JPEG, PNG or WebP file, not {kind}: encode pixels first, "
            'for instance with cv2.imencode(".jpg", pixels)[1].tobytes()'
        ) from None
    return path.read_bytes()
