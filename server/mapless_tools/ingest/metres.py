"""Metres for a dataset whose unit of length is arbitrary, as that of a COLMAP model.

Three ways: the factor itself; distances between camera centres that were measured; or known coordinates of camera
centres, to which the similarity is fitted that minimizes their squared distances (Umeyama, "Least-squares estimation of
transformation parameters between two point patterns", PAMI 1991). The rotation is SciPy's.

Contradictory values are rejected with their residuals, since a wrong scale cannot be detected once it is stored.
"""

import csv
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mapless.geometry import MAX_COORDINATE_M, Array, Similarity
from mapless.scenes import unit_vector
from mapless.text_files import numbered_lines
from mapless_server.scenes.plausibility import typical_down
from mapless_tools.dataset import Dataset, Frame, finite_numbers, named

DISTANCE_SHARE, DISTANCE_M = 0.03, 0.02
"""A measured distance may differ from the scaled model's by 3 %, or by 2 cm if that is more: the precision of a tape
measure held to a camera, and the drift of a model."""
POSITION_SHARE, POSITION_M = 0.02, 0.05
"""A known position may be off by 2 % of the largest distance between two, or by 5 cm if that is more."""
LINE_SHARE, LINE_RESIDUALS = 0.01, 3.0
"""Positions are collinear if they are nearer to a line than 1 % of their extent along it, or than three times their
residual: the rotation about the line is then that of the noise."""
PLACE_SHARE = 1e-6
"""Share of a model's extent: cameras closer than this are at one place, but for rounding."""


@dataclass(frozen=True)
class KnownDistance:
    """The measured distance of the camera centres of two references, metres."""

    first: str
    second: str
    metres: float

    def __post_init__(self) -> None:
        if not 0 < self.metres < math.inf:
            raise ValueError(f"distance of {self.first} and {self.second}: must be above 0 m, is {self.metres:g}")


def known_distance(first: str, second: str, metres: str) -> KnownDistance:
    """The distance of a flag's three texts; ValueError, naming the flag, if it is no length."""
    with named(f"--distance {first} {second} {metres}"):
        return KnownDistance(first, second, float(finite_numbers(metres, "metres", ())))


@dataclass(frozen=True)
class MetreOptions:
    """How lengths become metres.

    At most one of: metres per unit of the folder, measured distances between camera centres, and a CSV file of camera
    centres with known coordinates.
    """

    scale: float | None = None
    distances: tuple[KnownDistance, ...] = ()
    positions: Path | None = None

    def __post_init__(self) -> None:
        if sum((self.scale is not None, bool(self.distances), self.positions is not None)) > 1:
            raise ValueError("give one of --scale, --distance and --align: each of them determines the scale")
        if self.scale is not None and not 0 < self.scale < math.inf:
            raise ValueError(f"--scale is metres per unit of the folder, above 0, not {self.scale:g}")

    def __bool__(self) -> bool:
        return self.scale is not None or bool(self.distances) or self.positions is not None


def in_metres(dataset: Dataset, options: MetreOptions, id_prefix: str = "") -> Dataset:
    """Converts the dataset to metres, with notes on what was done; unchanged without options.

    A position file has its own frame: the dataset and its direction of gravity are transformed to it. The dataset's
    datum, which belongs to its former frame, is dropped. ValueError if a reference is unknown, the known values
    contradict each other or do not suffice, or a pose would lie too far from the origin.
    """
    if not options:
        return dataset
    find = Finder([located(frame, id_prefix) for frame in dataset.frames])
    if options.positions is not None:
        fit = align(find.all_of(read_positions(options.positions), str(options.positions)), str(options.positions))
        metres_from_units, notes = fit.metres_from_units, [*fit.lines]
        if dataset.datum is not None:
            notes.append("the folder's datum is dropped: it is of the frame before the alignment")
            dataset = replace(dataset, datum=None)
    elif options.distances:
        measured = scale_of_distances(options.distances, find)
        metres_from_units, notes = measured.metres_from_units, [*measured.lines]
    else:
        assert options.scale is not None
        metres_from_units, notes = Similarity(options.scale, np.eye(3), np.zeros(3)), []
    notes.append(f"poses are in metres: one unit of the folder is {metres_from_units.scale:.6g} m")
    frames = tuple(_transformed(frame, metres_from_units) for frame in dataset.frames)
    upright = typical_down([frame.world_from_camera for frame in frames])
    if options.positions is not None and upright is not None:
        x, y, z = np.round(upright.direction, 2) + 0.0
        notes.append(f"in the aligned frame down is about ({x:g}, {y:g}, {z:g}), if the cameras are upright")
    down = dataset.down_in_world
    if down is not None:
        down = unit_vector(*(metres_from_units.rotation @ np.array(down)).tolist())
    return replace(dataset, frames=frames, metric=True, down_in_world=down, notes=(*dataset.notes, *notes))


@dataclass(frozen=True, eq=False)
class MetreFit:
    """A similarity to metres that was fitted to known values, and a line for each of these.

    `scale_sigma` is the relative standard deviation of its scale, `residual_m` the root mean square of the differences.
    """

    metres_from_units: Similarity
    scale_sigma: float
    residual_m: float
    lines: tuple[str, ...]


