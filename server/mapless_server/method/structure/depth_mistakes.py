"""Depth images that were read otherwise than they were meant: whether a reference's depth fits what others see.

The depths of a photograph are known from others (see `seen_depths`). Its own depth image is compared with them as it is
given, and as it would be read with each of the usual mistakes: mirrored, turned, shifted, enlarged, or as a flat
surface, which knows nothing. In each group a factor is free, and an error that changes slowly over the image and with
the depth, as wrong poses make it. So what is left is fine structure, which wrong poses do not imitate.

An image is wrong if another reading explains the places significantly better: every place has a gain, at most 1, of
its logarithm of the probability, and under the null hypothesis the signs of these gains are arbitrary (see
`significance`). What a neighbour's sensor saw behind the surface may be hidden, and counts in nothing. The depths of a
neighbour may be those that are wrong, so the triangulated points alone must prefer the other reading, too; where they
are too few to say, the depths are in doubt.

A factor is wrong if it is not the sensor's, by three standard deviations of its kind and of the estimate from
triangulated points. No kind is off by more than 2.5 %, so this also holds for a sensor of unknown kind; its prior for
poses is wider. From one image to the next a sensor's factor hardly changes, so that of the depths of two references is
known better; but not which of the two is wrong.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapless.depth import NOISE, DepthSensor
from mapless.geometry import Array

from ..features.views import PosedView
from ..optim.optimize import cauchy_weight
from ..pairs.epipolar import MIN_MATCHES
from ..significance import is_significant, sigmas_of_gains
from .kept_depth import AGREEING_SIGMA
from .measured_depth import MeasuredDepth
from .seen_depths import SeenDepths

MIN_PLACES = MIN_MATCHES
"""Fewer places say nothing, as of matches, nor does a group with fewer than half of them."""
OWN_SIGMAS = 1.645
"""By so much the triangulated points alone must prefer another reading: 5 % of right depths do so by chance."""
FITTING_SHARE = 0.9
"""A reading is named if so many triangulated points agree, within `AGREEING_SIGMA`."""
SHIFT_SHARE, SHIFT_STEPS = 1 / 40, 3
"""Shifts that are tried: multiples of this share of the width, so many in each direction. Smaller ones are not seen."""
ZOOMS = (0.8, 0.85, 0.9, 1.1, 1.15, 1.2)
"""Enlargements that are tried: 525 and 585 px, the focal lengths of a Kinect's two cameras, differ by 1.11."""
ERROR_SLOPE = 0.1
"""Standard deviation of the slowly changing error: over the image's width, and from the median depth to twice that."""
REPEATED_SIGMA = 0.02
"""Standard deviation of the factor between the depths of two references; of right depths of four recordings."""
MIN_GROUP, MIN_GROUP_SHARE = 100, 0.8
"""Depths of a neighbour from which such a factor is known, and the share of them that agrees otherwise."""
OUTLIER_SHARE = 0.1
"""Share of places that are expected to disagree, as hidden ones do."""
ITERATIONS = 4
"""Steps of a fit by reweighted least squares."""
LARGEST_COMMON = max(noise.common for sensor, noise in NOISE.items() if sensor is not DepthSensor.UNKNOWN)
"""Standard deviation of the factor of a sensor of unknown kind: the largest of the known kinds."""
UNIT_FACTORS = {1000.0: "are these millimetres, with unit_m 1?", 0.001: "are these metres, with unit_m 0.001?"}
"""The likely mistake of depths that are so many times as long as what others see."""


@dataclass(frozen=True, eq=False)
class Reading:
    """A way to read a depth image: a pixel p has the depth that is at turned @ (p - middle) + middle + shift.

    Attributes:
        text: what is wrong with the image if this one is right.
        turned: (2, 2) matrix.
        shift: (2,) as shares of the image's width.
        is_flat: whether every depth is the same, whatever the image says.
    """

    text: str
    turned: Array
    shift: Array
    is_flat: bool = False


