"""What the method says of a query, as messages."""

from __future__ import annotations

from dataclasses import dataclass

from mapless import wire
from mapless.axes import Axes, covariance_to, pose_to, world_from_session_in
from mapless.geodesy import Datum, geopose
from mapless.geometry import Array, RigidTransform
from mapless.v1 import localization_service_pb2 as pb
from mapless_server import __version__
from mapless_server.engine.query import Result
from mapless_server.method.answer import Localization
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.priors.known import PriorCheck
from mapless_server.method.rejection import Hint, Rejection
from mapless_server.method.results import MetricScale
from mapless_server.method.uncertainty.accuracy import accuracy_from_covariance
from mapless_server.store import SceneAttributes

from .factors import Claimed, Conditions, claimed
from .queries import enum_from_message, enum_to_message


@dataclass(frozen=True, eq=False)
class AnswerFrames:
    """The frames that an answer is given in, beside OpenCV's.

    Attributes:
        axes: of the caller's camera.
        session_from_camera: at the moment of capture, in these axes; None if the request has none.
    """

    axes: Axes
    session_from_camera: RigidTransform | None


def answer_frames_of(request: pb.LocalizeRequest) -> AnswerFrames:
    """The frames that a request wants its answer in; FieldError names what is wrong."""
    return AnswerFrames(axes_from_message(request.options), session_from_message(request))


def outcome_to_message(result: Result, options: LocalizeOptions, frames: AnswerFrames) -> pb.LocalizeResponse:
    """Message of an answer, with nothing in it but its outcome."""
    outcome = result.answer.outcome
    if isinstance(outcome, Rejection):
        return pb.LocalizeResponse(rejection=rejection_to_message(outcome))
    claim = claim_of(outcome.covariance, result, options)
    return pb.LocalizeResponse(localization=_localization_to_message(outcome, claim, result.attributes, frames))


def claim_of(covariance: Array | None, result: Result, options: LocalizeOptions) -> Claimed | None:
    """What is told of a pose's error, by its covariance (6, 6) and the scene's calibration; None if there is none."""
    if covariance is None:
        return None
    conditions = Conditions(result.tier.features, result.tier.backend, options.variant.name, __version__)
    return claimed(accuracy_from_covariance(covariance), covariance, conditions, result.attributes.calibration)


def _localization_to_message(
    localization: Localization, claim: Claimed | None, attributes: SceneAttributes, frames: AnswerFrames
) -> pb.Localization:
    message = pb.Localization(
        world_from_camera=wire.transform_to_message(localization.world_from_camera),
        pose_stage=enum_to_message(localization.pose_stage, pb.PoseStage),
        inlier_count=localization.inlier_count,
        match_count=localization.match_count,
        reprojection_error_px=localization.reprojection_error_px,
        trust=localization.trust,
        prior_checks=[_check_to_message(check) for check in localization.prior_checks],
    )
    if claim is not None:
        message.covariance.CopyFrom(covariance_to_message(claim.covariance))
        message.accuracy.CopyFrom(accuracy_to_message(claim))
    set_frames(
        message,
        localization.world_from_camera,
        claim.covariance if claim else None,
        frames.axes,
        frames.session_from_camera,
        attributes.datum,
    )
    return message


def covariance_to_message(covariance: Array) -> pb.PoseCovariance:
    """Message of a covariance (6, 6)."""
    return pb.PoseCovariance(row_major=covariance.ravel().tolist())


def accuracy_to_message(claim: Claimed) -> pb.Accuracy:
    """Message of radii."""
    radii = claim.accuracy
    return pb.Accuracy(
        position_68_m=radii.position_68_m,
        position_95_m=radii.position_95_m,
        rotation_68_deg=radii.rotation_68_deg,
        rotation_95_deg=radii.rotation_95_deg,
        calibrated=claim.calibrated,
    )


def _check_to_message(check: PriorCheck) -> pb.PriorCheck:
    return pb.PriorCheck(
        kind=enum_to_message(check.kind, pb.PriorKind),
        mahalanobis=check.mahalanobis,
        degrees_of_freedom=check.degrees_of_freedom,
        conflict=check.conflict,
        used=check.used,
    )


def rejection_to_message(rejection: Rejection) -> pb.Rejection:
    """Message of a rejection."""
    return pb.Rejection(
        reason=enum_to_message(rejection.reason, pb.RejectionReason),
        message=rejection.message,
        hint=_hint_to_message(rejection.hint) if rejection.hint else None,
        hypotheses=[
            pb.Hypothesis(
                world_from_camera=wire.transform_to_message(it.world_from_camera),
                inlier_count=it.inlier_count,
                references=it.references,
            )
            for it in rejection.hypotheses
        ],
    )


