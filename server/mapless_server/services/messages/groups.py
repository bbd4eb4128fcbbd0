"""Messages of rigs and sequences: requests with several photographs, and their responses."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from mapless import wire
from mapless.axes import WORLD_FROM_RIGHT_HANDED, Axes, pose_from
from mapless.geometry import Array, RigidTransform, Similarity
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.engine.query import Query, SceneQuestion
from mapless_server.method.bundle.estimate import accuracy_from_covariance
from mapless_server.method.options import ChosenCamera, IntrinsicsSource, LocalizeOptions, Variant
from mapless_server.method.rejection import Rejection
from mapless_server.scenes import ANYWHERE
from mapless_server.security import key_of
from mapless_server.store import SceneAttributes

from .answers import (
    MAX_SESSION_COORDINATE_M,
    AnswerFrames,
    accuracy_to_message,
    axes_from_message,
    covariance_to_message,
    diagnostics_to_message,
    geo_pose_to_message,
    rejection_to_message,
    result_to_rejection,
    scene_to_name,
    set_used_intrinsics,
)
from .enums import enum_to_message, message_of
from .priors import needs_attributes, priors_from_message
from .queries import (
    MAX_CANDIDATES,
    MAX_REFERENCES,
    check_capture_time,
    check_prior_scene,
    options_from_message,
    photo_from_message,
    reference_count_from_message,
    reference_ids_from_names,
    with_depth,
)
from .radii import ReportedRadii
from .uncertainty import uncertain_options

if TYPE_CHECKING:
    from mapless_server.engine.groups import GroupResult
    from mapless_server.engine.options import EngineOptions
    from mapless_server.method.groups.images import PosedImage
    from mapless_server.method.groups.rig import RigEstimate
    from mapless_server.method.groups.sequence import SequenceEstimate

GroupRequest = pb.LocalizeRigRequest | pb.LocalizeSequenceRequest
Photograph = pb.RigImage | pb.SequenceFrame

Asked = TypeVar("Asked")

PRIORS = ("position_prior", "heading_prior", "geo_position_prior", "gravity_prior", "pose_prior")
"""Fields of a photograph, the same of all requests."""


def queries_from_message(
    request: GroupRequest,
    list_name: str,
    bounds: tuple[int, int],
    tenant: str,
    engine: EngineOptions,
    attributes: SceneAttributes,
) -> tuple[Query, ...]:
    """Converts the photographs of a request, in its field `list_name`, to queries of the tenant.

    `bounds` are the least and the largest number of them. The scene's attributes may be empty unless `needs_attributes`
    is true for a photograph. FieldError and InvalidArgument name the wrong field, "images[2].intrinsics".
    """
    scene_id = wire.scene_id_from_name(request.scene, "scene")
    check_prior_scene(request)
    most = MAX_CANDIDATES if request.options.rerank_references else MAX_REFERENCES

    def in_scene(message: Photograph) -> tuple[SceneQuestion, tuple[str, ...]]:
        reference_ids = reference_ids_from_names(message.references, scene_id, most)
        narrowing, priors = priors_from_message(message, attributes)
        known = attributes if needs_attributes(message) else None
        return SceneQuestion(key_of(tenant, scene_id), narrowing, priors, known), reference_ids

    asked = _asked(request, list_name, bounds, in_scene)
    return _queries(request, list_name, engine, asked)


def queries_among(
    request: GroupRequest,
    list_name: str,
    bounds: tuple[int, int],
    engine: EngineOptions,
    questions: Callable[[pb.LocalizeRequest], Sequence[SceneQuestion]],
) -> tuple[Query, ...]:
    """Converts the photographs of a request with several scenes to queries among them.

    `questions` finds what the priors of a photograph say in each scene. FieldError and InvalidArgument as for one.
    """

    def among(message: Any) -> Sequence[SceneQuestion]:
        alone = pb.LocalizeRequest(prior_scene=request.prior_scene, references=message.references)
        for name in PRIORS:
            if message.HasField(name):
                getattr(alone, name).CopyFrom(getattr(message, name))
        return questions(alone)

    found = _asked(request, list_name, bounds, among)
    first = [(SceneQuestion(it[0].scene_key, ANYWHERE), ()) for it in found]
    queries = _queries(request, list_name, engine, first)
    return tuple(replace(query, scenes=scenes) for query, scenes in zip(queries, found, strict=True))


def _asked(
    request: GroupRequest, list_name: str, bounds: tuple[int, int], asked: Callable[[Photograph], Asked]
) -> list[Asked]:
    """Reads the question about each photograph; FieldError with its path in the request."""
    if isinstance(request, pb.LocalizeRigRequest):
        check_capture_time(request)
    messages = getattr(request, list_name)
    least, most = bounds
    if not least <= len(messages) <= most:
        raise FieldError(list_name, f"must be {least} to {most}, are {len(messages)}")
    found = []
    for i, message in enumerate(messages):
        with _within(f"{list_name}[{i}]"):
            if isinstance(message, pb.SequenceFrame):
                check_capture_time(message)
            found.append(asked(message))
    return found


def _queries(
    request: GroupRequest,
    list_name: str,
    engine: EngineOptions,
    asked: Sequence[tuple[SceneQuestion, tuple[str, ...]]],
) -> tuple[Query, ...]:
    options = _options_of(request, engine.coverage)
    count, queries = reference_count_from_message(request.options), []
    for i, (message, (question, reference_ids)) in enumerate(zip(getattr(request, list_name), asked, strict=True)):
        path = f"{list_name}[{i}]"
        photo = photo_from_message(message, path, engine.image_limits, needs_intrinsics=False)
        queries.append(
            Query(
                scene_key=question.scene_key,
                reference_ids=reference_ids,
                photo=with_depth(photo, message, path, engine.image_limits),
                narrowing=question.narrowing,
                reference_count=count,
                options=uncertain_options(options, message, photo, path),
                rerank=request.options.rerank_references and bool(reference_ids),
                priors=question.priors,
                is_part=True,
                is_generic=request.options.ignore_calibration,
                attributes=question.attributes,
            )
        )
    if isinstance(request, pb.LocalizeSequenceRequest):
        _check_one_size(queries)
    return tuple(queries)


def _check_one_size(frames: Sequence[Query]) -> None:
    """Raises FieldError if frames without intrinsics differ in size: one camera has taken them all."""
    sizes = {i: (it.photo.camera.width_px, it.photo.camera.height_px) for i, it in enumerate(frames) if it.photo.exif}
    first = min(sizes, default=0)
    for i, size in sizes.items():
        if size != sizes[first]:
            (width_px, height_px), (other_px, others_px) = size, sizes[first]
            raise FieldError(
                f"frames[{i}].intrinsics",
                f"is required: a sequence has one camera, and of the frames without intrinsics this one has "
                f"{width_px}x{height_px} pixels, frames[{first}] {other_px}x{others_px}",
            )


def _options_of(request: pb.LocalizeRigRequest | pb.LocalizeSequenceRequest, coverage: float) -> LocalizeOptions:
    """The request's options; FieldError for those that only a single photograph has. `coverage` is the default."""
    options = options_from_message(request.options, coverage)
    if options.variant is not Variant.BEST:
        message = f"must be BEST, the default, for several photographs, is {options.variant.name}"
        raise FieldError("options.variant", message)
    if isinstance(request, pb.LocalizeRigRequest) and axes_from_message(request.options) is not Axes.OPENCV:
        raise FieldError("options.axes", "must be OPENCV, the default, for a rig")
    return options


