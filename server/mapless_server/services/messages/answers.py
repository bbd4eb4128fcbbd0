"""Messages of an answer: localization with its calibrated radii, or rejection; frames, and diagnostics."""

from dataclasses import dataclass, replace

from mapless import names, wire
from mapless.axes import Axes, covariance_to, pose_to, world_from_session_in
from mapless.geodesy import Datum, geopose
from mapless.geometry import Array, RigidTransform
from mapless.v1 import localization_service_pb2 as pb
from mapless_server import __version__
from mapless_server.engine.query import Photo, Query, Result
from mapless_server.method.bundle.estimate import (
    PosedSupport,
    accuracy_from_covariance,
    determined_intrinsics,
    viewpoint_gap,
)
from mapless_server.method.bundle.priors import IntrinsicsSigma
from mapless_server.method.judge.answer import Localization
from mapless_server.method.options import ChosenCamera, IntrinsicsSource, LocalizeOptions
from mapless_server.method.rejection import PoseHypothesis, Rejection
from mapless_server.security import SceneKey, scene_id_of
from mapless_server.store import SceneAttributes

from .enums import enum_from_message, enum_to_message, message_of
from .radii import Conditions, ReportedRadii, reported_radii


@dataclass(frozen=True, eq=False)
class AnswerFrames:
    """The form in which a caller requests its answer.

    Attributes:
        axes: axes of its camera, besides OpenCV's.
        session_from_camera: the device's pose at the time of capture, in these axes; None if the request has none.
        includes_imprecise: whether a pose that is rejected for its radius alone goes with the rejection.
    """

    axes: Axes
    session_from_camera: RigidTransform | None
    includes_imprecise: bool = False


def answer_frames_of(request: pb.LocalizeRequest) -> AnswerFrames:
    """Returns the frames of a request; FieldError names the wrong field."""
    options = request.options
    return AnswerFrames(axes_from_message(options), session_from_message(request), options.include_imprecise_pose)


def outcome_to_message(
    result: Result, options: LocalizeOptions, frames: AnswerFrames, photo: Photo
) -> pb.LocalizeResponse:
    """Makes the response to a photograph, with the outcome only."""
    outcome = result.answer.outcome
    if isinstance(outcome, Rejection):
        rejection = result_to_rejection(result, options, frames)
        set_used_intrinsics(rejection, used_camera(result, options, photo))
        return pb.LocalizeResponse(rejection=rejection, scene=scene_to_name(result.scene_key))
    radii = None if outcome.covariance is None else radii_of(result, options, outcome.covariance)
    localization = _localization_to_message(outcome, radii, result.attributes, frames)
    set_used_intrinsics(localization, used_camera(result, options, photo))
    return pb.LocalizeResponse(localization=localization, scene=scene_to_name(result.scene_key))


def scene_to_name(scene_key: SceneKey | None) -> str:
    """Name of the scene of a result; empty if there is none."""
    return "" if scene_key is None else names.scene_name(scene_id_of(scene_key))


def used_camera(result: Result, options: LocalizeOptions, photo: Photo) -> ChosenCamera | None:
    """The camera that a photograph was read with, as its matches leave it; None where none was given or found."""
    chosen, support = result.camera, result.answer.support
    if chosen is None:
        if photo.exif is not None:
            return None
        chosen = ChosenCamera(photo.camera, options.intrinsics, IntrinsicsSource.GIVEN)
    found = determined_intrinsics(support) if isinstance(support, PosedSupport) else None
    return chosen if found is None else replace(chosen, camera=found[0], sigma=found[1])


def set_used_intrinsics(message: pb.Localization | pb.Rejection | pb.ImageReport, camera: ChosenCamera | None) -> None:
    """Sets the intrinsics that a photograph was read with; leaves them out where none were given or found."""
    if camera is None:
        return
    sigma = camera.sigma or IntrinsicsSigma()
    message.used_intrinsics.intrinsics.CopyFrom(wire.camera_to_message(camera.camera))
    message.used_intrinsics.source = enum_to_message(camera.source, pb.IntrinsicsSource)
    message.used_intrinsics.focal_sigma_px = sigma.focal_share * camera.camera.focal_x_px


def result_to_rejection(result: Result, options: LocalizeOptions, frames: AnswerFrames) -> pb.Rejection:
    """Message of the rejection that a result is, with the pose that is rejected for its radius alone, if requested."""
    rejection = result.answer.outcome
    assert isinstance(rejection, Rejection)
    message, pose = rejection_to_message(rejection, result.scene_key), rejection.imprecise
    if pose is not None and pose.covariance is not None and frames.includes_imprecise:
        offered, radii = _hypothesis_to_message(pose, result.scene_key), radii_of(result, options, pose.covariance)
        offered.arbitrary_unit = result.attributes.arbitrary_unit
        _set_radii(offered, pose.world_from_camera, radii, result.attributes, frames)
        message.hypotheses.append(offered)
    return message


