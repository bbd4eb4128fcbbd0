"""What the server answers, as values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

import numpy as np

from . import names, wire
from .geometry import Array, Camera, RigidTransform
from .v1 import localization_service_pb2 as localization_pb
from .v1 import reference_service_pb2 as reference_pb


@dataclass(frozen=True)
class Scene:
    """A set of references that share one world frame; `generation` is raised by every change."""

    scene_id: str
    generation: int
    reference_count: int
    create_time: datetime


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


@dataclass(frozen=True)
class Accuracy:
    """Errors not exceeded in 68 and 95 % of cases; `calibrated` on photographs with known poses or not."""

    position_68_m: float
    position_95_m: float
    rotation_68_deg: float
    rotation_95_deg: float
    calibrated: bool


@dataclass(frozen=True)
class ReferenceUse:
    """What one reference contributed: matches with the photograph, and inliers of the pose.

    `similarity` to the photograph, -1 to 1, where the server chose it; else 0.
    """

    name: str
    match_count: int
    inlier_count: int
    similarity: float = 0.0


@dataclass(frozen=True)
class ScaleEstimate:
    """The reconstruction's metric scale.

    Attributes:
        metres_per_unit: the scale.
        stage: what gave it, "TRIANGULATION" or "TRAJECTORY".
        deviation: relative, of the scaled camera trajectory's radius from the true one.
    """

    metres_per_unit: float
    stage: str
    deviation: float


@dataclass(frozen=True)
class Diagnostics:
    """What was used for an answer and where the time went.

    Attributes:
        request_id: identifies the call in the server's log.
        backend, weights_sha256, features, variant, store_generation, server_version: what computed it, from what.
        references: those used, in the order they were given or chosen.
        scale: None if that stage was not reached.
        stage_s: seconds by stage, in order.
        queue_s, total_s: seconds that the call waited and took, inside the server.
        processed_width_px, processed_height_px: size of the image as it was processed.
        retrieval: what the references were chosen by; empty if they were used as they were given.
    """

    request_id: str
    backend: str
    weights_sha256: str
    features: str
    variant: str
    store_generation: int
    references: tuple[ReferenceUse, ...]
    scale: ScaleEstimate | None
    stage_s: Mapping[str, float]
    queue_s: float
    total_s: float
    processed_width_px: int
    processed_height_px: int
    server_version: str
    retrieval: str = ""


@dataclass(frozen=True, eq=False)
class LocalizationResult:
    """Where a photograph was taken.

    Attributes:
        world_from_camera: the camera's pose; its translation is the camera centre in the scene's world frame, metres.
        covariance: (6, 6), order x y z rx ry rz, metres and radians about fixed world axes; None if not estimated.
        accuracy: radii of the same; None if it is.
        pose_stage: "REFINED" or "INITIAL"; "COARSE" for a pose that nothing has checked, because there was no time to,
            which only a call that allows it is given.
        inlier_count, match_count: 2D-3D matches that agree with the pose, and all that were tried.
        reprojection_error_px: median of the inliers, pixels of the processed image.
        capture_time, session_from_camera: as they were sent.
    """

    world_from_camera: RigidTransform
    covariance: Array | None
    accuracy: Accuracy | None
    pose_stage: str
    inlier_count: int
    match_count: int
    reprojection_error_px: float
    diagnostics: Diagnostics
    capture_time: datetime | None = None
    session_from_camera: RigidTransform | None = None

    @property
    def world_from_session(self) -> RigidTransform | None:
        """Puts whatever the device tracked since into the world; None if no `session_from_camera` was sent.

        The answer is of the moment of capture, and the device has moved on: its pose now is `world_from_session` times
        its own `session_from_camera` now.
        """
        if self.session_from_camera is None:
            return None
        return self.world_from_camera.compose(self.session_from_camera.inverse())


@dataclass(frozen=True, eq=False)
class Rejected:
    """The server could not localize the photograph.

    Attributes:
        reason: for programs: the value of RejectionReason without its prefix, "LOW_OVERLAP".
        message: one sentence for a person, with the numbers that decided.
        capture_time, session_from_camera: as they were sent.
    """

    reason: str
    message: str
    diagnostics: Diagnostics
    capture_time: datetime | None = None
    session_from_camera: RigidTransform | None = None


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


def scene_from_message(message: reference_pb.Scene) -> Scene:
    """Scene of a message."""
    return Scene(
        scene_id=names.parse_scene_name(message.name),
        generation=message.generation,
        reference_count=message.reference_count,
        create_time=message.create_time.ToDatetime(timezone.utc),
    )


def reference_from_message(message: reference_pb.Reference) -> Reference:
    """Reference of a message."""
    scene_id, reference_id = names.parse_reference_name(message.name)
    return Reference(
        scene_id=scene_id,
        reference_id=reference_id,
        camera=wire.camera_from_message(message.intrinsics, "intrinsics"),
        world_from_camera=wire.transform_from_message(message.world_from_camera, "world_from_camera"),
        image_sha256=message.image_sha256,
        feature_count=message.feature_count,
        create_time=message.create_time.ToDatetime(timezone.utc),
        image=message.image or None,
    )


def retrieved_from_message(message: reference_pb.RetrievedReference) -> RetrievedReference:
    """Retrieved reference of a message."""
    pose = wire.transform_from_message(message.world_from_camera, "world_from_camera")
    return RetrievedReference(message.name, message.similarity, pose)


def audit_from_message(message: reference_pb.ReferenceAudit) -> ReferenceAudit:
    """Audit of a message."""
    return ReferenceAudit(
        name=message.name,
        verdict=_value_name(reference_pb.AuditVerdict, message.verdict),
        message=message.message,
        neighbour_count=message.neighbour_count,
        match_count=message.match_count,
        inlier_count=message.inlier_count,
        reprojection_error_px=message.reprojection_error_px,
        position_offset_m=message.position_offset_m,
        rotation_offset_deg=message.rotation_offset_deg,
        focal_ratio=message.focal_ratio,
        other=message.other,
    )


def coverage_from_message(message: reference_pb.CheckCoverageResponse) -> Coverage:
    """Coverage of a message."""
    return Coverage(
        verdict=_value_name(reference_pb.CoverageVerdict, message.verdict),
        message=message.message,
        expected_match_count=message.expected_match_count,
        image_share=message.image_share,
        position_68_m=message.position_68_m or None,
        references=tuple(message.references),
    )


def answer_from_message(message: localization_pb.LocalizeResponse) -> LocalizationResult | Rejected:
    """Answer of a message."""
    diagnostics = _diagnostics_from_message(message.diagnostics)
    capture_time = message.capture_time.ToDatetime(timezone.utc) if message.HasField("capture_time") else None
    session_from_camera = (
        wire.transform_from_message(message.session_from_camera, "session_from_camera")
        if message.HasField("session_from_camera")
        else None
    )
    if message.WhichOneof("outcome") == "rejection":
        reason = _value_name(localization_pb.RejectionReason, message.rejection.reason)
        return Rejected(reason, message.rejection.message, diagnostics, capture_time, session_from_camera)
    found = message.localization
    return LocalizationResult(
        world_from_camera=wire.transform_from_message(found.world_from_camera, "localization.world_from_camera"),
        covariance=np.array(found.covariance.row_major).reshape(6, 6) if found.HasField("covariance") else None,
        accuracy=_accuracy_from_message(found.accuracy) if found.HasField("accuracy") else None,
        pose_stage=_value_name(localization_pb.PoseStage, found.pose_stage),
        inlier_count=found.inlier_count,
        match_count=found.match_count,
        reprojection_error_px=found.reprojection_error_px,
        diagnostics=diagnostics,
        capture_time=capture_time,
        session_from_camera=session_from_camera,
    )


def _accuracy_from_message(message: localization_pb.Accuracy) -> Accuracy:
    return Accuracy(
        position_68_m=message.position_68_m,
        position_95_m=message.position_95_m,
        rotation_68_deg=message.rotation_68_deg,
        rotation_95_deg=message.rotation_95_deg,
        calibrated=message.calibrated,
    )


def _diagnostics_from_message(message: localization_pb.Diagnostics) -> Diagnostics:
    scale = message.scale
    return Diagnostics(
        request_id=message.request_id,
        backend=message.backend,
        weights_sha256=message.weights_sha256,
        features=message.features,
        variant=_value_name(localization_pb.Variant, message.variant),
        store_generation=message.store_generation,
        references=tuple(
            ReferenceUse(use.name, use.match_count, use.inlier_count, use.similarity) for use in message.references
        ),
        scale=ScaleEstimate(
            scale.metres_per_unit, _value_name(localization_pb.ScaleStage, scale.stage), scale.deviation
        )
        if message.HasField("scale")
        else None,
        stage_s={timing.stage: _seconds(timing.duration) for timing in message.stages},
        queue_s=_seconds(message.queue_duration),
        total_s=_seconds(message.total_duration),
        processed_width_px=message.processed_width_px,
        processed_height_px=message.processed_height_px,
        server_version=message.server_version,
        retrieval=message.retrieval,
    )


def _seconds(duration: Any) -> float:
    return float(duration.ToNanoseconds()) / 1e9


def _value_name(enum: wire.ProtoEnum, number: int) -> str:
    """REJECTION_REASON_LOW_OVERLAP becomes "LOW_OVERLAP"; a value newer than this client, its number as text."""
    if number not in enum.values():
        return str(number)
    return str(enum.Name(number)).removeprefix(wire.enum_prefix(enum))