@contextmanager
def _within(path: str) -> Iterator[None]:
    """Prepends this path to the field of an error, unless that is the scene of all photographs' priors."""
    try:
        yield
    except FieldError as error:
        if error.field == "prior_scene":
            raise
        message = str(error).removeprefix(f"{error.field}: ")
        raise FieldError(wire.joined(path, error.field), message) from None


def poses_from_message(messages: Sequence[Any], list_name: str, pose_name: str) -> tuple[RigidTransform, ...]:
    """Reads the pose of each photograph of a list; FieldError names one that is missing or not a pose."""
    poses = []
    for i, message in enumerate(messages):
        path = f"{list_name}[{i}].{pose_name}"
        if not message.HasField(pose_name):
            raise FieldError(path, "is required")
        poses.append(wire.transform_from_message(getattr(message, pose_name), path, MAX_SESSION_COORDINATE_M))
    return tuple(poses)


def session_poses_from_message(request: pb.LocalizeSequenceRequest) -> tuple[Axes, tuple[RigidTransform, ...]]:
    """Reads the caller's axes, and the poses that its device tracked, converted to OpenCV's axes."""
    axes = axes_from_message(request.options)
    poses = poses_from_message(request.frames, "frames", "session_from_camera")
    return axes, tuple(pose_from(axes, pose) for pose in poses)