def radii_of(result: Result, options: LocalizeOptions, covariance: Array) -> ReportedRadii:
    """The reported radii of the pose of a result, by its covariance (6, 6)."""
    accuracy, support = accuracy_from_covariance(covariance), result.answer.support
    conditions = Conditions(result.tier.features, result.tier.backend, options.variant.name, __version__)
    kind, attributes = result.tier.kind, result.attributes
    if not isinstance(support, PosedSupport):
        return reported_radii(accuracy, covariance, conditions, kind, attributes, None)
    gap, by_references = viewpoint_gap(support)[0], support.estimate.reference_covariance
    return reported_radii(accuracy, covariance, conditions, kind, attributes, gap, by_references)


def _localization_to_message(
    localization: Localization, radii: ReportedRadii | None, attributes: SceneAttributes, frames: AnswerFrames
) -> pb.Localization:
    message = pb.Localization(
        world_from_camera=wire.transform_to_message(localization.world_from_camera),
        pose_stage=enum_to_message(localization.pose_stage, pb.PoseStage),
        inlier_count=localization.inlier_count,
        match_count=localization.match_count,
        reprojection_error_px=localization.reprojection_error_px,
        trust=localization.trust,
        prior_checks=[message_of(check, pb.PriorCheck) for check in localization.prior_checks],
        scale_source=enum_to_message(localization.scale_source, pb.ScaleSource),
        intrinsics_checks=[message_of(check, pb.IntrinsicsCheck) for check in localization.intrinsics_checks],
    )
    _set_radii(message, localization.world_from_camera, radii, attributes, frames)
    message.arbitrary_unit = attributes.arbitrary_unit
    return message


def _set_radii(
    message: pb.Localization | pb.Hypothesis,
    world_from_camera: RigidTransform,
    radii: ReportedRadii | None,
    attributes: SceneAttributes,
    frames: AnswerFrames,
) -> None:
    """Sets the radii of a pose, and the pose in the caller's frames."""
    if radii is not None:
        message.covariance.CopyFrom(covariance_to_message(radii.covariance))
        message.accuracy.CopyFrom(accuracy_to_message(radii))
    covariance = radii.covariance if radii else None
    set_frames(message, world_from_camera, covariance, frames.axes, frames.session_from_camera, attributes.datum)


def covariance_to_message(covariance: Array) -> pb.PoseCovariance:
    """Message of a covariance (6, 6)."""
    return pb.PoseCovariance(row_major=covariance.ravel().tolist())


CALIBRATIONS = {
    "GENERIC": pb.CALIBRATION_SOURCE_GENERIC,
    "SELF": pb.CALIBRATION_SOURCE_SELF,
    "MEASURED": pb.CALIBRATION_SOURCE_MEASURED,
}


def accuracy_to_message(radii: ReportedRadii) -> pb.Accuracy:
    """Message of radii."""
    return pb.Accuracy(
        position_68_m=radii.accuracy.position_68_m,
        position_95_m=radii.accuracy.position_95_m,
        rotation_68_deg=radii.accuracy.rotation_68_deg,
        rotation_95_deg=radii.accuracy.rotation_95_deg,
        calibrated=radii.calibration == "MEASURED",
        calibration=CALIBRATIONS[radii.calibration],
        sample_size=radii.count,
    )


def rejection_to_message(rejection: Rejection, scene_key: SceneKey | None = None) -> pb.Rejection:
    """Message of a rejection in a scene, without a pose that is rejected for its radius alone."""
    return pb.Rejection(
        reason=enum_to_message(rejection.reason, pb.RejectionReason),
        message=rejection.message,
        hint=message_of(rejection.hint, pb.Hint) if rejection.hint else None,
        hypotheses=[_hypothesis_to_message(it, scene_key) for it in rejection.hypotheses],
        intrinsics_checks=[message_of(check, pb.IntrinsicsCheck) for check in rejection.intrinsics_checks],
    )


def _hypothesis_to_message(hypothesis: PoseHypothesis, scene_key: SceneKey | None) -> pb.Hypothesis:
    return pb.Hypothesis(
        scene=names.scene_name(hypothesis.world) if hypothesis.world else scene_to_name(scene_key),
        world_from_camera=wire.transform_to_message(hypothesis.world_from_camera),
        inlier_count=hypothesis.inlier_count,
        references=hypothesis.references,
    )


