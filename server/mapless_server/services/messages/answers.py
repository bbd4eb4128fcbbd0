"""Messages of an answer: localization with its calibrated radii, or rejection; frames, and diagnostics."""

import math
import sys
from dataclasses import asdict, astuple, dataclass, replace

import numpy as np

from mapless import wire
from mapless.axes import Axes, covariance_to, pose_to, world_from_session_in
from mapless.geodesy import Datum, geopose
from mapless.geometry import Array, RigidTransform
from mapless.scenes import FACTORS, MAX_FACTOR, MIN_FACTOR, Calibration
from mapless.v1 import localization_service_pb2 as pb
from mapless_server import __version__
from mapless_server.engine.query import Result
from mapless_server.method.bundle.estimate import (
    TAIL_95,
    Accuracy,
    PosedSupport,
    accuracy_from_covariance,
    growth,
    self_tail,
    viewpoint_gap,
)
from mapless_server.method.bundle.priors import PriorCheck
from mapless_server.method.judge.answer import Localization
from mapless_server.method.options import LocalizeOptions, Variant
from mapless_server.method.rejection import Hint, IntrinsicsCheck, Rejection
from mapless_server.method.structure.model import MetricScale
from mapless_server.store import SceneAttributes, SelfCalibration

from .queries import enum_from_message, enum_to_message

_SELF_CALIBRATED = Variant.BEST.name
"""The variant by which references are localized against the others."""


@dataclass(frozen=True)
class Factors:
    """Factors of the radii of an answer's position and rotation; 1 leaves them as they are."""

    position_68: float = 1.0
    position_95: float = 1.0
    rotation_68: float = 1.0
    rotation_95: float = 1.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not (math.isfinite(value) and MIN_FACTOR <= value <= MAX_FACTOR):
                raise ValueError(f"{name} must be {MIN_FACTOR:g} to {MAX_FACTOR:g}, is {value:g}")

    @classmethod
    def of(cls, calibration: Calibration) -> "Factors":
        """The factors of a scene's calibration."""
        return cls(*(getattr(calibration, name) for name in FACTORS))

    @classmethod
    def of_references(cls, calibration: SelfCalibration, accuracy: Accuracy, gap: float) -> "Factors":
        """Factors of a self-calibration for an answer with these radii at a gap, see `scenes.calibration.fit`."""
        own, grown = calibration, growth(gap)
        position = _factor(grown * own.position_factor, own.reference_noise_m, accuracy.position_68_m)
        rotation = _factor(grown * own.rotation_factor, own.reference_noise_deg, accuracy.rotation_68_deg)
        tail = self_tail(own.answer_count) / TAIL_95
        return cls(position, max(MIN_FACTOR, position * tail), rotation, max(MIN_FACTOR, rotation * tail))


@dataclass(frozen=True)
class Conditions:
    """What computed an answer; factors hold only for answers of the same conditions.

    The name of the features contains their options, "sift-2048-1024px-0.02"; the variant is named as by `Diagnostics`,
    "BEST". Another version of the server may report other radii.
    """

    features: str
    backend: str
    variant: str
    server_version: str


@dataclass(frozen=True, eq=False)
class ReportedRadii:
    """The reported uncertainty of an answer.

    Attributes:
        accuracy: the radii.
        covariance: (6, 6), order x y z rx ry rz, metres and radians.
        calibration: origin of the factors: "GENERIC" (no factors), "SELF" or "MEASURED".
        count: number of references that were localized against the others, or of photographs that were measured.
    """

    accuracy: Accuracy
    covariance: Array
    calibration: str = "GENERIC"
    count: int = 0


def reported_radii(
    accuracy: Accuracy,
    covariance: Array,
    conditions: Conditions,
    kind: str,
    attributes: SceneAttributes,
    gap: float | None,
) -> ReportedRadii:
    """Radii by the scene's measured calibration, else by its self-calibration, if made under the same conditions.

    Args:
        accuracy: radii of the method.
        covariance: (6, 6) of the method.
        conditions: what computed the answer.
        kind: kind of the answer, see `store.calibration_kind`; with depths kept with references another one.
        attributes: attributes of the scene.
        gap: gap of the answer, see `method.bundle.estimate.viewpoint_gap`; None if unknown.
    """
    measured = attributes.calibration
    if measured is not None and measured.is_of(*astuple(conditions)):
        factors, calibration, count = Factors.of(measured), "MEASURED", measured.query_count
    else:
        own = attributes.self_calibration(kind)
        if own is None or not own.answer_count or conditions.variant != _SELF_CALIBRATED or gap is None:
            return ReportedRadii(accuracy, covariance)
        factors, calibration, count = Factors.of_references(own, accuracy, gap), "SELF", own.answer_count
    return ReportedRadii(scaled_accuracy(accuracy, factors), scaled_covariance(covariance, factors), calibration, count)


def _factor(factor: float, noise: float, radius: float) -> float:
    """Ratio by which a radius grows if a factor multiplies it and a constant noise is added."""
    return min(max(math.hypot(factor, noise / max(radius, sys.float_info.min)), MIN_FACTOR), MAX_FACTOR)