def with_tracked_motion(
    queries: Sequence[Query], request: pb.LocalizeSequenceRequest, session_from_camera: Sequence[RigidTransform]
) -> tuple[Query, ...]:
    """The queries of a sequence's frames; with a rolling shutter they have how cameras moved, by tracked poses."""
    shutters = [it.options.shutter for it in queries]
    if not any(shutters):
        return tuple(queries)
    from mapless_server.method.groups.velocity import tracked_motions  # services do not load what computes

    has_time = [it.HasField("capture_time") for it in request.frames]
    first = next((it.capture_time.seconds for it in request.frames if it.HasField("capture_time")), 0)
    times = [
        it.capture_time.seconds - first + 1e-9 * it.capture_time.nanos if known else math.nan
        for it, known in zip(request.frames, has_time, strict=True)
    ]
    motions = tracked_motions(session_from_camera, times, shutters, request.estimate_session_scale)
    return tuple(
        replace(it, options=replace(it.options, shutter=shutter and replace(shutter, tracked=motion)))
        for it, shutter, motion in zip(queries, shutters, motions, strict=True)
    )


def session_from_rig_from_message(request: pb.LocalizeRigRequest) -> RigidTransform | None:
    """Reads the rig's pose as the device tracked it, in OpenCV's axes; FieldError if it is not a pose."""
    if not request.HasField("session_from_rig"):
        return None
    return wire.transform_from_message(request.session_from_rig, "session_from_rig", MAX_SESSION_COORDINATE_M)


def rig_to_message(
    outcome: RigEstimate | Rejection,
    group: GroupResult,
    queries: Sequence[Query],
    request: pb.LocalizeRigRequest,
    session_from_rig: RigidTransform | None,
) -> pb.LocalizeRigResponse:
    """Makes the response, without the call's id."""
    if isinstance(outcome, Rejection):
        response = pb.LocalizeRigResponse(rejection=rejection_to_message(outcome, group.results[-1].scene_key))
    else:
        world_from_rig = wire.transform_to_message(outcome.world_from_rig)
        message = pb.RigLocalization(world_from_rig=world_from_rig, trust=outcome.trust)
        _set_support(message, outcome.matched, outcome.covariance)
        if session_from_rig is not None:
            world_from_session = outcome.world_from_rig.compose(session_from_rig.inverse())
            message.world_from_session.CopyFrom(wire.transform_to_message(world_from_session))
        attributes = group.results[0].attributes
        message.arbitrary_unit = attributes.arbitrary_unit
        if attributes.datum is not None:
            message.geo_pose.CopyFrom(geo_pose_to_message(outcome.world_from_rig, attributes.datum))
        response = pb.LocalizeRigResponse(localization=message)
    response.scene = scene_of_group(group)
    frames = AnswerFrames(Axes.OPENCV, None, request.options.include_imprecise_pose)
    response.images.extend(_reports(outcome, group, queries, [frames] * len(queries)))
    for echoed in ("capture_time", "session_from_rig"):
        if request.HasField(echoed):
            getattr(response, echoed).CopyFrom(getattr(request, echoed))
    return response


