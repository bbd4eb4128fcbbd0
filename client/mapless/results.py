"""Scenes, references and what is said of them, as values."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from . import names, wire
from .geodesy import Datum
from .geometry import Camera, RigidTransform
from .scenes import Calibration, Vector, calibration_from_message, datum_from_message, direction_from_message
from .v1 import reference_service_pb2 as pb


@dataclass(frozen=True)
class Scene:
    """A set of references that share one world frame; `generation` is raised by every change.

    Attributes:
        scene_id, generation, reference_count, create_time: what the server keeps.
        datum: where the world is on the Earth; None if nobody has said so.
        down_in_world: unit vector to where things fall; None if nobody has said so but, perhaps, the datum.
        calibration: how far off answers were found to be; None if that was never measured.
    """

    scene_id: str
    generation: int
    reference_count: int
    create_time: datetime
    datum: Datum | None = None
    down_in_world: Vector | None = None
    calibration: Calibration | None = None


@dataclass(frozen=True, eq=False)
class Reference:
    """A stored photograph; `image`, the file's bytes, only if asked for."""

    scene_id: str
    reference_id: str
    camera: Camera
    world_from_camera: RigidTransform
    image_sha256: str
    feature_count: int
    create_time: datetime
    image: bytes | None = None


@dataclass(frozen=True, eq=False)
class RetrievedReference:
    """A reference that resembles a photograph: its name, how much it does (cosine, -1 to 1), and its pose."""

    name: str
    similarity: float
    world_from_camera: RigidTransform


@dataclass(frozen=True)
class ReferenceAudit:
    """What a reference's neighbours say about it.

    Attributes:
        name: "scenes/{scene}/references/{reference}".
        verdict: the value of AuditVerdict without its prefix, "CONSISTENT" or "WRONG_POSE".
        message: one sentence for a person, with the numbers that decided.
        neighbour_count, match_count, inlier_count: what it was compared with, the matches, and those that agree.
        reprojection_error_px: median of those under the stored pose, pixels of the processed image; 0 without matches.
        position_offset_m, rotation_offset_deg: from the stored pose to what the neighbours say; 0 where unknown.
        focal_ratio: their focal length over the stored one; 0 where unknown.
        other: the reference that it was swapped with or is a duplicate of; else empty.
    """

    name: str
    verdict: str
    message: str
    neighbour_count: int
    match_count: int
    inlier_count: int
    reprojection_error_px: float
    position_offset_m: float
    rotation_offset_deg: float
    focal_ratio: float
    other: str


@dataclass(frozen=True)
class Coverage:
    """Whether a photograph taken somewhere would be localized.

    Attributes:
        verdict: "LOCALIZABLE", "DOUBTFUL" or "NOT_LOCALIZABLE".
        message: one sentence for a person, with the numbers that decided.
        expected_match_count: 2D-3D matches that a photograph is expected to have.
        image_share: share of the image in which there would be any, 0 to 1.
        position_68_m: position error expected not to be exceeded in 68 % of cases; None where there is none to expect.
        references: names of those that would serve, those that see most first.
    """

    verdict: str
    message: str
    expected_match_count: int
    image_share: float
    position_68_m: float | None
    references: tuple[str, ...]


def scene_from_message(message: pb.Scene) -> Scene:
    """Scene of a message."""
    return wire.filled(
        Scene,
        message,
        scene_id=names.parse_scene_name(message.name),
        create_time=wire.time_from_message(message.create_time),
        datum=wire.optional(message, "datum", datum_from_message, "datum"),
        down_in_world=wire.optional(message, "down_in_world", direction_from_message, "down_in_world"),
        calibration=wire.optional(message, "calibration", calibration_from_message, "calibration"),
    )


def reference_from_message(message: pb.Reference) -> Reference:
    """Reference of a message."""
    scene_id, reference_id = names.parse_reference_name(message.name)
    return wire.filled(
        Reference,
        message,
        scene_id=scene_id,
        reference_id=reference_id,
        camera=wire.camera_from_message(message.intrinsics, "intrinsics"),
        world_from_camera=wire.transform_from_message(message.world_from_camera, "world_from_camera"),
        create_time=wire.time_from_message(message.create_time),
        image=message.image or None,
    )


def retrieved_from_message(message: pb.RetrievedReference) -> RetrievedReference:
    """Retrieved reference of a message."""
    pose = wire.transform_from_message(message.world_from_camera, "world_from_camera")
    return wire.filled(RetrievedReference, message, world_from_camera=pose)


def audit_from_message(message: pb.ReferenceAudit) -> ReferenceAudit:
    """Audit of a message."""
    return wire.filled(ReferenceAudit, message, verdict=wire.value_name(pb.AuditVerdict, message.verdict))


def coverage_from_message(message: pb.CheckCoverageResponse) -> Coverage:
    """Coverage of a message."""
    return wire.filled(
        Coverage,
        message,
        verdict=wire.value_name(pb.CoverageVerdict, message.verdict),
        position_68_m=message.position_68_m or None,
        references=tuple(message.references),
    )
