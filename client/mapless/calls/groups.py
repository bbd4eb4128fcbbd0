"""Where several photographs were taken that belong together: those of a rig, or of a sequence."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from .. import wire
from ..axes import Axes
from ..exchange import Call, Exchange
from ..geometry import RigidTransform
from ..groups import (
    GroupRejected,
    RigImage,
    RigLocalization,
    SequenceFrame,
    SequenceLocalization,
    rig_from_message,
    sequence_from_message,
)
from ..requests import read_image
from ..v1 import localization_service_pb2 as pb
from .localization import SERVICE
from .naming import enum_value, reference_name, scene_name


def localize_rig(
    images: Sequence[RigImage],
    scene: str,
    *,
    reference_count: int = 0,
    coverage: float = 0.0,
    capture_time: datetime | None = None,
    session_from_rig: RigidTransform | None = None,
    timeout_s: float | None = None,
) -> Exchange[RigLocalization | GroupRejected]:
    """Where a rig was: several cameras that are mounted on one another, which took a photograph each at one moment.

    One pose for all: cameras that see too little alone help one another.

    Args:
        images: what they took, 1 to 8.
        scene: where to look.
        reference_count: how many references the server chooses for each, if it does; 0 is its default.
        coverage: see `localize`; decides which photographs are believed alone.
        capture_time: when they were taken, with time zone; echoed.
        session_from_rig: where the device believed its rig to be then, OpenCV's axes; what makes
            `RigLocalization.world_from_session`.
        timeout_s: deadline of the call.
    """
    request = pb.LocalizeRigRequest(
        scene=scene_name(scene),
        images=[
            pb.RigImage(
                image=read_image(image.image),
                intrinsics=wire.camera_to_message(image.camera),
                rig_from_camera=wire.transform_to_message(image.rig_from_camera),
                references=[reference_name(scene, reference) for reference in image.references],
            )
            for image in images
        ],
        options=pb.LocalizeOptions(reference_count=reference_count, coverage=coverage),
    )
    if capture_time is not None:
        request.capture_time.FromDatetime(capture_time)
    if session_from_rig is not None:
        request.session_from_rig.CopyFrom(wire.transform_to_message(session_from_rig))
    response = yield Call(f"{SERVICE}/LocalizeRig", request, pb.LocalizeRigResponse, timeout_s)
    return rig_from_message(response)


def localize_sequence(
    frames: Sequence[SequenceFrame],
    scene: str,
    *,
    estimate_session_scale: bool = False,
    reference_count: int = 0,
    coverage: float = 0.0,
    axes: Axes | str = "",
    timeout_s: float | None = None,
) -> Exchange[SequenceLocalization | GroupRejected]:
    """Where a device was, by a few photographs and the poses that it tracked meanwhile, which may drift.

    Args:
        frames: 2 to 16 photographs with the device's poses, the oldest first.
        scene: where to look.
        estimate_session_scale: whether the unit of the device's poses is unknown; then it has to have moved.
        reference_count: how many references the server chooses for each, if it does; 0 is its default.
        coverage: see `localize`; decides which photographs are believed alone.
        axes: "opencv" (default), "arkit", "arcore", "unity", "ros", or one of `Axes`: of the device's poses and of
            `SequenceLocalization.world_from_session`.
        timeout_s: deadline of the call.
    """
    request = pb.LocalizeSequenceRequest(
        scene=scene_name(scene),
        frames=[_frame_to_message(frame, scene) for frame in frames],
        estimate_session_scale=estimate_session_scale,
        options=pb.LocalizeOptions(reference_count=reference_count, coverage=coverage, axes=enum_value(pb.Axes, axes)),
    )
    response = yield Call(f"{SERVICE}/LocalizeSequence", request, pb.LocalizeSequenceResponse, timeout_s)
    return sequence_from_message(response)


def _frame_to_message(frame: SequenceFrame, scene: str) -> pb.SequenceFrame:
    message = pb.SequenceFrame(
        image=read_image(frame.image),
        intrinsics=wire.camera_to_message(frame.camera),
        session_from_camera=wire.transform_to_message(frame.session_from_camera),
        references=[reference_name(scene, reference) for reference in frame.references],
    )
    if frame.capture_time is not None:
        message.capture_time.FromDatetime(frame.capture_time)
    return message
