"""Photographs that are posed together, a rig's or a sequence's: what is sent and what is answered, as values."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from . import wire
from .answers import (
    Accuracy,
    Diagnostics,
    Hint,
    Hypothesis,
    accuracy_from_message,
    covariance_from_message,
    diagnostics_from_message,
    geo_pose_from_message,
    rejection_fields,
)
from .geodesy import GeoPose
from .geometry import Array, Camera, RigidTransform, Similarity
from .requests import ImageSource
from .v1 import localization_service_pb2 as pb
from .wire import optional


@dataclass(frozen=True, eq=False)
class RigImage:
    """What one camera of a rig took.

    Attributes:
        image: the photograph.
        camera: which took it, in pixels of the file as it is stored, before any EXIF rotation.
        rig_from_camera: where it is mounted, metres, OpenCV's axes; the rig's frame is yours to choose.
        references: what to compare it with, at most 64; none: the server chooses.
    """

    image: ImageSource
    camera: Camera
    rig_from_camera: RigidTransform
    references: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class SequenceFrame:
    """One photograph of a sequence, and what the device knew then.

    Attributes:
        image: the photograph.
        camera: which took it, in pixels of the file as it is stored, before any EXIF rotation.
        session_from_camera: where the device believed its camera to be, in the axes that the call names.
        capture_time: when it was taken, with time zone; echoed.
        references: what to compare it with, at most 64; none: the server chooses.
    """

    image: ImageSource
    camera: Camera
    session_from_camera: RigidTransform
    capture_time: datetime | None = None
    references: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ImageReport:
    """What one photograph contributed to a joint answer.

    Attributes:
        inlier_count: its 2D-3D matches that agree with the joint pose.
        match_count: its 2D-3D matches that were tried.
        rejected_alone: why it would not have been localized alone, "LOW_OVERLAP"; None if it would.
        diagnostics: what was used for it and where the time went.
    """

    inlier_count: int
    match_count: int
    rejected_alone: str | None
    diagnostics: Diagnostics


@dataclass(frozen=True, eq=False)
class RigLocalization:
    """Where a rig was.

    Attributes:
        world_from_rig: its pose at capture time.
        covariance: (6, 6) of the rig's origin, order x y z rx ry rz, metres and radians about fixed world axes.
        accuracy: radii of the same.
        inlier_count, match_count: 2D-3D matches of all photographs that agree with the pose, and all that were tried.
        reprojection_error_px: median of the inliers, pixels of the processed images.
        images: what each contributed, in order.
        world_from_session: puts whatever the device tracked since into the world; None if no `session_from_rig` was
            sent.
        geo_pose: the same pose on the Earth; None unless the scene has a datum.
        capture_time: as it was sent.
    """

    world_from_rig: RigidTransform
    covariance: Array
    accuracy: Accuracy
    inlier_count: int
    match_count: int
    reprojection_error_px: float
    images: tuple[ImageReport, ...]
    world_from_session: RigidTransform | None = None
    geo_pose: GeoPose | None = None
    capture_time: datetime | None = None


@dataclass(frozen=True, eq=False)
class SequenceLocalization:
    """Where a device was along a sequence.

    Attributes:
        world_from_session: puts whatever the device tracks after the last photograph into the world, in the axes that
            the call names; its scale is 1 unless it was to be estimated.
        scale_sigma: standard deviation of that scale; 0 unless it was to be estimated.
        world_from_camera: of each photograph, freed of drift, OpenCV's axes.
        covariance: (6, 6) of the last of them, order x y z rx ry rz, metres and radians about fixed world axes.
        accuracy: radii of the same.
        inlier_count, match_count: 2D-3D matches of all photographs that agree with the poses, and all that were tried.
        reprojection_error_px: median of the inliers, pixels of the processed images.
        images: what each contributed, in order.
        axes: of `world_from_session`, "OPENCV".
    """

    world_from_session: Similarity
    scale_sigma: float
    world_from_camera: tuple[RigidTransform, ...]
    covariance: Array
    accuracy: Accuracy
    inlier_count: int
    match_count: int
    reprojection_error_px: float
    images: tuple[ImageReport, ...]
    axes: str


@dataclass(frozen=True, eq=False)
class GroupRejected:
    """The server could not localize the photographs, not even together.

    Attributes:
        reason: for programs: the value of RejectionReason without its prefix, "LOW_OVERLAP".
        message: one sentence for a person, with the numbers that decided.
        images: what each contributed, in order; each says why it alone was not enough.
        hint, hypotheses: as of `Rejected`.
        capture_time: as it was sent.
    """

    reason: str
    message: str
    images: tuple[ImageReport, ...]
    hint: Hint | None = None
    hypotheses: tuple[Hypothesis, ...] = ()
    capture_time: datetime | None = None


def rig_from_message(message: pb.LocalizeRigResponse) -> RigLocalization | GroupRejected:
    """Answer of a message."""
    capture_time = optional(message, "capture_time", wire.time_from_message)
    if message.WhichOneof("outcome") == "rejection":
        return _rejected(message, capture_time)
    found = message.localization
    path = "localization.world_from_"
    return wire.filled(
        RigLocalization,
        found,
        world_from_rig=wire.transform_from_message(found.world_from_rig, path + "rig"),
        world_from_session=optional(found, "world_from_session", wire.transform_from_message, path + "session"),
        geo_pose=optional(found, "geo_pose", geo_pose_from_message),
        capture_time=capture_time,
        **_common(message),
    )


def sequence_from_message(message: pb.LocalizeSequenceResponse) -> SequenceLocalization | GroupRejected:
    """Answer of a message."""
    if message.WhichOneof("outcome") == "rejection":
        return _rejected(message, None)
    found = message.localization
    rigid = wire.transform_from_message(found.world_from_session, "localization.world_from_session")
    return wire.filled(
        SequenceLocalization,
        found,
        world_from_session=Similarity(found.session_scale, rigid.rotation, rigid.translation),
        scale_sigma=found.session_scale_sigma,
        world_from_camera=tuple(
            wire.transform_from_message(pose.world_from_camera, "localization.poses") for pose in found.poses
        ),
        axes=wire.value_name(pb.Axes, found.axes),
        **_common(message),
    )


def _common(message: pb.LocalizeRigResponse | pb.LocalizeSequenceResponse) -> dict[str, Any]:
    covariance = covariance_from_message(message.localization)
    return {
        "covariance": np.full((6, 6), np.nan) if covariance is None else covariance,
        "accuracy": accuracy_from_message(message.localization.accuracy),
        "images": _reports(message),
    }


def _rejected(
    message: pb.LocalizeRigResponse | pb.LocalizeSequenceResponse, capture_time: datetime | None
) -> GroupRejected:
    rejection = message.rejection
    images = _reports(message)
    return wire.filled(
        GroupRejected, rejection, images=images, capture_time=capture_time, **rejection_fields(rejection)
    )


def _reports(message: pb.LocalizeRigResponse | pb.LocalizeSequenceResponse) -> tuple[ImageReport, ...]:
    return tuple(
        wire.filled(
            ImageReport,
            image,
            rejected_alone=wire.value_name(pb.RejectionReason, image.alone.reason) if image.HasField("alone") else None,
            diagnostics=diagnostics_from_message(image.diagnostics),
        )
        for image in message.images
    )