def scale_of_distances(distances: Sequence[KnownDistance], find: "Finder") -> MetreFit:
    """Fits the scale by least squares in units of bounds, of two standard deviations; ValueError if they contradict."""
    units = np.array([_length_in_units(it, find) for it in distances])
    metres = np.array([it.metres for it in distances])
    bounds = np.maximum(DISTANCE_SHARE * metres, DISTANCE_M)

    def fit(chosen: Array) -> float:
        weights = chosen / bounds**2
        return float(weights @ (units * metres) / (weights @ units**2))

    def residuals(scale: float) -> Array:
        return np.asarray(scale * units - metres)

    scale = fit(np.ones(len(distances)))
    names = [f"{it.first} - {it.second}" for it in distances]
    differences = residuals(scale)
    lines = [
        f"distance {name}: {known:.3f} m, {known + off:.3f} m in the scaled folder ({100 * off / known:+.1f} %)"
        for name, known, off in zip(names, metres, differences, strict=True)
    ]
    if (np.abs(differences) <= bounds).all():
        sigma = 1 / (scale * math.sqrt(float((units**2 / (bounds / 2) ** 2).sum())))
        only_scale = Similarity(scale, np.eye(3), np.zeros(3))
        return MetreFit(only_scale, sigma, float(np.sqrt((differences**2).mean())), tuple(lines))
    guilty = _outlier(names, lambda chosen: np.abs(residuals(fit(chosen))) / bounds, least=3)
    raise ValueError(
        f"the known distances contradict each other by more than {100 * DISTANCE_SHARE:.0f} % and "
        f"{100 * DISTANCE_M:.0f} cm: {'; '.join(lines)}{guilty}"
    )


def umeyama(source: Array, target: Array) -> Similarity:
    """The similarity ``target_from_source`` with the least squared distances between two sets of points (N, 3)."""
    centre, target_centre = source.mean(axis=0), target.mean(axis=0)
    here, there = source - centre, target - target_centre
    rotation = Rotation.align_vectors(there, here)[0].as_matrix()
    # With the best rotation the best scale is sum(there . R here) / sum |here|^2.
    scale = float((there * (here @ rotation.T)).sum() / (here**2).sum())
    return Similarity(scale, rotation, target_centre - scale * (rotation @ centre))


def read_positions(file: Path) -> dict[str, Array]:
    """Reads known camera centres (3,), metres, by the name of the reference: a CSV file with columns name, x, y, z.

    A first line without numbers is a heading. ValueError names a malformed line.
    """
    try:
        rows = list(csv.reader(line for _, line in numbered_lines(file)))
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
    except csv.Error as error:
        raise ValueError(f"{file} is not CSV: {error}") from error
    found: dict[str, Array] = {}
    for number, row in enumerate(rows, 1):
        cells = [cell.strip() for cell in row]
        if not any(cells) or cells[0].startswith("#"):
            continue
        try:
            if len(cells) != 4:
                raise ValueError(f"must be name, x, y, z, has {len(cells)} cells")
            position = finite_numbers(cells[1:], "x, y, z", (3,))
        except ValueError as error:
            if number == 1 and not any(map(_is_number, cells[1:])):
                continue
            raise ValueError(f"{file}, line {number}: {error}") from None
        if cells[0] in found:
            raise ValueError(f"{file}, line {number}: {cells[0]} occurs twice")
        found[cells[0]] = position
    return found


@dataclass(frozen=True, eq=False)
class Located:
    """A camera centre (3,), units, with the id and the other names by which it may be called."""

    name: str
    other_names: tuple[str, ...]
    files: tuple[str, ...]
    centre: Array


def located(frame: Frame, id_prefix: str = "") -> Located:
    """The camera centre of a frame, which may be called by its original or its new id, or by its photograph's name."""
    new = f"{id_prefix}{frame.name}"
    return Located(frame.name, (new,), (frame.image_path.name,), frame.world_from_camera.translation)


class Finder:
    """Finds camera centres by ids, other names, and names of files that only one of them has."""

    def __init__(self, centres: Sequence[Located]) -> None:
        files = Counter(file for it in centres for file in set(it.files))
        self._centres = {file: it for it in centres for file in it.files if files[file] == 1}
        self._centres |= {name: it for it in centres for name in it.other_names} | {it.name: it for it in centres}

    def __call__(self, name: str) -> Located:
        """Returns the camera centre of a name; ValueError if there is none."""
        if name not in self._centres:
            known = ", ".join(sorted(it.name for it in set(self._centres.values()))[:3])
            raise ValueError(f"the folder has no reference {name!r}, by its id or file name; it has {known}, ...")
        return self._centres[name]

    def __contains__(self, name: str) -> bool:
        return name in self._centres

    def all_of(self, known: Mapping[str, Array], where: str) -> dict[str, tuple[Array, Array]]:
        """Pairs of known positions with camera centres, by name; ValueError if one is unknown, or named twice."""
        found = {name: self(name) for name in known}
        if len({it.name for it in found.values()}) < len(found):
            raise ValueError(f"{where} names a reference twice, by its id and by its file")
        return {name: (known[name], it.centre) for name, it in found.items()}

    @property
    def extent(self) -> float:
        """Largest difference of the camera centres' coordinates, units."""
        return float(np.ptp([it.centre for it in self._centres.values()], axis=0).max())


