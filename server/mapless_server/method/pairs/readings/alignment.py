"""The similarity between two worlds, from matched photographs of both.

The relative pose of two photographs is known from their matches up to its length. With their poses in either world it
gives the rotation between the worlds, and the direction d from the first camera to the second. For scale s and
translation t,

    [d]x (s R c_second + t - c_first) = 0,

which is linear: two pairs determine it, if their cameras do not all lie on one line. The best of many such solutions is
refined by the distances of all matches (see `errors`).
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import poselib

from mapless.geometry import Array, Similarity, cross_matrix, rotation_angle_deg, rotation_from_vector

from ...features.limits import LOSS_SCALE_PX
from ...features.views import PosedView
from ...optim.optimize import MinimizeOptions, damped_step, minimize, soft_l1, soft_l1_weight
from ...optim.rotations import rotation_vector
from .errors import FEW_SHARE, SAMPLED_MATCHES, MatchedPair, PairSample, Views, summary

MOST_PAIRS = 24
"""Pairs that are used, those with the most matches; every two of them give a solution."""
AGREEING_DEG = 5.0
"""Between the rotations of two pairs. Relative poses of few matches are off by a degree or two."""
LEAST_PAIRS = 3
"""Fewer pairs do not show that a similarity is right: two may agree by chance."""
MIN_PHOTOGRAPHS = 2
"""Photographs of either world that take part: at one alone no distance of its world is seen."""
MAX_SIGMA = 0.03
"""Largest standard deviation of the scale of a unique similarity, relative, and of the position of the other session's
middle, as a share of its extent or, if that is more, of the distance between paired cameras."""
MAX_ROTATION_SIGMA = math.radians(1.0)
"""The same of its rotation, radians."""
STEPS = MinimizeOptions(30, 1e-6)
"""Steps of the refinement."""
_DIFFERENCE = 1e-6
"""Change of a parameter by which derivatives are taken."""
_INFLATION = 3.0
"""Factor on standard deviations: errors of matches of a pair, and of poses of a session, are not independent."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """The similarity from another world to this one, and how well it is known.

    Attributes:
        world_from_other: the similarity.
        median_px: median error of the pairs with it.
        bad_share: share of the pairs that do not fit with it.
        pair_count: number of pairs.
        scale_sigma: standard deviation of the scale, relative.
        rotation_sigma: standard deviation of the rotation, radians.
        position_sigma: standard deviation of the position of the other session's middle, as a share of its extent.
    """

    world_from_other: Similarity
    median_px: float
    bad_share: float
    pair_count: int
    scale_sigma: float
    rotation_sigma: float
    position_sigma: float

    @property
    def is_unique(self) -> bool:
        """Whether the pairs determine all of it, and fit."""
        is_known = max(self.scale_sigma, self.position_sigma) <= MAX_SIGMA and self.rotation_sigma <= MAX_ROTATION_SIGMA
        return self.bad_share <= FEW_SHARE and is_known

    @property
    def text(self) -> str:
        """The similarity in words: scale, rotation and translation, applied in this order."""
        it = self.world_from_other
        angle_deg, axis = rotation_angle_deg(it.rotation), rotation_vector(it.rotation)
        axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
        about = f" about ({', '.join(f'{number:.3f}' for number in axis + 0.0)})" if angle_deg >= 0.05 else ""
        shift = ", ".join(f"{number:.3f}" for number in it.translation + 0.0)
        return f"scale {it.scale:.4g}, rotation by {angle_deg:.1f} degrees{about}, translation ({shift})"


def align(views: Views, matched: Sequence[MatchedPair]) -> Alignment | None:
    """Finds the similarity from the world of the pairs' second photographs to that of their first ones.

    None if the pairs are too few, or no similarity fits any of them.
    """
    matched = sorted(matched, key=lambda it: -len(it.matches))[:MOST_PAIRS]
    fewest = min(len({it.pair[side] for it in matched}) for side in (0, 1)) if matched else 0
    if len(matched) < LEAST_PAIRS or fewest < MIN_PHOTOGRAPHS:
        return None
    sample = PairSample(views, matched, SAMPLED_MATCHES)
    worlds = _Worlds.of(sample, [it.pair for it in matched])
    start = _start(worlds, _relative_poses(views, matched))
    return None if start is None else worlds.refined(start)


def align_sessions(
    views: Views, matched: Sequence[MatchedPair], first: Collection[int], second: Collection[int]
) -> Alignment | None:
    """Finds the similarity from the world of the `second` photographs to that of the `first`, by pairs between them.

    None unless the pairs determine all of it.
    """
    between = [
        item if item.pair[0] in first else MatchedPair((item.pair[1], item.pair[0]), item.matches[:, ::-1])
        for item in matched
        if len(item.matches) and any(a in first and b in second for a, b in (item.pair, item.pair[::-1]))
    ]
    found = align(views, between)
    return found if found is not None and found.is_unique else None


@dataclass(frozen=True, eq=False)
class _Worlds:
    """Pairs between two worlds, and the sum of the losses of all distances, over similarities; see `optimize.Problem`.

    Similarities are changed about the middles of both worlds, and by their extent: so they have few correlations.
    """

    sample: PairSample
    middle: Array
    other_middle: Array
    extent: float

    @staticmethod
    def of(sample: PairSample, pairs: Sequence[tuple[int, int]]) -> "_Worlds":
        ends = [np.array([sample.views[pair[side]].world_from_camera.translation for pair in pairs]) for side in (0, 1)]
        middles = [it.mean(axis=0) for it in ends]
        extents = [float(np.linalg.norm(it - middle, axis=1).max()) for it, middle in zip(ends, middles, strict=True)]
        return _Worlds(sample, middles[0], middles[1], max(*extents, 1e-9))

    def measured(self, similarity: Similarity) -> tuple[float, float]:
        """Median error of the pairs, and their bad share."""
        errors = self.sample.measure(self.sample.views, self.moved(similarity))
        costs = [math.inf if it.is_behind else it.error_px for it in errors]
        return float(np.median(costs)), summary(errors)[1]

    def moved(self, similarity: Similarity) -> Mapping[int, PosedView]:
        """The views of the other world in this one."""
        return {
            i: replace(view, world_from_camera=similarity.transform_pose(view.world_from_camera))
            for i, view in self.sample.views.items()
        }

    def changed(self, start: Similarity, x: Array) -> Similarity:
        """A similarity after a change (7,): logarithm of the scale, rotation, and shift of the middle in extents."""
        scale = start.scale * math.exp(x[0])
        rotation = rotation_from_vector(x[1:4]) @ start.rotation
        middle = start.apply(self.other_middle) + x[4:] * self.extent
        return Similarity(scale, rotation, middle - scale * rotation @ self.other_middle)

    def refined(self, start: Similarity) -> Alignment:
        """Minimizes the distances of all matches."""
        found = minimize(self, start, STEPS)
        median_px, bad_share = self.measured(found)
        information = self.linearize(found)[0] / max(_INFLATION * median_px, 1e-3) ** 2
        sigmas = np.sqrt(np.maximum(np.diag(np.linalg.pinv(information + 1e-12 * np.eye(7))), 0.0))
        scale, rotation, position = float(sigmas[0]), float(sigmas[1:4].max()), float(sigmas[4:].max())
        return Alignment(found, median_px, bad_share, len(self.sample.pairs), scale, rotation, position)

    def distances_px(self, x: Similarity) -> Array:
        """Signed distances of all matches, pixels; 0 where there is none."""
        found = self.sample.distances_px(self.sample.views, self.moved(x))
        return np.asarray(np.nan_to_num(found, nan=0.0, posinf=0.0, neginf=0.0))

    def cost(self, x: Similarity) -> float:
        """See Problem."""
        return float(soft_l1(self.distances_px(x) ** 2, LOSS_SCALE_PX).sum())

    def linearize(self, x: Similarity) -> tuple[Array, Array]:
        """Normal equations (7, 7), (7,); derivatives by differences."""
        steps = _DIFFERENCE * np.eye(7)
        changes = [self.distances_px(self.changed(x, it)) - self.distances_px(self.changed(x, -it)) for it in steps]
        derivatives = np.stack(changes, axis=1) / (2 * _DIFFERENCE)
        distances = self.distances_px(x)
        weighted = derivatives * soft_l1_weight(distances**2, LOSS_SCALE_PX)[:, None]
        return weighted.T @ derivatives, weighted.T @ distances

    def step(self, x: Similarity, equations: tuple[Array, Array], damping: float) -> Similarity | None:
        """See Problem."""
        change = damped_step(*equations, damping)
        return None if change is None else self.changed(x, change)


def _relative_poses(views: Views, matched: Sequence[MatchedPair]) -> list[tuple[Array, Array, Array, Array]]:
    """For each pair: rotation between the worlds, direction between the cameras in the first, and the two centres."""
    found = []
    for item in matched:
        first, second = (views[i] for i in item.pair)
        points = [it.view.features.pixels(item.matches[:, side]) for side, it in enumerate((first, second))]
        pose, _ = poselib.estimate_relative_pose(points[0], points[1], _pinhole(first), _pinhole(second), {}, {})
        rotation = np.asarray(pose.R)  # second_from_first
        centre = -rotation.T @ np.asarray(pose.t)
        length = float(np.linalg.norm(centre))
        if not length > 0:
            continue
        a, b = first.world_from_camera, second.world_from_camera
        between = a.rotation @ rotation.T @ b.rotation.T
        found.append((between, a.rotation @ centre / length, a.translation, b.translation))
    return found


def _pinhole(view: PosedView) -> dict[str, object]:
    it = view.view.camera
    params = [it.focal_x_px, it.focal_y_px, it.principal_x_px, it.principal_y_px]
    return {"model": "PINHOLE", "width": it.width_px, "height": it.height_px, "params": params}


def _start(worlds: _Worlds, poses: Sequence[tuple[Array, Array, Array, Array]]) -> Similarity | None:
    """The solution of two pairs, or of all, that fits best; None if none fits half of the pairs."""
    agreeing = [
        [k for k, other in enumerate(poses) if rotation_angle_deg(one[0].T @ other[0]) < AGREEING_DEG] for one in poses
    ]
    chosen = max(agreeing, key=len, default=[])
    if len(chosen) < 2:
        return None
    u, _, vt = np.linalg.svd(np.sum([poses[k][0] for k in chosen], axis=0))
    rotation = np.asarray(u @ vt)
    if np.linalg.det(rotation) < 0:
        return None
    subsets = combinations(chosen, 2)
    candidates = [_linear(worlds, rotation, [poses[k] for k in subset]) for subset in [chosen, *subsets]]
    scored = [(*worlds.measured(it)[::-1], it) for it in candidates if it is not None]
    bad_share, _, best = min(scored, key=lambda it: it[:2], default=(1.0, math.inf, None))
    return best if bad_share < 1.0 else None


def _linear(worlds: _Worlds, rotation: Array, poses: Sequence[tuple[Array, Array, Array, Array]]) -> Similarity | None:
    rows, sides = [], []
    for _, direction, centre, other_centre in poses:
        cross = cross_matrix(direction)
        rows.append(np.column_stack([cross @ rotation @ (other_centre - worlds.other_middle), cross]))
        sides.append(cross @ (centre - worlds.middle))
    solution, _, rank, _ = np.linalg.lstsq(np.concatenate(rows), np.concatenate(sides), rcond=1e-6)
    if rank < 4 or not solution[0] > 0:
        return None
    scale = float(solution[0])
    return Similarity(scale, rotation, solution[1:] + worlds.middle - scale * rotation @ worlds.other_middle)