def scaled_accuracy(accuracy: Accuracy, factors: Factors) -> Accuracy:
    """Multiplies radii by factors; the 95 % radius is never smaller than the 68 % radius."""
    position_68_m = factors.position_68 * accuracy.position_68_m
    rotation_68_deg = factors.rotation_68 * accuracy.rotation_68_deg
    return replace(
        accuracy,
        position_68_m=position_68_m,
        position_95_m=max(position_68_m, factors.position_95 * accuracy.position_95_m),
        rotation_68_deg=rotation_68_deg,
        rotation_95_deg=max(rotation_68_deg, factors.rotation_95 * accuracy.rotation_95_deg),
    )


def scaled_covariance(covariance: Array, factors: Factors) -> Array:
    """The covariance (6, 6) whose 68 % radii are those of the given one times the factors.

    C -> D C D with D = diag(fp, fp, fp, fr, fr, fr): positions by fp^2, rotations by fr^2, their covariances by fp fr,
    so that it stays positive semi-definite and all correlations are kept.
    """
    scale = np.repeat([factors.position_68, factors.rotation_68], 3)
    return np.asarray(scale[:, None] * covariance * scale, float)


@dataclass(frozen=True, eq=False)
class AnswerFrames:
    """The frames in which a caller requests its answer, besides OpenCV's: the axes of its camera.

    `session_from_camera` is the device's pose at the time of capture, in these axes; None if the request has none.
    """

    axes: Axes
    session_from_camera: RigidTransform | None


def answer_frames_of(request: pb.LocalizeRequest) -> AnswerFrames:
    """Returns the frames of a request; FieldError names the wrong field."""
    return AnswerFrames(axes_from_message(request.options), session_from_message(request))


def outcome_to_message(result: Result, options: LocalizeOptions, frames: AnswerFrames) -> pb.LocalizeResponse:
    """Makes the response, with the outcome only."""
    outcome = result.answer.outcome
    if isinstance(outcome, Rejection):
        return pb.LocalizeResponse(rejection=rejection_to_message(outcome))
    radii = None
    if outcome.covariance is not None:
        accuracy = accuracy_from_covariance(outcome.covariance)
        conditions = Conditions(result.tier.features, result.tier.backend, options.variant.name, __version__)
        support = result.answer.support
        gap = viewpoint_gap(support)[0] if isinstance(support, PosedSupport) else None
        radii = reported_radii(accuracy, outcome.covariance, conditions, result.tier.kind, result.attributes, gap)
    return pb.LocalizeResponse(localization=_localization_to_message(outcome, radii, result.attributes, frames))


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
        prior_checks=[check_to_message(check) for check in localization.prior_checks],
        scale_source=enum_to_message(localization.scale_source, pb.ScaleSource),
        intrinsics_checks=[_intrinsics_check_to_message(check) for check in localization.intrinsics_checks],
    )
    if radii is not None:
        message.covariance.CopyFrom(covariance_to_message(radii.covariance))
        message.accuracy.CopyFrom(accuracy_to_message(radii))
    set_frames(
        message,
        localization.world_from_camera,
        radii.covariance if radii else None,
        frames.axes,
        frames.session_from_camera,
        attributes.datum,
    )
    message.arbitrary_unit = attributes.arbitrary_unit
    return message


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


def check_to_message(check: PriorCheck) -> pb.PriorCheck:
    """Message of a prior's check."""
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
        intrinsics_checks=[_intrinsics_check_to_message(check) for check in rejection.intrinsics_checks],
    )


def _intrinsics_check_to_message(check: IntrinsicsCheck) -> pb.IntrinsicsCheck:
    return pb.IntrinsicsCheck(
        parameter=enum_to_message(check.parameter, pb.IntrinsicsParameter),
        given=check.given,
        estimated=check.estimated,
        estimated_sigma=check.estimated_sigma,
        given_sigma=check.given_sigma,
        conflict=check.conflict,
        used=check.used,
    )


def _hint_to_message(hint: Hint) -> pb.Hint:
    return pb.Hint(
        stage=hint.stage,
        advice=enum_to_message(hint.advice, pb.Advice),
        message=hint.message,
        best_reference=hint.best_reference or "",
    )


def diagnostics_to_message(result: Result, options: LocalizeOptions) -> pb.Diagnostics:
    """Message of what was used and of the stages' times, without the call's id and durations."""
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
        stationary_keypoint_count=answer.stationary_count,
    )
    message.references.extend(_reference_uses(result))
    for stage, seconds in result.stage_seconds.items():
        message.stages.add(stage=stage).duration.FromNanoseconds(round(1e9 * seconds))
    for it in result.attempts:
        attempt = message.attempts.add(rung=it.rung, features=it.features, outcome=it.outcome, chosen=it.is_chosen)
        attempt.duration.FromNanoseconds(round(1e9 * it.seconds))
        attempt.processor_duration.FromNanoseconds(round(1e9 * it.processor_s))
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


def _scale_to_message(scale: MetricScale) -> pb.ScaleEstimate:
    return pb.ScaleEstimate(
        metres_per_unit=scale.metres_per_unit,
        stage=enum_to_message(scale.stage, pb.ScaleStage),
        deviation=scale.deviation,
    )


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
    message: pb.Localization,
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
