"""Checks of a photograph's intrinsics against its matches, and against other cameras.

Cropped, resized and undistorted photographs often come with the intrinsics of another image. The pose is then off, with
small residuals: its motion absorbs most of such an error. What it does not absorb is in the normal equations of the
adjustment (see `intrinsics`), with standard deviations that contain errors of points and reference poses. A parameter
that is off by more than the prior and these standard deviations allow together is a reason to reject the pose, although
it was estimated with the photograph's value: the camera's next photograph will have the same error.

Intrinsics of another image, or half or double the focal length, are too far off for that: a pose then fits a part of
the matches, at similar depths, and these alone do not contradict it. But with a camera that is nearer to the true one
far more of all matches agree with one pose. So poses are computed with other focal lengths, and, where these are
unusual, with the principal point in the centre and with square pixels. That costs a query nothing of which most matches
agree already and nothing else speaks against the camera.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mapless.geometry import Array, Camera, Fisheye

from ..intrinsics import ContradictionOptions, IntrinsicsEvidence
from ..options import IntrinsicsSigma, check_bounds
from ..perturbation import reprojection_errors_px
from ..pnp import PnpOptions, ransac
from ..rejection import Advice, Hint, IntrinsicsCheck, IntrinsicsParameter, Rejection, RejectionReason
from ..results import Support
from ..two_view.matches import TwoViewMatches
from ..two_view.pose import Evidence, RelativePoseOptions, find_pose, score
from ..views import Matches


def intrinsics_checks(evidence: IntrinsicsEvidence, options: ContradictionOptions) -> tuple[IntrinsicsCheck, ...]:
    """The checks of all parameters, in pixels of the photograph as it was sent."""
    sent, scale = evidence.sent, evidence.sent.width_px / evidence.given.width_px
    k1 = sent.distortion.k1 if sent.distortion else 0.0
    given = np.array([sent.focal_x_px, sent.principal_x_px, sent.principal_y_px, k1])
    unit = np.array([sent.focal_x_px, scale, scale, 1.0])
    change = unit * evidence.value
    change[0] = sent.focal_x_px * np.expm1(evidence.value[0])
    conflict = evidence.contradicted(options, evidence.prior_sigma)
    return tuple(
        IntrinsicsCheck(*row)
        for row in zip(
            IntrinsicsParameter,
            given.tolist(),
            (given + change).tolist(),
            (unit * evidence.sigma).tolist(),
            (unit * evidence.prior_sigma).tolist(),
            conflict.tolist(),
            (evidence.removed != 0).tolist(),
            strict=True,
        )
    )


def wrong_intrinsics(
    evidence: IntrinsicsEvidence, best_reference: str, options: ContradictionOptions
) -> Rejection | None:
    """A rejection that names each parameter in conflict, the most significant first; None if there is none."""
    checks = intrinsics_checks(evidence, options)
    wrong = sorted(
        (it for it in checks if it.conflict), key=lambda it: -abs(it.estimated - it.given) / it.estimated_sigma
    )
    if not wrong:
        return None
    message = "; ".join(_sentence(it) for it in wrong)
    hint = Hint("judge", Advice.CHECK_CALIBRATION, _advice(evidence, wrong), best_reference)
    return Rejection(RejectionReason.GATE, message, hint, intrinsics_checks=checks)


def _sentence(check: IntrinsicsCheck) -> str:
    name, digits = check.parameter.field, 3 if check.parameter is IntrinsicsParameter.K1 else 1
    return (
        f"{name} is {check.given:.{digits}f}, the photograph says {check.estimated:.{digits}f} +- "
        f"{check.estimated_sigma:.{digits}f}"
    )


def _advice(evidence: IntrinsicsEvidence, wrong: list[IntrinsicsCheck]) -> str:
    found, lens = {it.parameter: it for it in wrong}, evidence.sent.distortion
    radial = found.get(IntrinsicsParameter.K1)
    if radial is not None and lens == Fisheye():
        return (
            f"The camera is given as a fisheye without coefficients: the photograph says k1 = {radial.estimated:.2f}. "
            "Give the lens's coefficients, or no fisheye for a photograph that is undistorted already."
        )
    if radial is not None and not lens:
        return (
            f"The camera is given without lens distortion: the photograph says k1 = {radial.estimated:.2f}. Give the "
            "lens's coefficients, or undistort the photograph."
        )
    if radial is not None:
        return (
            "Check the photograph's lens distortion: the model, the order of its coefficients, and whether the "
            "photograph is undistorted already."
        )
    if IntrinsicsParameter.FOCAL_LENGTH in found:
        return (
            "Check the photograph's focal length: intrinsics belong to one image size, change with it when a "
            "photograph is resized, and have another principal point when it is cropped."
        )
    return (
        "Check the photograph's principal point: it is in pixels from the centre of the top-left one, x first, and "
        "moves when a photograph is cropped, resized or rotated."
    )


@dataclass(frozen=True)
class WrongCameraOptions:
    """Options of the comparison with other cameras.

    Attributes:
        max_inlier_share: poses are computed with other cameras if no more of the matches agree with the pose. Of right
            answers most have a larger share.
        doubted_sigmas: they are computed, too, if the linear check finds a parameter off by more standard deviations,
            however uncertain. A relief seen with twice its focal length looks twice as far away to 62 % of the matches.
        undetermined_focal: likewise if it leaves the focal length this uncertain (standard deviation, as a share), as
            1.5 times the right one does, with which 63 % of the matches in an office agree; the right one 0.9 %.
        min_gain: the camera is wrong if this times as many matches agree with a pose of another one. Of photographs
            with half, 1.5 times or twice the focal length 1.3 and more do; of 281 right ones of eleven scenes 1.14.
        min_matches: fewer say nothing.
        steps: number of focal lengths below and above the given one.
        steps_per_octave: number of them from one focal length to its double.
        unusual_principal_share: distance of the principal point from the centre, as a share of the width, from which
            the centre is tried too.
        unusual_aspect: share by which both focal lengths differ, from which square pixels are tried too.
        pnp: options of the poses. Few matches suffice to compare shares.
        lines: options of the poses of other cameras where matches have no points; brief, 20 to 40 ms a camera.
    """

    max_inlier_share: float = 0.6
    doubted_sigmas: float = 3.0
    undetermined_focal: float = 0.02
    min_gain: float = 1.2
    min_matches: int = 40
    steps: int = 5
    steps_per_octave: int = 4
    unusual_principal_share: float = 0.1
    unusual_aspect: float = 0.03
    pnp: PnpOptions = field(default_factory=lambda: PnpOptions(min_iterations=30, max_iterations=300, max_matches=300))
    lines: RelativePoseOptions = field(
        default_factory=lambda: RelativePoseOptions(
            min_iterations=50, max_iterations=150, pair_iterations=200, strongest=1
        )
    )

    def __post_init__(self) -> None:
        check_bounds(self, "max_inlier_share unusual_principal_share unusual_aspect", above=0, at_most=1)
        check_bounds(self, "doubted_sigmas undetermined_focal", above=0)
        check_bounds(self, "min_gain", at_least=1)
        check_bounds(self, "min_matches steps steps_per_octave", at_least=1)


def wrong_camera(
    support: Support, evidence: IntrinsicsEvidence, best_reference: str, options: WrongCameraOptions
) -> Rejection | None:
    """A rejection that names what is wrong and the better value, if far more matches agree with another camera."""
    assert support.estimate is not None
    matches, given = support.matches, support.query.camera
    share = support.estimate.inliers.mean() if len(matches) else 1.0
    if len(matches) < options.min_matches or share * options.min_gain > 1:
        return None
    if share > options.max_inlier_share and not _is_doubted(evidence, options):
        return None
    rows = np.linspace(0, len(matches) - 1, min(len(matches), options.pnp.max_matches)).astype(int)
    x_in_world = support.structure.x_in_world[matches.point[rows]]
    pixels = support.query.features.keypoints[matches.keypoint[rows]].astype(np.float64)
    found, count = _best_camera(given, float(evidence.prior_sigma[0]), x_in_world, pixels, options)
    own = int(support.estimate.inliers[rows].sum())
    if count < options.min_gain * max(own, options.min_matches / 2):
        return None
    checks = tuple(_checks(evidence.sent, evidence.prior_sigma, given, found, options))
    message = f"{own} of {len(rows)} matches agree with the pose, and {count} with one of {_named(checks)}"
    return _check_intrinsics(message, checks, best_reference)


def wrong_camera_by_lines(
    support: Support, query_matches: Sequence[Matches], sigma: IntrinsicsSigma, options: WrongCameraOptions
) -> Rejection | None:
    """A rejection if a pose of another camera scores as high, by points and matches without points together.

    For poses that rest on few points. Poses of other cameras come from a brief search and are not adjusted: in two
    rooms they score 0.67 to 0.90 of the pose where the given camera is right, and 1.07 to 1.44 where its intrinsics are
    those of an image of half or twice the size.

    Args:
        support: the support, with an estimate.
        query_matches: matches of the query with each reference.
        sigma: standard deviations of the given intrinsics.
        options: options of the comparison.
    """
    assert support.estimate is not None
    query, used = support.query, ~support.matches.guided
    points = support.structure.x_in_world[support.matches.point[used]], support.matches.keypoint[used]

    def evidence_of(camera: Camera) -> Evidence:
        view = replace(query, camera=camera)
        lines = TwoViewMatches.of(view, support.references, query_matches)
        return Evidence(view, support.references, lines, *points)

    def score_of(camera: Camera) -> float:
        evidence = evidence_of(camera)
        pose = find_pose(evidence, options.lines)
        return 0.0 if pose is None else score(evidence, pose, options.lines)

    coarse = replace(options, steps=2, steps_per_octave=2)
    scores = [(score_of(camera), camera) for camera in _other_cameras(query.camera, sigma.focal_share, coarse)]
    best, found = max(scores, key=lambda it: it[0], default=(0.0, query.camera))
    if best < score(evidence_of(query.camera), support.estimate.world_from_camera, options.lines):
        return None
    sent = query.photograph.camera if query.photograph else query.camera
    checks = tuple(_checks(sent, sigma.of(query.camera), query.camera, found, coarse))
    reference = support.references[int(np.argmax(support.inliers_by_reference()))].name
    return _check_intrinsics(f"its matches agree as well with a pose of {_named(checks)}", checks, reference)


def _named(checks: Sequence[IntrinsicsCheck]) -> str:
    return ", ".join(f"{it.parameter.field} {it.estimated:.0f} instead of {it.given:.0f}" for it in checks)


def _check_intrinsics(message: str, checks: tuple[IntrinsicsCheck, ...], best_reference: str) -> Rejection:
    text = (
        "Check the photograph's intrinsics: they belong to one image size, change with it when a photograph is "
        "resized, and have another principal point when it is cropped."
    )
    hint = Hint("judge", Advice.CHECK_CALIBRATION, text, best_reference)
    return Rejection(RejectionReason.GATE, message, hint, intrinsics_checks=checks)


def _is_doubted(evidence: IntrinsicsEvidence, options: WrongCameraOptions) -> bool:
    """Whether the linear check speaks against the camera, or cannot speak for it."""
    off = np.abs(evidence.value) > options.doubted_sigmas * np.hypot(evidence.sigma, evidence.prior_sigma)
    return bool(off.any()) or float(evidence.sigma[0]) > options.undetermined_focal


def _best_camera(
    given: Camera, log_focal_sigma: float, x_in_world: Array, pixels: Array, options: WrongCameraOptions
) -> tuple[Camera, int]:
    """The camera of the pose that most matches agree with, and their number; half a step beside it is tried too."""

    def agreeing(camera: Camera) -> int:
        pose = ransac(camera, x_in_world, pixels, None, options.pnp)
        if pose is None:
            return 0
        return int((reprojection_errors_px(camera, pose, x_in_world, pixels) < options.pnp.inlier_px).sum())

    counts = [(agreeing(camera), camera) for camera in _other_cameras(given, log_focal_sigma, options)]
    if not counts:
        return given, 0
    best = max(counts, key=lambda it: it[0])
    half_step = 2 ** (0.5 / options.steps_per_octave)
    beside = [_scaled(best[1], factor) for factor in (1 / half_step, half_step)]
    count, camera = max([best, *((agreeing(it), it) for it in beside)], key=lambda it: it[0])
    return camera, count


def _other_cameras(given: Camera, log_focal_sigma: float, options: WrongCameraOptions) -> Iterator[Camera]:
    """Cameras that the given intrinsics may be mistaken for, none of them within what their uncertainty allows."""
    x, y = (given.width_px - 1) / 2, (given.height_px - 1) / 2
    bases = [given]
    if np.hypot(given.principal_x_px - x, given.principal_y_px - y) > options.unusual_principal_share * given.width_px:
        bases.append(replace(given, principal_x_px=x, principal_y_px=y))
    if abs(np.log(given.focal_x_px / given.focal_y_px)) > options.unusual_aspect:
        bases += [replace(base, focal_x_px=base.focal_y_px) for base in bases]
    for base in bases:
        for step in range(-options.steps, options.steps + 1):
            log_factor = np.log(2) * step / options.steps_per_octave
            if abs(log_factor) > 3 * log_focal_sigma or (step == 0 and base is not given):
                yield _scaled(base, float(np.exp(log_factor)))


def _scaled(camera: Camera, factor: float) -> Camera:
    return replace(camera, focal_x_px=factor * camera.focal_x_px, focal_y_px=factor * camera.focal_y_px)


def _checks(
    sent: Camera, prior_sigma: Array, given: Camera, found: Camera, options: WrongCameraOptions
) -> Iterator[IntrinsicsCheck]:
    """What differs, in pixels of the photograph as it was sent; standard deviations are those of the steps tried."""
    scale = sent.width_px / found.width_px
    step_sigma = np.log(2) / options.steps_per_octave / np.sqrt(12)
    focal = IntrinsicsParameter.FOCAL_LENGTH, given.focal_x_px, sent.focal_x_px, found.focal_x_px
    x = IntrinsicsParameter.PRINCIPAL_X, given.principal_x_px, sent.principal_x_px, found.principal_x_px
    y = IntrinsicsParameter.PRINCIPAL_Y, given.principal_y_px, sent.principal_y_px, found.principal_y_px
    for (parameter, before, its_sent, after), its_sigma in zip((focal, x, y), prior_sigma, strict=False):
        if after != before:
            unit = its_sent if parameter is IntrinsicsParameter.FOCAL_LENGTH else scale
            sigma = scale * after * step_sigma if parameter is IntrinsicsParameter.FOCAL_LENGTH else sent.width_px / 20
            yield IntrinsicsCheck(parameter, its_sent, scale * after, sigma, unit * its_sigma, True, False)