def _hint_to_message(hint: Hint) -> pb.Hint:
    return pb.Hint(
        stage=hint.stage,
        advice=enum_to_message(hint.advice, pb.Advice),
        message=hint.message,
        best_reference=hint.best_reference or "",
    )


def diagnostics_to_message(result: Result, options: LocalizeOptions) -> pb.Diagnostics:
    """Message of what was used and where the time went; the caller knows the call's id and durations."""
    answer, tier = result.answer, result.tier
    message = pb.Diagnostics(
        backend=tier.backend,
        weights_sha256=tier.weights_sha256,
        features=tier.features,
        variant=enum_to_message(options.variant, pb.Variant),
        store_generation=result.generation,
        scale=_scale_to_message(answer.scale) if answer.scale else None,
        processed_width_px=result.processed.width_px,
        processed_height_px=result.processed.height_px,
        server_version=__version__,
        retrieval=result.choice.descriptor if result.choice else "",
    )
    message.references.extend(_reference_uses(result))
    for stage, seconds in result.stage_seconds.items():
        message.stages.add(stage=stage).duration.FromNanoseconds(round(1e9 * seconds))
    return message


def _reference_uses(result: Result) -> list[pb.ReferenceUse]:
    answer = result.answer
    # Counts are missing when the stage that counts was not reached.
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


def _scale_to_message(scale: MetricScale) -> pb.ScaleEstimate:
    return pb.ScaleEstimate(
        metres_per_unit=scale.metres_per_unit,
        stage=enum_to_message(scale.stage, pb.ScaleStage),
        deviation=scale.deviation,
    )


MAX_SESSION_COORDINATE_M = 1e7
"""Where no device has tracked itself to; what is further is a mistake, and long sums of squares would lose digits."""


def axes_from_message(options: pb.LocalizeOptions) -> Axes:
    """The axes that a request speaks of its camera in; FieldError if there are no such axes."""
    return enum_from_message(options.axes, pb.Axes, Axes.OPENCV, "options.axes")


def session_from_message(request: pb.LocalizeRequest) -> RigidTransform | None:
    """Where the device believed its camera to be, in the request's axes; FieldError if it is no pose."""
    if not request.HasField("session_from_camera"):
        return None
    return wire.transform_from_message(request.session_from_camera, "session_from_camera", MAX_SESSION_COORDINATE_M)


def set_frames(
    message: pb.Localization,
    world_from_camera: RigidTransform,
    covariance: Array | None,
    axes: Axes,
    session_from_camera: RigidTransform | None,
    datum: Datum | None,
) -> None:
    """Puts a pose into an answer as its caller wants it, too: `in_axes`, and `geo_pose` where there is a datum.

    Args:
        message: the answer, changed.
        world_from_camera: OpenCV.
        covariance: (6, 6) as it is answered, so with the scene's calibration if there is one; None if there is none.
        axes: the caller's.
        session_from_camera: of the moment of capture, in these axes; None if the caller has said nothing of it.
        datum: the scene's.
    """
    message.in_axes.CopyFrom(framed_to_message(axes, world_from_camera, covariance, session_from_camera))
    if datum is not None:
        message.geo_pose.CopyFrom(geo_pose_to_message(world_from_camera, datum))


def framed_to_message(
    axes: Axes, world_from_camera: RigidTransform, covariance: Array | None, session_from_camera: RigidTransform | None
) -> pb.FramedPose:
    """Message of a pose in other axes; arguments as of `set_frames`."""
    message = pb.FramedPose(
        axes=enum_to_message(axes, pb.Axes),
        world_from_camera=wire.transform_to_message(pose_to(axes, world_from_camera)),
    )
    if covariance is not None:
        message.covariance.row_major.extend(covariance_to(axes, covariance).ravel().tolist())
    if session_from_camera is not None:
        world_from_session = world_from_session_in(axes, world_from_camera, session_from_camera)
        message.world_from_session.CopyFrom(wire.transform_to_message(world_from_session))
    return message


def geo_pose_to_message(world_from_camera: RigidTransform, datum: Datum) -> pb.GeoPose:
    """Message of a pose on the Earth, its zeros written."""
    found = geopose(world_from_camera, datum)
    q = found.quaternion
    return pb.GeoPose(
        position=pb.GeoPosition(lat=found.lat, lon=found.lon, h=found.h),
        quaternion=pb.GeoQuaternion(x=q.x, y=q.y, z=q.z, w=q.w),
    )
