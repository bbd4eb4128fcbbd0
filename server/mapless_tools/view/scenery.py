"""The layout of a scene's references: their places and sizes, and which of them have their photographs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless import Reference, Scene
from mapless.geometry import Array, RigidTransform
from mapless_tools.plan import down_of

_TURN_WEIGHT = 0.4
"""How far apart two cameras count that stand at one place and look opposite ways, in spreads of the scene."""


@dataclass(frozen=True, eq=False)
class Scenery:
    """References as they are laid out.

    Those drawn as frustums (`pictured`, indices) are each far from the previous ones, and their length `size_m` does
    not hide their neighbours. The world position `origin` (3,) is drawn at zero, since browsers compute in single
    precision; `down` (3,) is a unit vector of gravity.
    """

    references: tuple[Reference, ...]
    pictured: NDArray[np.intp]
    origin: Array
    down: Array
    size_m: float
    extent_m: float

    def placed(self, pose: RigidTransform) -> RigidTransform:
        """A pose in drawn coordinates."""
        return pose.shifted(-self.origin)

    def neighbours(self, index: int, count: int) -> list[Reference]:
        """References that show about the same as one: near it, and with a similar direction."""
        apart = np.linalg.norm(_spots(self.references) - _spots(self.references)[index], axis=1)
        return [self.references[i] for i in np.argsort(apart, kind="stable") if i != index][:count]


def lay_out(scene: Scene, references: Sequence[Reference], max_pictured: int) -> Scenery:
    """The scenery of a scene; ValueError if there are no references."""
    if not references:
        raise ValueError(f"scene {scene.scene_id} has no references to show")
    centres = np.stack([it.world_from_camera.translation for it in references])
    origin = np.median(centres, axis=0)
    pictured = spread_out(_spots(references), max_pictured)
    extent_m = max(float(np.linalg.norm(np.quantile(centres, 0.95, axis=0) - np.quantile(centres, 0.05, axis=0))), 0.1)
    down = down_of(scene, [it.world_from_camera for it in references])
    return Scenery(tuple(references), pictured, origin, down, _size_m(centres[pictured]), extent_m)


def spread_out(spots: Array, count: int) -> NDArray[np.intp]:
    """Indices of at most `count` rows of (N, D), each the farthest from all before it, from the central one on."""
    first = int(np.argmin(np.linalg.norm(spots - np.median(spots, axis=0), axis=1)))
    chosen, apart = [first], np.linalg.norm(spots - spots[first], axis=1)
    while len(chosen) < min(count, len(spots)):
        apart[chosen] = -1.0  # others may stand at the same place
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.linalg.norm(spots - spots[chosen[-1]], axis=1))
    return np.array(chosen, np.intp)


def _spots(references: Sequence[Reference]) -> Array:
    """Positions and directions (N, 6) of the cameras, in units of the scene's spread."""
    centres = np.stack([it.world_from_camera.translation for it in references])
    spread = max(float(np.linalg.norm(centres.std(axis=0))), 1e-6)
    ahead = np.stack([it.world_from_camera.rotation[:, 2] for it in references])
    return np.concatenate([(centres - np.median(centres, axis=0)) / spread, 0.5 * _TURN_WEIGHT * ahead], axis=1)


def _size_m(centres: Array) -> float:
    if len(centres) < 2:
        return 0.3
    some = centres[:200]
    apart = np.linalg.norm(some[:, None] - centres[None], axis=2)
    apart[apart < 1e-6] = np.inf
    nearest = apart.min(axis=1)
    nearest = nearest[np.isfinite(nearest)]
    return float(np.clip(0.35 * np.median(nearest), 0.01, 3.0)) if len(nearest) else 0.3