def _length_in_units(distance: KnownDistance, find: Finder) -> float:
    first, second = (find(name).centre for name in (distance.first, distance.second))
    length = float(np.linalg.norm(first - second))
    if not length > PLACE_SHARE * find.extent:
        raise ValueError(f"{distance.first} and {distance.second} are at one place: their distance gives no scale")
    return length


def align(pairs: Mapping[str, tuple[Array, Array]], where: str) -> MetreFit:
    """Fits the similarity to pairs, by name, of a known camera centre (3,), metres, and the same in units.

    ValueError, beginning with `where`, if they are too few, collinear, or contradict each other.
    """
    names = list(pairs)
    if len(names) < 3:
        raise ValueError(
            f"{where} has {len(names)} known positions: three that are not on one line are needed, or --distance, "
            "which gives the scale alone"
        )
    target, source = (np.array([pair[i] for pair in pairs.values()]) for i in range(2))
    extent_m = float(np.linalg.norm(target[:, None] - target[None], axis=2).max())
    bound_m = max(POSITION_SHARE * extent_m, POSITION_M)
    for points, text in ((target, "known positions"), (source, "cameras of the known positions")):
        _check_spread(points, 0.0, f"{where}: the {text}")

    def residuals(chosen: Array) -> Array:
        use = chosen > 0
        return np.asarray(np.linalg.norm(umeyama(source[use], target[use]).apply(source) - target, axis=1))

    off_m = residuals(np.ones(len(names)))
    lines = [f"known position of {name}: {off:.3f} m off" for name, off in zip(names, off_m, strict=True)]
    if (off_m > bound_m).any():
        mirrored = umeyama(source * [1, 1, -1], target)
        likely = _outlier(names, lambda chosen: residuals(chosen) / bound_m, least=5)
        if (np.linalg.norm(mirrored.apply(source * [1, 1, -1]) - target, axis=1) <= bound_m).all():
            likely = "; they fit if they are mirrored: are two coordinates exchanged, or is the frame left-handed?"
        raise ValueError(
            f"{where}: the known positions contradict the folder's poses by more than {bound_m:.3g} m "
            f"({100 * POSITION_SHARE:.0f} % of {extent_m:.3g} m, at least {100 * POSITION_M:.0f} cm): "
            f"{'; '.join(lines)}{likely}"
        )
    residual_m = float(np.sqrt((off_m**2).mean()))
    _check_spread(target, residual_m, f"{where}: the known positions")
    freedom, spread_m = 3 * len(names) - 7, float(np.linalg.norm(target - target.mean(axis=0)))
    sigma = float(np.linalg.norm(off_m)) / math.sqrt(freedom) / spread_m
    return MetreFit(umeyama(source, target), sigma, residual_m, tuple(lines))


def _check_spread(points: Array, residual: float, what: str) -> None:
    """Raises ValueError if points (N, 3), whose residual is known, are at one place or on a line."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / math.sqrt(len(points))
    if not spread[0] > 0:
        raise ValueError(f"{what} are all at one place: three that are not on one line are needed")
    if spread[1] <= max(LINE_SHARE * spread[0], LINE_RESIDUALS * residual):
        raise ValueError(
            f"{what} are on one line, within {spread[1]:.3g} of {spread[0]:.3g} along it (RMS): at least one is needed "
            f"that is farther from it, by {100 * LINE_SHARE:.0f} % of that and {LINE_RESIDUALS:.0f} times the residual "
            f"({residual:.3g})"
        )


def _outlier(names: Sequence[str], residuals: Callable[[Array], Array], least: int) -> str:
    """Names the item without which all others fit, if there is one and at least `least` items to find it among.

    `residuals` returns those of all items, in units of their bounds, after a fit to the chosen ones (1, else 0).
    """
    if len(names) < least:
        return ""
    without = []
    for i, name in enumerate(names):
        chosen = np.ones(len(names))
        chosen[i] = 0
        without.append((float(np.delete(residuals(chosen), i).max()), name))
    (worst, name), others = min(without), sorted(without)[1:]
    return f"; without {name} the others fit" if worst <= 1 < others[0][0] else ""


def _transformed(frame: Frame, metres_from_units: Similarity) -> Frame:
    pose = metres_from_units.transform_pose(frame.world_from_camera)
    if not np.abs(pose.translation).max() <= MAX_COORDINATE_M:
        raise ValueError(f"{frame.name} would lie more than {MAX_COORDINATE_M:g} m from the origin")
    depth = frame.depth and frame.depth.scaled(metres_from_units.scale)
    return replace(frame, world_from_camera=pose, depth=depth)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
