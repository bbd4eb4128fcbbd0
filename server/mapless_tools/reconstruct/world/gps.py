"""GPS in the photographs' EXIF: the place on the Earth, north, and the unit where the cameras went far enough.

The similarity from the reconstruction to east, north and up is fitted to the positions on which most photographs agree
(RANSAC over samples of two positions and the way down, or of three positions), then by weighted least squares; false
positions, such as jumps, are left out and named. Heights of EXIF are above the sea, and less accurate than horizontal
positions.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geodesy import GeoPosition, ecef_from_enu_at, ecef_from_geodetic, geodetic_from_ecef
from mapless.geometry import Array, Similarity, rotation_from_vector
from mapless_server.images.exif import GpsPosition
from mapless_tools.ingest.metres import umeyama

from ..pictures import Part
from .down import Down
from .fitting import least
from .scales import ScaleEstimate

EXTENT_RATIO = 10.0
"""The cameras must have moved so many times the scatter of the positions, to give the unit."""
ACCURACY_M = 5.0
"""Horizontal standard deviation of a position without a stated one: of a phone under open sky."""
MIN_SCATTER_M = 1.0
"""Smallest scatter that is believed: devices repeat a position, or smooth them, so that differences understate it."""
HEIGHT_RATIO = 3.0
"""Standard deviations of heights are so many times those of horizontal positions."""
INDEPENDENT = 5
"""Largest number of positions that count as independent: errors are alike for minutes."""
BOUND_SIGMAS = 3.0
MIN_FIXES = 3
NOWHERE_DEG = 0.01
"""Positions so near to 0, 0, in the sea, are those of devices without a fix."""
MAX_HEADING_SIGMA_DEG = 10.0
COMPASS_SIGMA_DEG = 10.0
"""Standard deviation that the compass of a phone has in common to all photographs, near steel and electronics."""
MAX_PITCH_SINE = 0.87
"""A camera that looks 60 degrees up or down has no direction of view."""
SAMPLES = 200
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Fixes:
    """Positions of photographs, by index: east, north, up (N, 3) metres at `place`; up is NaN where it is missing."""

    place: GeoPosition
    photographs: NDArray[np.integer]
    x_in_enu: Array
    sigma_m: Array
    has_accuracy: bool

    @property
    def accuracy_m(self) -> float:
        """The median of the stated horizontal accuracies."""
        return float(np.median(self.sigma_m))

    @property
    def are_one_place(self) -> bool:
        """Whether most positions are as near to each other as those of cameras at one place."""
        from_middle_m = np.linalg.norm(self.x_in_enu[:, :2], axis=1)
        return bool(np.quantile(from_middle_m, 0.9) <= BOUND_SIGMAS * self.accuracy_m)

    def of(self, chosen: NDArray[np.bool_]) -> "Fixes":
        """Those that are chosen."""
        return replace(
            self,
            photographs=self.photographs[chosen],
            x_in_enu=self.x_in_enu[chosen],
            sigma_m=self.sigma_m[chosen],
        )

    def scattered(self, scatter_m: float) -> "Fixes":
        """With standard deviations of this median; larger by what they have in common, as INDEPENDENT says."""
        together = math.sqrt(max(1.0, len(self.sigma_m) / INDEPENDENT))
        return replace(self, sigma_m=self.sigma_m * (together * scatter_m / self.accuracy_m))


@dataclass(frozen=True, eq=False)
class GpsFit:
    """The similarity to east, north and up at `place`; standard deviations of its logarithmic scale and heading.

    `scatter_m` is the root mean square of horizontal residuals, at least the devices' stated accuracy; `extent_m` the
    largest distance of two cameras; `false` are the photographs whose positions contradict those of the others.
    """

    enu_from_part: Similarity
    scale_sigma: float
    heading_sigma_deg: float
    tilt_sigma_deg: float
    scatter_m: float
    extent_m: float
    used: int
    false: tuple[int, ...]

    @property
    def has_unit(self) -> bool:
        """Whether the cameras moved far enough for the positions to give the unit."""
        return self.extent_m >= EXTENT_RATIO * self.scatter_m

    def estimate(self) -> ScaleEstimate:
        """The unit of length."""
        return ScaleEstimate("GPS", self.enu_from_part.scale, self.scale_sigma)


def read_fixes(part: Part) -> tuple[Fixes | None, list[str]]:
    """The positions in EXIF, and warnings; None without any."""
    given = {i: it.picture.exif.position for i, it in enumerate(part.posed)}
    known = {i: it for i, it in given.items() if it is not None and not _is_nowhere(it)}
    nowhere = sum(it is not None and _is_nowhere(it) for it in given.values())
    warnings = [f"GPS of {nowhere} photographs is 0, 0, of a device without a fix: not used"] if nowhere else []
    if not known:
        return None, warnings
    places = [GeoPosition(it.latitude_deg, it.longitude_deg, 0.0) for it in known.values()]
    in_ecef = np.array([ecef_from_geodetic(it) for it in places])
    # The median of false and true positions is near the true ones if these are most of them.
    place = geodetic_from_ecef(np.median(in_ecef, axis=0))
    heights_m = np.array([np.nan if it.height_m is None else it.height_m for it in known.values()])
    middle_m = float(np.nanmedian(heights_m)) if np.isfinite(heights_m).any() else 0.0
    on_ground = GeoPosition(place.latitude_deg, place.longitude_deg, 0.0)
    x_in_enu = ecef_from_enu_at(on_ground).inverse().apply(in_ecef)
    x_in_enu[:, 2] = heights_m - middle_m
    stated = [it.accuracy_m for it in known.values()]
    sigma_m = np.array([max(it or ACCURACY_M, MIN_SCATTER_M) for it in stated])
    place = GeoPosition(place.latitude_deg, place.longitude_deg, middle_m)
    return Fixes(place, np.array([*known]), x_in_enu, sigma_m, any(stated)), warnings


def fit_gps(part: Part, fixes: Fixes, down: Down | None, scale: ScaleEstimate | None = None) -> GpsFit | None:
    """Fits the reconstruction to the positions; None if they are too few, or no half of them agrees.

    `scale` is what is known of the unit otherwise; it takes part with its standard deviation.
    """
    centres = np.array([part.posed[i].world_from_camera.translation for i in fixes.photographs])
    if len(centres) < MIN_FIXES or not np.ptp(centres, axis=0).max() > 0:
        return None
    best = _agreeing(centres, fixes, down)
    if best is None:
        return None
    found, use = best
    for _ in range(2):
        found, _ = _solved(centres[use], fixes.of(use), found, down, scale)
        use = np.asarray(_off(found.apply(centres), fixes) <= BOUND_SIGMAS)
        if use.sum() < MIN_FIXES:
            return None
    across_m = np.linalg.norm((found.apply(centres) - fixes.x_in_enu)[use, :2], axis=1)
    least_m = fixes.accuracy_m if fixes.has_accuracy else MIN_SCATTER_M
    scatter_m = max(float(np.sqrt((across_m**2).mean())), least_m)
    found, jacobian = _solved(centres[use], fixes.of(use).scattered(scatter_m), found, down, scale)
    return _fit(found, jacobian, found.apply(centres)[use], scatter_m, tuple(fixes.photographs[~use].tolist()))


def compass_turn(part: Part, enu_from_part: Similarity) -> tuple[float, float] | None:
    """How far the frame must be turned clockwise, seen from above, to agree with the compass, and its deviation.

    Degrees; None without directions of view in EXIF that agree.
    """
    turns = []
    for it in part.posed:
        ahead = enu_from_part.rotation @ it.world_from_camera.rotation[:, 2]
        if it.picture.exif.direction_deg is not None and abs(ahead[2]) <= MAX_PITCH_SINE:
            turns.append(it.picture.exif.direction_deg - math.degrees(math.atan2(ahead[0], ahead[1])))
    if not turns:
        return None
    phases = np.exp(1j * np.radians(turns))
    middle = phases[np.abs(np.angle(phases[:, None] / phases[None])).sum(axis=1).argmin()]
    off_deg = np.degrees(np.angle(phases / middle))
    fits = np.abs(off_deg) <= BOUND_SIGMAS * COMPASS_SIGMA_DEG
    if fits.sum() * 2 <= len(fits):
        return None
    turn_deg = float(np.degrees(np.angle(middle)) + off_deg[fits].mean())
    return turn_deg, math.hypot(COMPASS_SIGMA_DEG, float(off_deg[fits].std()) / math.sqrt(fits.sum()))


def _is_nowhere(position: GpsPosition) -> bool:
    return max(abs(position.latitude_deg), abs(position.longitude_deg)) < NOWHERE_DEG


def _agreeing(centres: Array, fixes: Fixes, down: Down | None) -> tuple[Similarity, NDArray[np.bool_]] | None:
    """The sample's similarity with which most positions agree, and which these are; None if they are not most."""
    generator = np.random.default_rng(0)
    best, least = None, (len(centres) // 2, 0.0)
    targets = np.nan_to_num(fixes.x_in_enu)
    for _ in range(SAMPLES):
        chosen = generator.choice(len(centres), 3 if down is None else 2, replace=False)
        source, target = centres[chosen], targets[chosen]
        if down is not None:  # a third point, upward of the first
            source = np.vstack([source, source[0] - down.direction * np.linalg.norm(source[1] - source[0])])
            target = target * [1, 1, 0]
            target = np.vstack([target, target[0] + _UP * np.linalg.norm(target[1] - target[0])])
        if min(np.linalg.matrix_rank(it - it[0], tol=1e-9 * max(np.ptp(it), 1e-12)) for it in (source, target)) < 2:
            continue
        found = umeyama(source, target)
        if not found.scale > 0:
            continue
        off = _off(_with_height(found, centres, fixes), fixes)
        use = np.asarray(off <= BOUND_SIGMAS)
        score = (int(use.sum()), -float(off[use].sum()))
        if score > least:
            shift = _with_height(found, centres, fixes)[0] - found.apply(centres[0])
            best, least = (Similarity(found.scale, found.rotation, found.translation + shift), use), score
    return best


def _with_height(found: Similarity, centres: Array, fixes: Fixes) -> Array:
    """The centres in east, north and up, their heights shifted by the median difference to the known ones."""
    x_in_enu = found.apply(centres)
    off_m = fixes.x_in_enu[:, 2] - x_in_enu[:, 2]
    if np.isfinite(off_m).any():
        x_in_enu[:, 2] += np.nanmedian(off_m)
    return x_in_enu


def _off(x_in_enu: Array, fixes: Fixes) -> Array:
    """Distances (N,) from the positions as multiples of their standard deviations, of heights and of the rest."""
    off_m = x_in_enu - fixes.x_in_enu
    across = np.linalg.norm(off_m[:, :2], axis=1) / fixes.sigma_m
    return np.asarray(np.fmax(across, np.abs(off_m[:, 2]) / (HEIGHT_RATIO * fixes.sigma_m)))


def _solved(
    centres: Array, fixes: Fixes, start: Similarity, down: Down | None, scale: ScaleEstimate | None
) -> tuple[Similarity, Array]:
    """The similarity of least weighted squares, and the Jacobian by log scale, rotation (3) and translation (3)."""
    target, sigma_m = fixes.x_in_enu, fixes.sigma_m
    has_height = np.isfinite(target[:, 2])
    middle = centres.mean(axis=0)
    at_middle = start.apply(middle)

    def similarity(change: Array) -> Similarity:
        rotation = rotation_from_vector(change[1:4]) @ start.rotation
        factor = start.scale * math.exp(float(np.clip(change[0], -50, 50)))
        return Similarity(factor, rotation, at_middle + change[4:] - factor * (rotation @ middle))

    def residuals(change: Array) -> Array:
        found = similarity(change)
        off = (found.apply(centres) - target) / sigma_m[:, None]
        parts = [off[:, :2].ravel(), off[has_height, 2] / HEIGHT_RATIO]
        if down is not None:
            parts.append((found.rotation @ down.direction)[:2] / math.radians(down.sigma_deg))
        if scale is not None:
            parts.append(np.array([math.log(found.scale / scale.metres_per_unit) / scale.sigma]))
        if not has_height.any():
            parts.append(change[6:])  # nothing else determines it
        return np.concatenate(parts)

    first = np.zeros(7)
    if scale is not None:
        first[0] = math.log(scale.metres_per_unit / start.scale)
    change, jacobian = least(residuals, first)
    return similarity(change), jacobian


def _fit(found: Similarity, jacobian: Array, x_in_enu: Array, scatter_m: float, false: tuple[int, ...]) -> GpsFit:
    sigmas = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)))
    extent_m = max(float(np.linalg.norm(x_in_enu - it, axis=1).max()) for it in x_in_enu)
    heading_deg, tilt_deg = math.degrees(sigmas[3]), math.degrees(sigmas[1:3].max())
    return GpsFit(found, float(sigmas[0]), heading_deg, tilt_deg, scatter_m, extent_m, len(x_in_enu), false)


def names_of(part: Part, photographs: Sequence[int]) -> str:
    """The names of the first three photographs of these indices, and how many more there are."""
    names = [part.posed[i].picture.name for i in photographs[:3]]
    return ", ".join(names) + (f" and {len(photographs) - 3} more" if len(photographs) > 3 else "")