def _readings() -> tuple[Reading, ...]:
    """As it is given, then the mistakes."""
    none, one = np.zeros(2), np.eye(2)
    steps = SHIFT_SHARE * np.arange(-SHIFT_STEPS, SHIFT_STEPS + 1)
    shifts = [np.array([across, down]) for across in steps for down in steps if across or down]
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    return (
        Reading("", one, none),
        Reading("mirrored, left for right", np.diag([-1.0, 1.0]), none),
        Reading("mirrored, top for bottom", np.diag([1.0, -1.0]), none),
        Reading("turned by 180 degrees", -one, none),
        Reading("turned by 90 degrees clockwise", quarter, none),
        Reading("turned by 90 degrees counterclockwise", -quarter, none),
        *(Reading(f"enlarged {zoom:g} times, as of another camera's intrinsics", zoom * one, none) for zoom in ZOOMS),
        *(Reading("shifted", one, shift) for shift in shifts),
        Reading("", one, none, is_flat=True),
    )


READINGS = _readings()


@dataclass(frozen=True)
class DepthVerdict:
    """How a reference's depth image fits what others see.

    Attributes:
        place_count: places that were compared.
        point_count: those of them that are triangulated.
        agreeing_share: share of the triangulated ones that agree, apart from a factor and slow errors; NaN without any.
        factor: how many times as long as triangulated the depths are; NaN if that is not known.
        factor_sigma: its standard deviation, as a share.
        relative_factor: how many times as long as the neighbours' depths they are; NaN if that is not known.
        mistake: the likely mistake with the numbers; empty if there is none.
        doubt: the same where either this depth or the neighbours' may be wrong; empty if there is none.
    """

    place_count: int = 0
    point_count: int = 0
    agreeing_share: float = np.nan
    factor: float = np.nan
    factor_sigma: float = np.nan
    relative_factor: float = np.nan
    mistake: str = ""
    doubt: str = ""


def judge_depth(
    subject: PosedView, depth: MeasuredDepth, seen: SeenDepths, are_poses_right: bool = True
) -> DepthVerdict:
    """Compares a reference's depth with the depths that others see in its photograph.

    Where no matches show that the poses are right, nothing but the factor between depths is judged, for wrong poses
    shift and turn depth images against one another.
    """
    if len(seen) < MIN_PLACES:
        return DepthVerdict(len(seen), int(seen.are_triangulated.sum()))
    compared = _Compared.of(subject, depth, seen)
    count, share = compared.agreeing(0)
    places = int(np.isfinite(compared.residual[0]).sum())
    verdict = DepthVerdict(places, count, share, *compared.factor(), compared.relative_factor())
    common = LARGEST_COMMON if depth.noise == NOISE[DepthSensor.UNKNOWN] else depth.noise.common
    factor_mistake = _wrong_factor(verdict, common)
    factor_doubt = "" if factor_mistake else _differing_factor(verdict, common)
    text, own_sigmas = compared.misread() if are_poses_right else ("", np.inf)
    # The factor of an image that is misread says nothing.
    mistake = text if text and own_sigmas >= OWN_SIGMAS else factor_mistake
    is_doubtful = abs(own_sigmas) < OWN_SIGMAS and compared.share_of_all(0) < FITTING_SHARE
    doubt = text if text and is_doubtful else factor_doubt
    return replace(verdict, mistake=mistake, doubt="" if mistake else doubt)


def _wrong_factor(verdict: DepthVerdict, common: float) -> str:
    """A clause about a factor that the sensor's kind does not have; else empty."""
    off = abs(np.log(verdict.factor))
    if not off > AGREEING_SIGMA * np.hypot(common, verdict.factor_sigma):
        return ""
    unit = [text for factor, text in UNIT_FACTORS.items() if abs(np.log(verdict.factor / factor)) < np.log(1.5)]
    return (
        f"it is {verdict.factor:.4g} times as long as {verdict.point_count} triangulated points say, within "
        f"{100 * verdict.factor_sigma:.1f} % (a sensor is off by {100 * AGREEING_SIGMA * common:.2g} % at most): "
        f"{unit[0] if unit else 'is unit_m right?'}"
    )