def diagnostics_to_message(result: Result, query: Query) -> pb.Diagnostics:
    """Message of what was used and of the stages' times, without the call's id and durations."""
    answer, tier = result.answer, result.tier
    message = pb.Diagnostics(
        backend=tier.backend,
        weights_sha256=tier.weights_sha256,
        features=tier.features,
        variant=enum_to_message(query.options.variant, pb.Variant),
        store_generation=result.generation,
        scale=message_of(answer.scale, pb.ScaleEstimate) if answer.scale else None,
        processed_width_px=result.processed.width_px,
        processed_height_px=result.processed.height_px,
        server_version=__version__,
        retrieval=result.choice.descriptor if result.choice else "",
        stationary_keypoint_count=answer.stationary_count,
        searched_scene_count=result.searched_scene_count,
    )
    for tried in result.scenes:
        message.scenes.append(message_of(tried, pb.SceneUse, scene=scene_to_name(tried.scene_key)))
    if query.photo.depth is not None:
        message.depth_check.CopyFrom(message_of(answer.depth_check, pb.DepthCheck))
    message.references.extend(_reference_uses(result))
    for stage, seconds in result.stage_seconds.items():
        message.stages.add(stage=stage).duration.FromNanoseconds(round(1e9 * seconds))
    for it in result.attempts:
        attempt = message.attempts.add(rung=it.rung, features=it.features, outcome=it.outcome, chosen=it.is_chosen)
        attempt.duration.FromNanoseconds(round(1e9 * it.seconds))
        attempt.processor_duration.FromNanoseconds(round(1e9 * it.processor_s))
    for cut in result.cuts:
        reason = enum_to_message(cut.reason, pb.LadderCutReason)
        unmatched = cut.unmatched
        message.ladder_cuts.add(
            rung=cut.rung, features=cut.features, reason=reason, unmatched_reference_count=unmatched
        )
    for lack in result.missing:
        counts = {"reference_count": lack.reference_count, "made_reference_count": lack.made_count}
        message.missing_evidence.add(kind=lack.kind, name=lack.name, **counts)
    return message


def _reference_uses(result: Result) -> list[pb.ReferenceUse]:
    answer = result.answer
    # Counts are missing where the stage that counts was not reached.
    match_counts = answer.reference_match_counts or (0,) * len(result.references)
    inlier_counts = answer.reference_inlier_counts or (0,) * len(result.references)
    similarities = {it.key: it.similarity for it in result.choice.references} if result.choice else {}
    return [
        pb.ReferenceUse(
            name=reference.name,
            match_count=matches,
            inlier_count=inliers,
            similarity=similarities.get(reference.key, 0.0),
        )
        for reference, matches, inliers in zip(result.references, match_counts, inlier_counts, strict=True)
    ]


MAX_SESSION_COORDINATE_M = 1e7
"""No device tracks itself this far; larger coordinates are mistakes, and their squares would lose digits."""


def axes_from_message(options: pb.LocalizeOptions) -> Axes:
    """Axes of the caller's camera; FieldError if the number is not one of them."""
    return enum_from_message(options.axes, pb.Axes, Axes.OPENCV, "options.axes")


def session_from_message(request: pb.LocalizeRequest) -> RigidTransform | None:
    """The camera's pose as the device tracked it, in the request's axes; FieldError if it is not a pose."""
    if not request.HasField("session_from_camera"):
        return None
    return wire.transform_from_message(request.session_from_camera, "session_from_camera", MAX_SESSION_COORDINATE_M)


def set_frames(
    message: pb.Localization | pb.Hypothesis,
    world_from_camera: RigidTransform,
    covariance: Array | None,
    axes: Axes,
    session_from_camera: RigidTransform | None,
    datum: Datum | None,
) -> None:
    """Sets the pose in the caller's frames: `in_axes`, and `geo_pose` if the scene has a datum.

    `world_from_camera` is in OpenCV's axes; the covariance (6, 6) is as reported, calibrated if the answer is, None if
    there is none. `session_from_camera` is the device's pose at the time of capture, in the caller's axes; None if the
    request has none.
    """
    framed = message.in_axes
    framed.axes = enum_to_message(axes, pb.Axes)
    framed.world_from_camera.CopyFrom(wire.transform_to_message(pose_to(axes, world_from_camera)))
    if covariance is not None:
        framed.covariance.row_major.extend(covariance_to(axes, covariance).ravel().tolist())
    if session_from_camera is not None:
        world_from_session = world_from_session_in(axes, world_from_camera, session_from_camera)
        framed.world_from_session.CopyFrom(wire.transform_to_message(world_from_session))
    if datum is not None:
        message.geo_pose.CopyFrom(geo_pose_to_message(world_from_camera, datum))


def geo_pose_to_message(world_from_camera: RigidTransform, datum: Datum) -> pb.GeoPose:
    """Message of a pose on the Earth; zeros are set explicitly as values."""
    found = geopose(world_from_camera, datum)
    q = found.quaternion
    return pb.GeoPose(
        position=pb.GeoPosition(lat=found.lat, lon=found.lon, h=found.h),
        quaternion=pb.GeoQuaternion(x=q.x, y=q.y, z=q.z, w=q.w),
    )
