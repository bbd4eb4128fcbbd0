"""Errors of the intrinsics that a scene's references share, from matches between them at their given poses.

References whose lens distortion is missing agree with one another in a wrong structure, and so does a photograph of the
same camera: localized, it contradicts nothing. But matches of two references then miss the epipolar lines of the given
poses, the more the farther from the centre. The error of the focal length and that of the first radial coefficient, the
same in all, are those with which most matches agree (Sampson distance, Cauchy's loss). The principal point is not
estimated: an error of it is nearly a rotation, and many cameras' are off by as much as their mounting.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array
from mapless_server.method.bundle.intrinsics import corrected_view, keypoint_motion
from mapless_server.method.bundle.priors import IntrinsicsSigma
from mapless_server.method.features.views import Features, Matches, PosedView, View
from mapless_server.method.optim.optimize import (
    MinimizeOptions,
    cauchy_cost,
    cauchy_weight,
    damped_step,
    minimize,
    normal_sigma,
)
from mapless_server.method.pose.two_view_matches import TwoViewMatches

SHARED = [0, 3]
"""Indices of ln of the focal length and of k1 among the four errors (see `method.bundle.intrinsics`)."""

MIN_MATCHES, MIN_SHARE, AGREEING_PX = 100, 0.3, 2.0
"""Fewer matches, or a smaller share that agrees within so many pixels, say nothing: poses are wrong, or photographs too
different."""

MAX_MATCHES = 150
"""With each other reference, which is time enough: 0.1 s in all."""

SYSTEMATIC_PX = 0.1
"""Distances that all matches may have in common. On a straight drive, where only they determine the errors, k1 seems to
be off by 0.9; a tenth of a pixel is worth as much there, but 0.002 to 0.03 in other scenes."""

MIN_REFERENCES, LENS_REFERENCES = 4, 12
"""References that are needed, and that are enough."""

SIGMAS = 3.0
"""Standard deviations that are significant: of what is found, and of calibrated lenses."""

_ROUGHLY_PX, _EXACTLY_PX = 8.0, 1.0
"""Scales of the loss: without a distortion of -0.28 matches are off by 60 px at the border."""
_UNMATCHED_PX = 100.0
"""Distance of a match that has none: without a baseline, or where the lens model folds."""
_STEPS = MinimizeOptions(iterations=15, min_decrease=1e-3)


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Errors (2,) of ln of the focal length and of k1, true minus given, and their standard deviations (2,)."""

    value: Array
    sigma: Array

    @property
    def of_all(self) -> Array:
        """The four errors of `method.bundle.intrinsics`."""
        result = np.zeros(4)
        result[SHARED] = self.value
        return result

    def __str__(self) -> str:
        parts, (focal, k1), (focal_sigma, k1_sigma) = [], self.value.tolist(), self.sigma.tolist()
        if k1:
            parts.append(f"another lens distortion (k1 {k1:+.2g}, standard deviation {k1_sigma:.1g}: is it left out?)")
        if focal:
            change, sigma = 100 * np.expm1(focal), 100 * focal_sigma
            parts.append(f"another focal length ({change:+.1f} %, standard deviation {sigma:.1f} %)")
        return f"matches between the references show {' and '.join(parts)} than their intrinsics say"