def sequence_to_message(
    outcome: SequenceEstimate | Rejection,
    group: GroupResult,
    queries: Sequence[Query],
    request: pb.LocalizeSequenceRequest,
    axes: Axes,
) -> pb.LocalizeSequenceResponse:
    """Makes the response, without the call's id."""
    if isinstance(outcome, Rejection):
        response = pb.LocalizeSequenceResponse(rejection=rejection_to_message(outcome, group.results[-1].scene_key))
    else:
        session = outcome.world_from_session
        message = pb.SequenceLocalization(
            world_from_session=wire.transform_to_message(_in_axes(session, axes)),
            session_scale=session.scale,
            session_scale_sigma=session.scale * outcome.scale_sigma,
            axes=enum_to_message(axes, pb.Axes),
            arbitrary_unit=group.results[0].attributes.arbitrary_unit,
            jumps=[pb.TrackingJump(**asdict(jump)) for jump in outcome.jumps],
            trust=outcome.trust,
        )
        for frame, pose in zip(request.frames, outcome.world_from_camera, strict=True):
            captured = message.poses.add(world_from_camera=wire.transform_to_message(pose))
            if frame.HasField("capture_time"):
                captured.capture_time.CopyFrom(frame.capture_time)
        _set_support(message, outcome.matched, outcome.covariances[-1])
        response = pb.LocalizeSequenceResponse(localization=message)
    response.scene = scene_of_group(group)
    includes = request.options.include_imprecise_pose
    sessions = poses_from_message(request.frames, "frames", "session_from_camera")
    frames = [AnswerFrames(axes, session, includes) for session in sessions]
    response.images.extend(_reports(outcome, group, queries, frames))
    return response


def scene_of_group(group: GroupResult) -> str:
    """Name of the scene of a group's photographs; of an ambiguous one the one that its last photograph matches best."""
    return scene_to_name(group.results[-1].scene_key)


def _in_axes(world_from_session: Similarity, axes: Axes) -> RigidTransform:
    """Rotation and translation of a similarity between world and session, both in these axes."""
    mirror = WORLD_FROM_RIGHT_HANDED[axes]
    return RigidTransform(mirror @ world_from_session.rotation @ mirror.T, mirror @ world_from_session.translation)


def _set_support(
    message: pb.RigLocalization | pb.SequenceLocalization, matched: Sequence[PosedImage], covariance: Array
) -> None:
    """Sets the fields that both kinds of localizations have: covariance, radii and counts."""
    # Not calibrated: a scene's calibrations are of single photographs.
    radii = ReportedRadii(accuracy_from_covariance(covariance), covariance)
    message.covariance.CopyFrom(covariance_to_message(radii.covariance))
    message.accuracy.CopyFrom(accuracy_to_message(radii))
    message.inlier_count = sum(int(it.inliers.sum()) for it in matched)
    message.match_count = sum(len(it.matches) for it in matched)
    message.reprojection_error_px = float(np.median(np.concatenate([it.errors_px[it.inliers] for it in matched])))


def _reports(
    outcome: RigEstimate | SequenceEstimate | Rejection,
    group: GroupResult,
    queries: Sequence[Query],
    frames: Sequence[AnswerFrames],
) -> list[pb.ImageReport]:
    matched = {} if isinstance(outcome, Rejection) else {it.source.image: it for it in outcome.matched}
    checks = {} if isinstance(outcome, Rejection) else outcome.prior_checks
    reports = []
    for i, (result, query) in enumerate(zip(group.results, queries, strict=True)):
        alone = result.answer
        report = pb.ImageReport(diagnostics=diagnostics_to_message(result, query))
        report.diagnostics.queue_duration.FromNanoseconds(round(1e9 * group.queued_s[i]))
        report.diagnostics.total_duration.FromNanoseconds(round(1e9 * group.seconds[i]))
        report.diagnostics.processor_duration.FromNanoseconds(round(1e9 * group.processor_s[i]))
        if isinstance(alone.outcome, Rejection):
            report.alone.CopyFrom(result_to_rejection(result, query.options, frames[i]))
        known = result.camera
        if known is None and query.photo.exif is None:
            known = ChosenCamera(query.photo.camera, None, IntrinsicsSource.GIVEN)
        set_used_intrinsics(report, known)
        report.prior_checks.extend(message_of(it, pb.PriorCheck) for it in checks.get(i, ()))
        if i in matched:
            report.inlier_count = int(matched[i].inliers.sum())
            report.match_count = len(matched[i].matches)
            for use, count in zip(report.diagnostics.references, matched[i].inliers_by_reference(), strict=True):
                use.inlier_count = count
        elif alone.support is not None:
            report.match_count = len(alone.support.matches)
        reports.append(report)
    return reports
