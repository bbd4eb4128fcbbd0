"""A reconstruction in metres, with an origin and a way up: what each source gives, in order, combined or contradicted.

The unit is that of tags, measured distances and known positions, which must agree; GPS gives it where nothing else
does. The axes are those of a tag, of known positions, or east, north and up where GPS or a compass shows north; without
them the origin is the first camera, and z points up, x to that camera's right.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from mapless.geodesy import Datum, GeoPosition, ecef_from_enu_at, geodetic_from_ecef
from mapless.geometry import MAX_COORDINATE_M, Array, Quaternion, RigidTransform, Similarity, rotation_from_vector
from mapless.scenes import Vector, unit_vector
from mapless_tools.ingest.metres import Finder, Located, MetreFit, scale_of_distances
from mapless_tools.progress import Progress

from ..pictures import Part, WorldFrame
from .down import Down, angle_deg, down_of_gravity, down_of_horizons, upright_axes
from .gps import (
    EXTENT_RATIO,
    MAX_HEADING_SIGMA_DEG,
    MIN_FIXES,
    Fixes,
    GpsFit,
    compass_turn,
    fit_gps,
    names_of,
    read_fixes,
)
from .options import WorldOptions
from .positions import KnownPositions, read_known_positions
from .scales import AgreedScale, ScaleEstimate, agreed
from .tags import FoundTags, find_tags

MIN_SCALE_SIGMA = 0.001
"""Smallest relative standard deviation that is stated: reconstructions bend by as much within themselves."""
HELP = (
    "a printed tag of known size in three photographs (--tag), a measured distance of two cameras (--distance), known "
    "camera positions (--positions), or GPS over a way of ten times its accuracy would give the unit"
)
MAX_TILT_SIGMA_DEG = 3.0
"""Largest standard deviation of a way down that GPS gives."""


@dataclass
class _Said:
    """Notes and warnings about the world, in the order of the steps."""

    notes: list[str]
    warnings: list[str]


@dataclass(frozen=True, eq=False)
class _Earth:
    """The similarity to east, north and up at the place of the positions, with a heading that is known."""

    place: GeoPosition
    enu_from_part: Similarity


@dataclass(frozen=True, eq=False)
class _Known:
    """Unit, way down and place as the sources give them; None where none of them gives it."""

    tags: FoundTags
    positions: KnownPositions | None
    scale: ScaleEstimate | None
    down: Down | None
    earth: _Earth | None = None

    @property
    def metres_per_unit(self) -> float:
        """The scale of the world: 1 without a unit."""
        return 1.0 if self.scale is None else self.scale.metres_per_unit


def place(part: Part, options: WorldOptions, progress: Progress) -> tuple[Part, WorldFrame]:
    """Brings a reconstruction into metres, an origin and axes, as far as these are known.

    ValueError if what is known contradicts itself, a name is unknown, or a file cannot be read.
    """
    said = _Said([], [])
    find = Finder([_located(part, i) for i in range(len(part.posed))])
    tags = find_tags(part, options.tags, progress) if options.tags else FoundTags(())
    said.notes += tags.notes
    said.warnings += tags.warnings
    positions = read_known_positions(options.positions, options.positions_up, find) if options.positions else None
    scale = _scale(options, tags, positions, find, said)
    known = _Known(tags, positions, scale, _down(part, options, positions, find, said))
    if options.gps:
        known = _with_earth(part, known, said)
    world_from_part = _axes(part, options, known, said)
    if known.scale is None:
        said.notes.append(f"the unit of length is arbitrary: {HELP}")
    down, earth = known.down, known.earth
    if down is None:
        said.warnings.append("the way down is not known: the cameras were not held upright; --gravity gives it")
    elif not down.is_measured:
        said.warnings.append(f"the way down is only that of {down.source}; --gravity is surer")
    frame = WorldFrame(
        is_metric=known.scale is not None,
        scale_sigma=math.inf if known.scale is None else known.scale.sigma,
        down_in_world=None if down is None else _vector(world_from_part.rotation @ down.direction),
        notes=tuple(said.notes),
        warnings=tuple(said.warnings),
        datum=None if known.scale is None or earth is None else _datum(earth, world_from_part),
    )
    return transformed(part, world_from_part), frame


def transformed(part: Part, world_from_part: Similarity) -> Part:
    """The reconstruction in another frame and unit; ValueError if a camera would lie beyond what poses may have."""
    posed = tuple(
        replace(it, world_from_camera=world_from_part.transform_pose(it.world_from_camera)) for it in part.posed
    )
    for it in posed:
        if not np.abs(it.world_from_camera.translation).max() <= MAX_COORDINATE_M:
            raise ValueError(f"{it.picture.name} would lie more than {MAX_COORDINATE_M:g} m from the origin")
    return replace(part, posed=posed, points_in_world=world_from_part.apply(part.points_in_world))


def _located(part: Part, index: int) -> Located:
    it = part.posed[index]
    files = tuple({it.picture.path.name, it.picture.source.name})
    return Located(it.picture.name, (), files, it.world_from_camera.translation)


def _scale(
    options: WorldOptions, tags: FoundTags, positions: KnownPositions | None, find: Finder, said: _Said
) -> ScaleEstimate | None:
    """The unit by tags, distances and positions; None without any."""
    estimates = [it.estimate for it in tags.places]
    fits: list[tuple[str, MetreFit]] = []
    if options.distances:
        fits.append(("distances", scale_of_distances(options.distances, find)))
    if positions is not None:
        fits.append((positions.name, positions.fit))
        said.notes += positions.notes
    for source, fit in fits:
        said.notes += fit.lines
        sigma = max(fit.scale_sigma, MIN_SCALE_SIGMA)
        estimates.append(ScaleEstimate(source, fit.metres_from_units.scale, sigma))
    if not estimates:
        return None
    return _combined(agreed(estimates), said)


def _combined(found: AgreedScale, said: _Said) -> ScaleEstimate:
    said.notes += [f"one unit of the reconstruction is, by {it}" for it in found.used]
    for it in found.contradicting:
        factor = it.metres_per_unit / found.estimate.metres_per_unit
        said.warnings.append(
            f"{it.source} is not used: by it lengths are {factor:.3f} times those by {found.estimate.source}, which "
            "agree; is its size as stated?"
        )
    estimate = replace(found.estimate, sigma=max(found.estimate.sigma, MIN_SCALE_SIGMA))
    said.notes.append(
        f"poses are in metres: lengths have a relative standard deviation of {100 * estimate.sigma:.2g} %"
    )
    return estimate


def _down(
    part: Part, options: WorldOptions, positions: KnownPositions | None, find: Finder, said: _Said
) -> Down | None:
    """The way down by the most precise source that a device wrote, else by horizons; contradictions are named."""
    measured = [down_of_gravity(options.gravity, part, find)] if options.gravity is not None else []
    if positions is not None and positions.down is not None:
        measured.append(positions.down)
    horizons = down_of_horizons(part)
    chosen = min(measured, key=lambda it: it.sigma_deg, default=horizons)
    if chosen is None:
        return None
    said.notes.append(f"down is known to {chosen.sigma_deg:.1g} degrees (1 sigma) by {chosen.source}")
    for other in (*measured, horizons):
        if other is None or other is chosen:
            continue
        off_deg = angle_deg(chosen.direction, other.direction)
        if off_deg > max(other.bound_deg, chosen.bound_deg):
            said.warnings.append(f"down by {chosen.source} is {off_deg:.0f} degrees off that by {other.source}")
    return chosen


def _with_earth(part: Part, known: _Known, said: _Said) -> _Known:
    """With the unit by GPS if nothing else gives it, the place on the Earth if north is known, and the way down."""
    fixes, warnings = read_fixes(part)
    said.warnings += warnings
    if fixes is None:
        return known
    fit = fit_gps(part, fixes, known.down)
    if fit is None and fixes.are_one_place:
        said.notes.append("GPS gives no unit: its positions are those of one place, to their accuracy")
    elif fit is None:
        count = len(fixes.photographs)
        why = "does not agree with their poses" if count >= MIN_FIXES else f"is too little: {MIN_FIXES} are needed"
        said.warnings.append(f"GPS of {count} photographs is not used, since it {why}")
        return known
    if fit is not None:
        known = replace(known, scale=_with_gps(part, fit, known.scale, said))
        fit = fit_gps(part, fixes, known.down, known.scale)
    said.notes.append(_place_text(fixes, fit))
    if fit is not None and fit.has_unit and fit.tilt_sigma_deg <= MAX_TILT_SIGMA_DEG:
        known = replace(known, down=_down_of_gps(fit, known.down, said))
    return replace(known, earth=_earth(part, fixes, fit, known, said))


def _down_of_gps(fit: GpsFit, down: Down | None, said: _Said) -> Down:
    """Down by GPS, in which the way down that was known takes part."""
    direction = fit.enu_from_part.rotation.T @ [0.0, 0.0, -1.0]
    if down is not None and angle_deg(direction, down.direction) > down.bound_deg:
        off_deg = angle_deg(direction, down.direction)
        said.warnings.append(f"down by GPS is {off_deg:.0f} degrees off that by {down.source}")
    if down is not None and down.is_measured:
        return down
    said.notes.append(f"down is known to {fit.tilt_sigma_deg:.1g} degrees (1 sigma) by the way of the cameras and GPS")
    return Down(direction, fit.tilt_sigma_deg, MAX_TILT_SIGMA_DEG, "GPS")


def _with_gps(part: Part, fit: GpsFit, scale: ScaleEstimate | None, said: _Said) -> ScaleEstimate | None:
    """The unit, by GPS where nothing else gives it and the cameras went far enough."""
    if fit.false:
        count = f"{len(fit.false)} of {len(fit.false) + fit.used}"
        names = names_of(part, fit.false)
        said.warnings.append(f"GPS of {count} photographs contradicts that of the others and is not used: {names}")
    if not fit.has_unit:
        said.notes.append(
            f"GPS gives no unit: the cameras moved {fit.extent_m:.3g} m, positions scatter by {fit.scatter_m:.2g} m; "
            f"{EXTENT_RATIO:g} times as far are needed"
        )
        return scale
    estimate = fit.estimate()
    if scale is None:
        return _combined(agreed([estimate]), said)
    if not estimate.fits(scale):
        said.warnings.append(f"GPS contradicts the unit and is not used for it: {estimate}; {scale}")
    return scale


def _place_text(fixes: Fixes, fit: GpsFit | None) -> str:
    accuracy_m = max(fixes.accuracy_m, fit.scatter_m if fit is not None else 0.0)
    place = fixes.place
    height = f"{place.height_m:.0f} m above the sea" if np.isfinite(fixes.x_in_enu[:, 2]).any() else "height unknown"
    stated = "" if fixes.has_accuracy else ", which is assumed: EXIF states none"
    return (
        f"GPS: the photographs were taken about {place.latitude_deg:.6f}, {place.longitude_deg:.6f} (WGS84), {height}, "
        f"to {accuracy_m:.2g} m horizontally{stated}"
    )


def _earth(part: Part, fixes: Fixes, fit: GpsFit | None, known: _Known, said: _Said) -> _Earth | None:
    """The place on the Earth, None if the unit or north is not known."""
    if known.scale is None:
        said.notes.append("there is no datum: it needs the unit")
        return None
    if fit is not None and fit.heading_sigma_deg <= MAX_HEADING_SIGMA_DEG:
        enu_from_part, sigma_deg, source = fit.enu_from_part, fit.heading_sigma_deg, "the way of the cameras"
    else:
        found = _by_compass(part, fixes, known, known.scale)
        if found is None:
            said.notes.append("there is no datum: neither the way of the cameras nor a compass shows north")
            return None
        (enu_from_part, sigma_deg), source = found, "the compass of EXIF"
    said.notes.append(f"north is known to {sigma_deg:.2g} degrees (1 sigma) by {source}")
    said.warnings.append(
        "the datum's height is above the sea, as EXIF has it; above the ellipsoid it differs by up to 107 m"
    )
    return _Earth(fixes.place, enu_from_part)


def _by_compass(part: Part, fixes: Fixes, known: _Known, scale: ScaleEstimate) -> tuple[Similarity, float] | None:
    """East, north and up by the way down and the compass, the median camera at the place of the positions."""
    down = known.down
    if down is None:
        return None
    level = Similarity(scale.metres_per_unit, _z_up(part, down), np.zeros(3))
    turn = compass_turn(part, level)
    if turn is None:
        return None
    clockwise = rotation_from_vector([0.0, 0.0, -math.radians(turn[0])])
    turned = Similarity(level.scale, clockwise @ level.rotation, np.zeros(3))
    centres = np.array([part.posed[i].world_from_camera.translation for i in fixes.photographs])
    return replace(turned, translation=-np.median(turned.apply(centres), axis=0)), turn[1]


def _axes(part: Part, options: WorldOptions, known: _Known, said: _Said) -> Similarity:
    """The similarity to the world."""
    factor = known.metres_per_unit
    tag = None if options.origin is None else known.tags.only_place(options.origin)
    if tag is not None:
        said.notes.append(
            f"the origin is the centre of tag {options.origin}: x along its top edge, y down its side, z into it"
        )
        part_from_tag = tag.square.part_from_tag
        return _centred(part_from_tag.rotation.T, part_from_tag.translation, factor)
    if options.origin is not None:
        said.warnings.append(f"tag {options.origin} does not give the origin: see above")
    if known.positions is not None:
        said.notes.append(f"origin and axes are those of {known.positions.name}")
        return known.positions.with_scale(factor)
    if known.earth is not None:
        said.notes.append("x points east, y north, z up; the origin is the datum")
        enu_from_part = known.earth.enu_from_part
        origin = enu_from_part.inverse().translation
        return _centred(enu_from_part.rotation, origin, factor)
    first = part.posed[0].world_from_camera
    rotation = first.rotation.T if known.down is None else _z_up(part, known.down)
    axes = "z up, x to its right" if known.down is not None else "with its axes"
    said.notes.append(f"the origin is the camera of {part.posed[0].picture.name}, {axes}")
    return _centred(rotation, first.translation, factor)


def _centred(world_from_part: Array, origin: Array, factor: float) -> Similarity:
    """The similarity of a rotation and a scale that moves a point to the origin."""
    return Similarity(factor, world_from_part, -factor * (world_from_part @ origin))


def _z_up(part: Part, down: Down) -> Array:
    """The rotation to axes with z up, x to the right of the first camera that is not parallel to it."""
    up = -down.direction
    for it in part.posed:
        right = upright_axes(it).rotation[:, 0]
        x = right - up * float(up @ right)
        if np.linalg.norm(x) > 0.5:
            break
    else:
        x = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(up, x), up])


def _datum(earth: _Earth, world_from_part: Similarity) -> Datum:
    """The datum of the world: place of its origin, and its rotation to east, north and up there."""
    enu = earth.enu_from_part
    origin_in_enu = enu.apply(world_from_part.inverse().translation)
    enu_from_world = RigidTransform(enu.rotation @ world_from_part.rotation.T, origin_in_enu)
    ecef_from_world = ecef_from_enu_at(earth.place).compose(enu_from_world)
    origin = geodetic_from_ecef(ecef_from_world.translation)
    turned = ecef_from_enu_at(origin).rotation.T @ ecef_from_world.rotation
    return Datum(origin.latitude_deg, origin.longitude_deg, origin.height_m, Quaternion.from_matrix(turned))


def _vector(direction: Array) -> Vector:
    x, y, z = direction.tolist()
    return unit_vector(x, y, z)
