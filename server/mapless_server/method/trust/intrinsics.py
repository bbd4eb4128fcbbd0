"""Checks of a photograph's intrinsics against its matches, and against other cameras.

Cropped, resized and undistorted photographs often come with the intrinsics of another image. The pose is then off, with
small residuals: its motion absorbs most of such an error. What it does not absorb is in the normal equations of the
adjustment (see `intrinsics`), with standard deviations that contain errors of points and reference poses. A parameter
that is off by more than the prior and these standard deviations allow together is a reason to reject the pose, although
it was estimated with the photograph's value: the camera's next photograph will have the same error.

Intrinsics of another image, or half or double the focal length, are too far off for that: a pose then fits a part of
the matches, at similar depths, and these alone do not contradict it. But with a camera that is nearer to the true one
far more of all matches agree with one pose. So poses are computed with other focal lengths, and, where these are
unusual, with the principal point in the centre and with square pixels; the score of `two_view.pose` compares them, by
points and by matches without points together. That costs a query nothing of which the linear check is certain.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mapless.geometry import Array, Camera, Fisheye, RigidTransform

from ..intrinsics import ContradictionOptions, IntrinsicsEvidence
from ..options import IntrinsicsSigma
from ..pnp import PnpOptions, ransac
from ..rejection import Advice, Hint, IntrinsicsCheck, IntrinsicsParameter, Rejection, RejectionReason
from ..results import Support
from ..two_view.matches import TwoViewMatches
from ..two_view.pose import Evidence, RelativePoseOptions, find_pose, score


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


DOUBTED_SIGMAS, UNDETERMINED_FOCAL = 3.0, 0.02
"""Other cameras are tried if the linear check finds a parameter off by more standard deviations, or leaves the focal
length more uncertain (standard deviation, as a share): with K of an image of twice the size all poses are doubted."""

MIN_GAIN = 1.2
"""The camera is wrong if a pose of another one scores this many times as high. With half, 1.5 times or twice the focal
length 86 of 89 accepted poses of seven places have more, and 82 by the number of inliers alone; of 153 right answers of
twelve places one has 1.5, whose focal length is given for all photographs of a statue, and the others up to 1.04."""

MIN_MATCHES = 40
"""Fewer with points say nothing."""

STEPS, STEPS_PER_OCTAVE = 5, 4
"""Focal lengths below and above the given one, and how many from one to its double."""

UNUSUAL_PRINCIPAL_SHARE, UNUSUAL_ASPECT = 0.1, 0.03
"""Distance of the principal point from the centre, as a share of the width, from which the centre is tried too; share
by which both focal lengths differ, from which square pixels are tried too."""

PNP = PnpOptions(min_iterations=30, max_iterations=300, max_matches=300)
"""Of the poses by points. Few matches suffice to compare cameras."""

LINES = RelativePoseOptions(min_iterations=50, max_iterations=150, pair_iterations=200, strongest=1)
"""Of the poses where the given one rests on matches without points; brief, 20 to 40 ms a camera."""


def wrong_camera(support: Support, best_reference: str, intrinsics: IntrinsicsSigma | None = None) -> Rejection | None:
    """A rejection that names what is wrong and the better value, if a pose of another camera scores clearly higher.

    A pose that rests on matches without points is compared whatever the linear check says, with four cameras by a brief
    search: these score 0.67 to 0.90 of the pose where the given camera is right, and 1.07 to 1.44 where its intrinsics
    are those of an image of half or twice the size. Its linear check knows the defaults alone; `intrinsics` are the
    caller's standard deviations, within three of which no camera is tried.
    """
    assert support.estimate is not None
    query, evidence, by_lines = support.query, support.estimate.intrinsics, support.two_view is not None
    used = np.flatnonzero(~support.matches.guided)
    if not by_lines and (len(used) < MIN_MATCHES or evidence is None or not _is_doubted(evidence)):
        return None
    x_in_world, keypoint = support.structure.x_in_world[support.matches.point[used]], support.matches.keypoint[used]

    def scored(camera: Camera, pose: RigidTransform | None = None) -> tuple[float, Camera]:
        """The score of a pose, by default of the best one that is found."""
        view = replace(query, camera=camera)
        lines = TwoViewMatches.of(view, support.references, support.query_matches)
        all_matches = Evidence(view, support.references, lines, x_in_world, keypoint)
        if pose is None and by_lines:
            pose = find_pose(all_matches, LINES)
        elif pose is None:
            pose = ransac(camera, x_in_world, all_matches.pixels, None, PNP)
        return 0.0 if pose is None else score(all_matches, pose, LINES), camera

    steps, steps_per_octave = (2, 2) if by_lines else (STEPS, STEPS_PER_OCTAVE)
    usual = (intrinsics or IntrinsicsSigma()).of(query.camera)
    prior_sigma = usual if by_lines or evidence is None else evidence.prior_sigma
    others = list(_other_cameras(query.camera, float(prior_sigma[0]), steps, steps_per_octave))
    if not others:
        return None
    best = max(map(scored, others), key=lambda it: it[0])
    # The estimate's own intrinsics are those that were estimated with it, within what the caller allows.
    own = scored((support.estimate.view or query).camera, support.estimate.world_from_camera)[0]
    if not by_lines:
        own = MIN_GAIN * max(own, scored(query.camera)[0])
        half_step = 2 ** (0.5 / steps_per_octave)
        best = max([best, *(scored(_scaled(best[1], it)) for it in (1 / half_step, half_step))], key=lambda it: it[0])
    if best[0] < own:
        return None
    sent = query.photograph.camera if query.photograph else query.camera
    checks = tuple(_checks(sent, prior_sigma, query.camera, best[1], steps_per_octave))
    named = ", ".join(f"{it.parameter.field} {it.estimated:.0f} instead of {it.given:.0f}" for it in checks)
    inliers = support.estimate.inliers
    message = f"{inliers.sum()} of {len(inliers)} matches agree with the pose; all together fit one of {named} better"
    if by_lines:  # the matches with points may be none
        message = f"its matches agree as well with a pose of {named}"
    text = (
        "Check the photograph's intrinsics: they belong to one image size, change with it when a photograph is "
        "resized, and have another principal point when it is cropped."
    )
    hint = Hint("judge", Advice.CHECK_CALIBRATION, text, best_reference)
    return Rejection(RejectionReason.GATE, message, hint, intrinsics_checks=checks)


def _is_doubted(evidence: IntrinsicsEvidence) -> bool:
    """Whether the linear check speaks against the camera, or cannot speak for it."""
    off = np.abs(evidence.value) > DOUBTED_SIGMAS * np.hypot(evidence.sigma, evidence.prior_sigma)
    return bool(off.any()) or float(evidence.sigma[0]) > UNDETERMINED_FOCAL


def _other_cameras(given: Camera, log_focal_sigma: float, steps: int, steps_per_octave: int) -> Iterator[Camera]:
    """Cameras that the given intrinsics may be mistaken for, none of them within what their uncertainty allows."""
    x, y = (given.width_px - 1) / 2, (given.height_px - 1) / 2
    bases = [given]
    if np.hypot(given.principal_x_px - x, given.principal_y_px - y) > UNUSUAL_PRINCIPAL_SHARE * given.width_px:
        bases.append(replace(given, principal_x_px=x, principal_y_px=y))
    if abs(np.log(given.focal_x_px / given.focal_y_px)) > UNUSUAL_ASPECT:
        bases += [replace(base, focal_x_px=base.focal_y_px) for base in bases]
    for base in bases:
        for step in range(-steps, steps + 1):
            log_factor = np.log(2) * step / steps_per_octave
            if abs(log_factor) > 3 * log_focal_sigma or (step == 0 and base is not given):
                yield _scaled(base, float(np.exp(log_factor)))


def _scaled(camera: Camera, factor: float) -> Camera:
    return replace(camera, focal_x_px=factor * camera.focal_x_px, focal_y_px=factor * camera.focal_y_px)


def _checks(
    sent: Camera, prior_sigma: Array, given: Camera, found: Camera, steps_per_octave: int
) -> Iterator[IntrinsicsCheck]:
    """What differs, in pixels of the photograph as it was sent; standard deviations are those of the steps tried."""
    scale = sent.width_px / found.width_px
    step_sigma = np.log(2) / steps_per_octave / np.sqrt(12)
    focal = IntrinsicsParameter.FOCAL_LENGTH, given.focal_x_px, sent.focal_x_px, found.focal_x_px
    x = IntrinsicsParameter.PRINCIPAL_X, given.principal_x_px, sent.principal_x_px, found.principal_x_px
    y = IntrinsicsParameter.PRINCIPAL_Y, given.principal_y_px, sent.principal_y_px, found.principal_y_px
    for (parameter, before, its_sent, after), its_sigma in zip((focal, x, y), prior_sigma, strict=False):
        if after != before:
            unit = its_sent if parameter is IntrinsicsParameter.FOCAL_LENGTH else scale
            sigma = scale * after * step_sigma if parameter is IntrinsicsParameter.FOCAL_LENGTH else sent.width_px / 20
            yield IntrinsicsCheck(parameter, its_sent, scale * after, sigma, unit * its_sigma, True, False)
