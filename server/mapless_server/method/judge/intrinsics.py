"""Checks of a photograph's intrinsics against the matches that its pose rests on.

Cropped, resized and undistorted photographs often come with the intrinsics of another image. The pose is then off, with
small residuals: its motion absorbs most of such an error. What it does not absorb is in the normal equations of the
adjustment (see `bundle.intrinsics`). A parameter that is off by more than the prior and its standard deviation allow
together is a reason to reject the pose, although it was estimated with the photograph's value: the camera's next
photograph will have the same error. Larger errors are found by `judge.cameras`.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera
from mapless.lenses import Distortion, Fisheye

from ..bundle.estimate import PosedSupport
from ..bundle.intrinsics import DOUBTED_SIGMAS, ContradictionOptions, IntrinsicsEvidence
from ..rejection import Advice, Hint, IntrinsicsCheck, IntrinsicsParameter, Rejection, RejectionReason


def intrinsics_checks(evidence: IntrinsicsEvidence) -> tuple[IntrinsicsCheck, ...]:
    """The checks of all parameters, in pixels of the photograph as it was sent."""
    sent, scale = evidence.sent, evidence.sent.width_px / evidence.given.width_px
    given = checked_parameters(sent)
    unit = np.array([sent.focal_x_px, scale, scale, 1.0])
    change = unit * evidence.value
    change[0] = sent.focal_x_px * np.expm1(evidence.value[0])
    estimated, sigma, given_sigma = given + change, unit * evidence.sigma, unit * evidence.prior_sigma
    conflict, used = evidence.contradicted(ContradictionOptions(), evidence.prior_sigma), evidence.removed != 0
    return checks_of(np.stack([given, estimated, sigma, given_sigma], axis=1), conflict, used)


def checks_of(values: Array, conflict: NDArray[np.bool_], used: NDArray[np.bool_]) -> tuple[IntrinsicsCheck, ...]:
    """The checks of all parameters; rows of `values` (4, 4) are given, estimated, and their standard deviations."""
    rows = zip(IntrinsicsParameter, values.tolist(), conflict.tolist(), used.tolist(), strict=True)
    return tuple(
        IntrinsicsCheck(parameter, given, estimated, sigma, given_sigma, conflict=is_wrong, used=is_used)
        for parameter, (given, estimated, sigma, given_sigma), is_wrong, is_used in rows
    )


def checked_parameters(camera: Camera) -> Array:
    """The values (4,) of a camera's checked parameters."""
    k1 = camera.distortion.k1 if camera.distortion else 0.0
    return np.array([camera.focal_x_px, camera.principal_x_px, camera.principal_y_px, k1])


def wrong_intrinsics(evidence: IntrinsicsEvidence, best_reference: str) -> Rejection | None:
    """A rejection that names each parameter in conflict, the most significant first; None if there is none."""
    checks = intrinsics_checks(evidence)
    wrong = sorted(
        (it for it in checks if it.conflict), key=lambda it: -abs(it.estimated - it.given) / it.estimated_sigma
    )
    if not wrong:
        return None
    message = "; ".join(_sentence(it) for it in wrong)
    hint = Hint("judge", Advice.CHECK_CALIBRATION, advice_for(evidence.sent.distortion, wrong), best_reference)
    return Rejection(RejectionReason.GATE, message, hint, intrinsics_checks=checks)


def _sentence(check: IntrinsicsCheck) -> str:
    name, digits = check.parameter.field, 3 if check.parameter is IntrinsicsParameter.K1 else 1
    return (
        f"{name} is {check.given:.{digits}f}, the photograph says {check.estimated:.{digits}f} +- "
        f"{check.estimated_sigma:.{digits}f}"
    )


def advice_for(lens: Distortion | None, wrong: Sequence[IntrinsicsCheck]) -> str:
    """The parameters to check, in words, of a camera with this lens of which these parameters are wrong."""
    found = {it.parameter: it for it in wrong}
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


def is_camera_doubtful(support: PosedSupport) -> bool:
    """Whether the linear check speaks against the photograph's camera, or cannot speak for it.

    That of a pose that rests on matches without points cannot.
    """
    evidence = support.estimate.intrinsics
    if support.two_view is not None:
        return True
    if evidence is None:
        return False
    off = np.abs(evidence.value) > DOUBTED_SIGMAS * np.hypot(evidence.sigma, evidence.prior_sigma)
    return bool(
        off.any() or evidence.sigma[0] > ContradictionOptions.focal_share or evidence.sigma[3] > ContradictionOptions.k1
    )