def _differing_factor(verdict: DepthVerdict, common: float) -> str:
    """A clause about depths that are longer or shorter than the neighbours', unless these are the wrong ones."""
    log_ratio = np.log(verdict.relative_factor)
    if not abs(log_ratio) > AGREEING_SIGMA * REPEATED_SIGMA:
        return ""
    # By how many standard deviations triangulated points say rather that this factor is right than that it is as wrong.
    right = (abs(log_ratio) / 2 - np.sign(log_ratio) * np.log(verdict.factor)) / np.hypot(common, verdict.factor_sigma)
    if right >= OWN_SIGMAS:
        return ""
    return f"it is {verdict.relative_factor:.3g} times as long as the depth of its neighbours: is unit_m right?"


@dataclass(frozen=True, eq=False)
class _Compared:
    """The places under each of the R readings.

    Attributes:
        seen: the places.
        width_px: width of the depth image that was looked up.
        residual: (R, M) log of the seen depth over the read one, without what is free, in standard deviations; NaN
            where there is no depth.
        sigma: (R, M) these standard deviations.
        log_factor: (R, G) log of the factor of each group; NaN for those with too few places.
    """

    seen: SeenDepths
    width_px: int
    residual: Array
    sigma: Array
    log_factor: Array

    @staticmethod
    def of(subject: PosedView, depth: MeasuredDepth, seen: SeenDepths) -> "_Compared":
        camera, inverse = depth.inverse_in(subject.view.camera)
        pixels = camera.project(subject.view.camera.rays(seen.pixel))
        middle = (np.array([camera.width_px, camera.height_px]) - 1) / 2
        places = np.stack([(pixels - middle) @ it.turned.T + middle + camera.width_px * it.shift for it in READINGS])
        with np.errstate(divide="ignore", invalid="ignore"):
            read = 1 / _interpolated(inverse, places)
        for row, it in enumerate(READINGS):
            if it.is_flat:
                read[row] = np.nanmedian(read[0]) if np.isfinite(read[0]).any() else np.nan
        sigma = np.hypot(depth.noise.relative_sigma(read), seen.relative_sigma)
        width, height = subject.view.camera.width_px, subject.view.camera.height_px
        slopes = seen.pixel / (width, height) - 0.5
        nearness = seen.depth / np.median(seen.depth) - 1
        slow = np.column_stack([np.ones(len(seen)), slopes, np.clip(nearness, -1, 2)])
        residual, factors = np.full(read.shape, np.nan), np.full((len(READINGS), len(seen.common_sigma)), np.nan)
        for group in range(len(seen.common_sigma)):
            rows = np.flatnonzero(seen.group == group)
            if len(rows) >= MIN_PLACES / 2:
                off = np.log(seen.depth[rows] / read[:, rows])
                residual[:, rows], factors[:, group] = _without_slow_errors(off, sigma[:, rows], slow[rows])
        return _Compared(seen, camera.width_px, residual, sigma, factors)

    def factor(self) -> tuple[float, float]:
        """How many times as long as triangulated the given depths are, and its standard deviation, as a share."""
        logs, sigmas = self.log_factor[0], self.seen.common_sigma
        known = np.isfinite(logs) & np.isfinite(sigmas)
        if not known.any():
            return np.nan, np.nan
        weights = sigmas[known] ** -2
        mean = float(weights @ logs[known] / weights.sum())
        # Groups that differ by more than their standard deviations have larger ones.
        scatter = float(weights @ (logs[known] - mean) ** 2) / max(int(known.sum()) - 1, 1)
        return float(np.exp(-mean)), float(np.sqrt(max(1.0, scatter) / weights.sum()))

    @cached_property
    def _may_be_hidden(self) -> NDArray[np.bool_]:
        """Whether each place (R, M) that a neighbour's sensor saw is behind the surface that is read, or as given."""
        with np.errstate(invalid="ignore"):
            behind = (self.residual > AGREEING_SIGMA) & ~self.seen.are_triangulated
        return np.asarray(behind | behind[0], bool)

    def relative_factor(self) -> float:
        """How many times as long as the neighbours' depths the given ones are, in the median; NaN if not known."""
        logs = []
        for group in np.flatnonzero(np.isinf(self.seen.common_sigma)):
            residual = self.residual[0, self.seen.group == group]
            residual = residual[np.isfinite(residual)]
            if len(residual) >= MIN_GROUP and np.mean(np.abs(residual) <= AGREEING_SIGMA) >= MIN_GROUP_SHARE:
                logs.append(self.log_factor[0, group])
        return float(np.exp(-np.median(logs))) if logs else np.nan

    def agreeing(self, row: int) -> tuple[int, float]:
        """Number of the triangulated points with a depth under a reading, and the share of them that agrees."""
        residual = self.residual[row, self.seen.are_triangulated]
        residual = residual[np.isfinite(residual)]
        return len(residual), float(np.mean(np.abs(residual) <= AGREEING_SIGMA)) if len(residual) else np.nan

    def misread(self) -> tuple[str, float]:
        """The clause about the reading that explains the places best, if it does so significantly; else empty.

        Also by how many standard deviations the triangulated points alone prefer it. A reading is named under which
        these and all places fit; without one, the image is that of something else if neither of them fit as given.
        """
        found = [it for it in self._gains() if is_significant(it[1], tested=len(READINGS) - 1)]
        named = [it for it in found if not READINGS[it[0]].is_flat and self._least_share(it[0]) >= FITTING_SHARE]
        named = [it for it in named if self._is_better(it[0])]
        if named:
            row, _, own_sigmas = max(named, key=lambda it: (self.share_of_all(it[0]), it[1]))
            return self._text(row), own_sigmas
        count, share = self.agreeing(0)
        if found and count >= MIN_PLACES and max(share, self.share_of_all(0)) < FITTING_SHARE:
            text = f"it does not fit the photograph, as another one's: {100 * share:.0f} % of {count} points agree"
            return text, max(own_sigmas for _, _, own_sigmas in found)
        return "", np.inf

    def _agreeing_as_given_and(self, row: int, is_triangulated: bool = True) -> tuple[int, int, int]:
        """Number of places with a depth as given and under a reading, and of those that agree with either.

        Those that are triangulated, or all.
        """
        known = np.isfinite(self.residual[0]) & np.isfinite(self.residual[row]) & ~self._may_be_hidden[row]
        if is_triangulated:
            known &= self.seen.are_triangulated
        given, read = (np.abs(self.residual[it, known]) <= AGREEING_SIGMA for it in (0, row))
        return int(known.sum()), int(given.sum()), int(read.sum())

    def _is_better(self, row: int) -> bool:
        """Whether significantly more places agree with a reading than with the image as given."""
        for is_triangulated in (True, False):
            _, given, read = self._agreeing_as_given_and(row, is_triangulated)
            if read - given > OWN_SIGMAS**2:  # of so many of which none prefers the given one
                return True
        return False

    def _least_share(self, row: int) -> float:
        return float(np.fmin(self.agreeing(row)[1], self.share_of_all(row)))

    def share_of_all(self, row: int) -> float:
        """Share of the places with a depth under a reading that agree; 0 without any."""
        residual = self.residual[row][np.isfinite(self.residual[row]) & ~self._may_be_hidden[row]]
        return float(np.mean(np.abs(residual) <= AGREEING_SIGMA)) if len(residual) else 0.0

    def _gains(self) -> list[tuple[int, float, float]]:
        """Gains of readings over the given one, in standard deviations, of all places and of triangulated ones."""
        spread = max(ERROR_SLOPE, float(np.std(np.log(self.seen.depth))))
        densities = _log_densities(self.residual, self.sigma, spread)
        gains = np.where(self._may_be_hidden, np.nan, densities - densities[0])
        _, place, counts = np.unique(self.seen.place, return_inverse=True, return_counts=True)
        own = np.zeros(len(counts), bool)
        own[place[self.seen.are_triangulated]] = True
        found = []
        for row in range(1, len(READINGS)):
            if np.isfinite(gains[row]).sum() >= MIN_PLACES:
                gain = np.clip(np.bincount(place, np.nan_to_num(gains[row])) / counts, -1, 1)
                found.append((row, sigmas_of_gains(gain), sigmas_of_gains(gain[own])))
        return found

    def _text(self, row: int) -> str:
        reading = READINGS[row]
        shift = (self.width_px * reading.shift).round().astype(int).tolist()
        what = f"shifted by about ({shift[0]}, {shift[1]}) of its pixels" if any(shift) else reading.text
        count, given, read = self._agreeing_as_given_and(row)
        if not count:
            return f"it is {what}, by the depth of its neighbours"
        if read - given > OWN_SIGMAS**2:
            return f"it is {what}: of {count} points {given} agree with it as it is, {read} without that mistake"
        count, given, read = self._agreeing_as_given_and(row, is_triangulated=False)
        return (
            f"it is {what}: of {count} places that its neighbours show {given} agree with it as it is, {read} without "
            "that mistake"
        )


