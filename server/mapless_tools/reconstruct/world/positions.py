"""Known positions of some of the photographs: a CSV file, or a folder with poses of a device such as ARKit's."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapless.geometry import Array, Similarity
from mapless_tools.ingest.formats import read_dataset
from mapless_tools.ingest.metres import Finder, MetreFit, align, read_positions

from .down import Down
from .options import AXES

UP_OF_FORMATS = {"arkit": "y"}
"""Axis that points up in the layouts whose world is aligned with gravity."""
POSITIONS_BOUND_DEG = 10.0
MIN_POSITIONS = 3
"""Positions, not on one line, that determine a similarity."""


@dataclass(frozen=True, eq=False)
class KnownPositions:
    """The fit to known positions, its down in the reconstruction's frame if it is known, and what is to be said."""

    name: str
    fit: MetreFit
    middle_m: Array
    middle_units: Array
    down: Down | None
    notes: tuple[str, ...]

    def with_scale(self, metres_per_unit: float) -> Similarity:
        """The similarity of another scale that keeps the mean of the positions."""
        rotation = self.fit.metres_from_units.rotation
        return Similarity(metres_per_unit, rotation, self.middle_m - metres_per_unit * (rotation @ self.middle_units))


def read_known_positions(source: Path, up: str, find: Finder) -> KnownPositions:
    """Reads positions and fits them; those of photographs that are not in the part are left out.

    ValueError if they are too few, on one line, or contradict the poses.
    """
    known, own_down = known_positions(source)
    within = {name: position for name, position in known.items() if name in find}
    if not within:
        some = ", ".join(sorted(known)[:3])
        raise ValueError(f"{source}: none of its names ({some}, ...) is that of a photograph of this part")
    pairs = find.all_of(within, str(source))
    fit = align(pairs, str(source))
    middle_m, middle_units = (np.mean([pair[i] for pair in pairs.values()], axis=0) for i in range(2))
    down_in_positions = -_axis(up) if up else own_down
    down = None
    if down_in_positions is not None:
        direction = fit.metres_from_units.rotation.T @ down_in_positions
        down = Down(direction, _tilt_sigma_deg(pairs, fit), POSITIONS_BOUND_DEG, f"the axes of {source.name}")
    left_out = len(known) - len(within)
    notes = [f"{source.name}: {left_out} of {len(known)} positions are of other photographs"] if left_out else []
    return KnownPositions(source.name, fit, middle_m, middle_units, down, tuple(notes))


def known_positions(source: Path) -> tuple[dict[str, Array], Array | None]:
    """Positions by name, metres, and the way down in their frame, None if it is not known.

    ValueError if the source cannot be read, or is not in metres.
    """
    if not source.is_dir():
        return read_positions(source), None
    dataset = read_dataset(source)
    if not dataset.metric:
        raise ValueError(f"{source}: its unit of length is not the metre")
    up = UP_OF_FORMATS.get(dataset.format, "")
    down = dataset.down_in_world
    known = {frame.image_path.name: frame.world_from_camera.translation for frame in dataset.frames}
    return known, np.array(down) if down is not None else -_axis(up) if up else None


def _axis(name: str) -> Array:
    sign = -1.0 if name.startswith("-") else 1.0
    return np.asarray(sign * np.eye(3)[AXES.index(name) % 3])


def _tilt_sigma_deg(pairs: dict[str, tuple[Array, Array]], fit: MetreFit) -> float:
    """The standard deviation of the fitted rotation about the axis along which positions spread most."""
    target = np.array([pair[0] for pair in pairs.values()])
    spread_m = np.linalg.svd(target - target.mean(axis=0), compute_uv=False)[1]
    return max(math.degrees(math.atan2(fit.residual_m, float(spread_m))), 0.2)
