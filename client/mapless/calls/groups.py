"""Localization of photographs together: of a rig, and of a sequence."""

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import TypeVar

from .. import wire
from ..axes import Axes
from ..connection import Connection
from ..depth import depth_to_message
from ..geometry import RigidTransform
from ..groups import GroupRejected, RigImage, RigLocalization, SequenceFrame, SequenceLocalization
from ..messages import rig_from_message, sequence_from_message
from ..names import reference_names
from ..priors import set_priors
from ..requests import read_image, read_mask
from ..v1 import localization_service_pb2 as pb
from .localization import check_depths, options_to_message, set_scenes, uncertainty_to_message

M = TypeVar("M", pb.RigImage, pb.SequenceFrame)


async def localize_rig(
    connection: Connection,
    images: Sequence[RigImage],
    scene: str = "",
    *,
    scenes: Sequence[str] = (),
    group: Mapping[str, str] | None = None,
    prior_scene: str = "",
    reference_count: int = 0,
    coverage: float = 0.0,
    confidential: bool = False,
    allow_adoption: bool = False,
    include_imprecise_pose: bool = False,
    capture_time: datetime | None = None,
    session_from_rig: RigidTransform | None = None,
    timeout_s: float | None = None,
) -> RigLocalization | GroupRejected:
    """Localizes a rig from photographs that its cameras took at the same moment.

    One pose is estimated from all photographs together, which can succeed where each photograph alone fails.

    Args:
        images: the photographs, 1 to 8.
        scene: the scene to localize in. Exactly one of this, `scenes` and `group` is required.
        scenes, group: where the server finds the scene by the photographs, which must name no references; see
            `localize`.
        prior_scene: see `localize`; for the priors of all photographs.
        reference_count: number of references that the server chooses for each photograph; 0 for its default.
        coverage: see `localize`; holds for the joint pose, and for each photograph alone.
        confidential: see `localize`.
        allow_adoption: see `localize`; concerns photographs that are localized alone, see `ImageReport.diagnostics`.
        include_imprecise_pose: see `localize`; concerns `ImageReport.hypotheses_alone`.
        capture_time: time of the photographs, with time zone; returned with the answer.
        session_from_rig: the device's own pose of the rig at that time, OpenCV's axes; used for
            `RigLocalization.world_from_session`.
        timeout_s: deadline of the call.
    """
    request = pb.LocalizeRigRequest(
        images=[
            await connection.unblocked(_rig_image_to_message, image, scene, field)
            for field, image in wire.listed(images, RigImage, "images")
        ],
        options=options_to_message(
            reference_count=reference_count,
            coverage=coverage,
            confidential=confidential,
            allow_adoption=allow_adoption,
            include_imprecise_pose=include_imprecise_pose,
        ),
    )
    set_scenes(request, scene, scenes, group, prior_scene)
    if capture_time is not None:
        wire.set_time(request.capture_time, capture_time, "capture_time")
    if session_from_rig is not None:
        request.session_from_rig.CopyFrom(wire.transform_to_message(session_from_rig, "session_from_rig"))
    answer = await connection.call("LocalizeRig", request, rig_from_message, timeout_s)
    check_depths(request.images, answer.images)
    return answer


async def localize_sequence(
    connection: Connection,
    frames: Sequence[SequenceFrame],
    scene: str = "",
    *,
    scenes: Sequence[str] = (),
    group: Mapping[str, str] | None = None,
    prior_scene: str = "",
    estimate_session_scale: bool = False,
    reference_count: int = 0,
    coverage: float = 0.0,
    confidential: bool = False,
    allow_adoption: bool = False,
    include_imprecise_pose: bool = False,
    axes: Axes | str = "",
    timeout_s: float | None = None,
) -> SequenceLocalization | GroupRejected:
    """Localizes a device from a few photographs and the poses that it tracked meanwhile, which may drift or jump.

    Where the photographs contradict the tracking, the sequence is cut, and the photographs after the cut are localized
    without the earlier ones (`SequenceLocalization.jumps`).

    Args:
        frames: 2 to 16 photographs with the device's poses, the oldest first.
        scene: the scene to localize in. Exactly one of this, `scenes` and `group` is required.
        scenes, group: where the server finds the scene by the photographs, which must name no references; see
            `localize`.
        prior_scene: see `localize`; for the priors of all photographs.
        estimate_session_scale: whether the scale of the device's poses is unknown; the device must have moved.
        reference_count: number of references that the server chooses for each photograph; 0 for its default.
        coverage: see `localize`; holds for the joint pose, and for each photograph alone.
        confidential: see `localize`.
        allow_adoption: see `localize`; concerns photographs that are localized alone, see `ImageReport.diagnostics`.
        include_imprecise_pose: see `localize`; concerns `ImageReport.hypotheses_alone`.
        axes: "opencv" (default), "arkit", "arcore", "unity", "ros", or one of `Axes`: the axes of the device's poses
            and of `SequenceLocalization.world_from_session`.
        timeout_s: deadline of the call.
    """
    request = pb.LocalizeSequenceRequest(
        frames=[
            await connection.unblocked(_frame_to_message, frame, scene, field)
            for field, frame in wire.listed(frames, SequenceFrame, "frames")
        ],
        options=options_to_message(
            reference_count=reference_count,
            coverage=coverage,
            confidential=confidential,
            allow_adoption=allow_adoption,
            include_imprecise_pose=include_imprecise_pose,
            axes=wire.enum_value(pb.Axes, axes),
        ),
    )
    set_scenes(request, scene, scenes, group, prior_scene)
    wire.set_numbers(request, {"estimate_session_scale": estimate_session_scale})
    answer = await connection.call("LocalizeSequence", request, sequence_from_message, timeout_s)
    check_depths(request.frames, answer.images)
    return answer


def _photograph_to_message(message: M, given: RigImage | SequenceFrame, scene: str, field: str) -> M:
    """Sets what the photographs of rigs and of sequences have in common; reads the file. Errors name the field."""
    message.image = read_image(given.image, f"{field}.image")
    mask = read_mask(given.mask, f"{field}.mask")
    if mask is not None:
        message.mask = mask
    if given.depth is not None:
        message.depth.CopyFrom(depth_to_message(given.depth, f"{field}.depth"))
    if given.camera is not None:
        message.intrinsics.CopyFrom(wire.camera_to_message(given.camera, f"{field}.camera"))
    if given.intrinsics_uncertainty is not None:
        uncertainty = uncertainty_to_message(given.intrinsics_uncertainty, f"{field}.intrinsics_uncertainty")
        message.intrinsics_uncertainty.CopyFrom(uncertainty)
    if given.references:
        message.references.extend(reference_names(scene, given.references))
    set_priors(message, given.priors, f"{field}.priors")
    return message


def _rig_image_to_message(image: RigImage, scene: str, field: str) -> pb.RigImage:
    pose = wire.transform_to_message(image.rig_from_camera, f"{field}.rig_from_camera")
    return _photograph_to_message(pb.RigImage(rig_from_camera=pose), image, scene, field)


def _frame_to_message(frame: SequenceFrame, scene: str, field: str) -> pb.SequenceFrame:
    pose = wire.transform_to_message(frame.session_from_camera, f"{field}.session_from_camera")
    message = pb.SequenceFrame(session_from_camera=pose)
    if frame.capture_time is not None:
        wire.set_time(message.capture_time, frame.capture_time, f"{field}.capture_time")
    return _photograph_to_message(message, frame, scene, field)