def _log_densities(residual: Array, sigma: Array, spread: float) -> Array:
    """Logarithm of the probability of places (R, M): normal, or that of any depth of the scene."""
    normal = np.exp(-(residual**2) / 2) / sigma
    anything = np.exp(-((residual * sigma / spread) ** 2) / 2) / spread
    return np.asarray(np.log((1 - OUTLIER_SHARE) * normal + OUTLIER_SHARE * np.maximum(anything, 1e-12)))


def _without_slow_errors(off: Array, sigma: Array, slow: Array) -> tuple[Array, Array]:
    """Residuals (R, M) of logarithms in their standard deviations, and log factors (R,), of each of R readings.

    `slow` (M, 4) has the columns of what is free; the first is constant.
    """
    known = np.isfinite(off)
    counts = known.sum(axis=1)
    values = np.where(known, off, 0.0)
    solution: Array = np.zeros((len(off), slow.shape[1]))
    solution[counts > 0, 0] = np.nanmedian(off[counts > 0], axis=1)
    prior: Array = np.diag([1e-9, *[ERROR_SLOPE**-2] * (slow.shape[1] - 1)])
    inverse_variance = np.where(known, np.nan_to_num(sigma, nan=1.0) ** -2.0, 0.0)
    products = slow[:, :, None] * slow[:, None, :]
    for _ in range(ITERATIONS):
        squared = (values - solution @ slow.T) ** 2 * inverse_variance
        weight = cauchy_weight(squared, 2.0) * inverse_variance
        normal: Array = np.tensordot(weight, products, axes=1) + prior
        solution = np.asarray(np.linalg.solve(normal, ((weight * values) @ slow)[..., None])[..., 0], np.float64)
    residual = np.where(known & (counts >= MIN_PLACES / 2)[:, None], (values - solution @ slow.T) / sigma, np.nan)
    return residual, np.where(counts >= MIN_PLACES / 2, solution[:, 0], np.nan)


def _interpolated(values: NDArray[np.float32], pixels: Array) -> Array:
    """Values (R, M) between the four pixels around each of (R, M, 2); NaN beyond the image, or where one has none."""
    height, width = values.shape
    first = np.floor(np.nan_to_num(pixels, nan=-2.0)).astype(np.intp)
    column, row = first[..., 0], first[..., 1]
    inside = (column >= 0) & (row >= 0) & (column < width - 1) & (row < height - 1)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    right, low = pixels[..., 0] - column, pixels[..., 1] - row
    upper = values[row, column] * (1 - right) + values[row, column + 1] * right
    lower = values[row + 1, column] * (1 - right) + values[row + 1, column + 1] * right
    return np.asarray(np.where(inside, upper * (1 - low) + lower * low, np.nan))