def shared_errors(subject: PosedView, others: Sequence[PosedView], matches: Sequence[Matches]) -> SharedErrors | None:
    """The errors with which a reference's matches with others agree best, the same in all; None if they say nothing.

    `matches` (subject keypoint, other keypoint) are from descriptors alone.
    """
    matches = [it[:: max(1, -(-len(it) // MAX_MATCHES))] for it in matches]
    if sum(map(len, matches)) < MIN_MATCHES:
        return None
    rough, exact = (_SharedLens(subject, others, matches, scale_px) for scale_px in (_ROUGHLY_PX, _EXACTLY_PX))
    given = exact.at(np.zeros(2))
    # From afar the exact loss has minima at few matches; where little determines the errors the rough one leads away.
    starts = given, exact.at(minimize(rough, given, _STEPS).errors)
    best = min((minimize(exact, it, _STEPS) for it in starts), key=exact.cost)
    agreeing = np.abs(best.distance_px) < AGREEING_PX
    information = exact.linearize(best)[0]
    if agreeing.mean() < MIN_SHARE or np.linalg.cond(information) > 1e12:
        return None
    variance = SYSTEMATIC_PX**2 * agreeing.sum() * np.diag(np.linalg.inv(information))
    return SharedErrors(best.errors, np.sqrt(variance))


def lens_contradiction(found: Sequence[SharedErrors]) -> SharedErrors | None:
    """Errors that several references show together, zeros where they do not; None if they fit calibrated lenses.

    The error is the median, so that a single wrong pose does not matter; its standard deviation follows from their
    spread too, so that references that disagree do not become certain by their number alone.
    """
    if len(found) < MIN_REFERENCES:
        return None
    values, usual = np.array([it.value for it in found]), IntrinsicsSigma()
    middle = np.median(values, axis=0)
    spread = math.sqrt(math.pi / 2) * normal_sigma(values - middle) / math.sqrt(len(values))
    sigma = np.maximum(spread, np.median([it.sigma for it in found], axis=0))
    contradicted = np.abs(middle) > SIGMAS * np.maximum(sigma, (usual.focal_share, usual.k1))
    return SharedErrors(np.where(contradicted, middle, 0.0), sigma) if contradicted.any() else None


def without_errors(reference: PosedView, errors: SharedErrors) -> PosedView:
    """The reference as the same photograph with right intrinsics, without keypoints that these have no pixel for."""
    view = corrected_view(reference.view, errors.of_all)
    return replace(reference, view=_cut(view, np.flatnonzero(np.isfinite(view.features.keypoints).all(axis=1))))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Distances (T,) of all matches and their derivatives (T, 2) at some errors (2,)."""

    errors: Array
    distance_px: Array
    jacobian: Array


@dataclass(frozen=True, eq=False)
class _SharedLens:
    """The cost of errors; see `optimize.Problem`."""

    subject: PosedView
    others: Sequence[PosedView]
    matches: Sequence[Matches]
    scale_px: float

    def at(self, errors: Array) -> _Fit:
        everything = SharedErrors(errors, errors).of_all
        rows = np.concatenate([it[:, 0] for it in self.matches])
        own = corrected_view(_cut(self.subject.view, rows), everything)
        views = [
            corrected_view(_cut(it.view, m[:, 1]), everything) for it, m in zip(self.others, self.matches, strict=True)
        ]
        others = [replace(it, view=view) for it, view in zip(self.others, views, strict=True)]
        numbers = np.split(np.arange(len(rows)), np.cumsum([len(it) for it in self.matches])[:-1])
        paired = TwoViewMatches.of(own, others, [np.stack([it, np.arange(len(it))], axis=1) for it in numbers])
        distance, gradient = paired.signed_sampson_px(self.subject.world_from_camera)
        motion = np.concatenate([_motion(own), np.concatenate([_motion(it) for it in views])], axis=1)
        jacobian = -np.einsum("ta,tap->tp", gradient, motion)
        known = np.isfinite(distance) & np.isfinite(jacobian).all(axis=1)
        return _Fit(errors, np.where(known, distance, _UNMATCHED_PX), np.where(known[:, None], jacobian, 0.0))

    def cost(self, fit: _Fit) -> float:
        return cauchy_cost(fit.distance_px**2, self.scale_px)

    def linearize(self, fit: _Fit) -> tuple[Array, Array]:
        weighted = fit.jacobian * cauchy_weight(fit.distance_px**2, self.scale_px)[:, None]
        return weighted.T @ fit.jacobian, weighted.T @ fit.distance_px

    def step(self, fit: _Fit, equations: tuple[Array, Array], damping: float) -> _Fit | None:
        found = damped_step(*equations, damping)
        return None if found is None or np.abs(fit.errors + found).max() > 1 else self.at(fit.errors + found)


def _cut(view: View, keypoints: NDArray[np.integer]) -> View:
    """The view with some of its keypoints (M,), in this order."""
    own = view.features
    return replace(
        view, features=Features(own.keypoints[keypoints], own.descriptors[keypoints], own.sizes_px[keypoints])
    )


def _motion(view: View) -> Array:
    """Shift (N, 2, 2) of keypoints for one unit of each shared error."""
    return keypoint_motion(view.camera, view.distortion, view.features.keypoints.astype(np.float64))[:, :, SHARED]
