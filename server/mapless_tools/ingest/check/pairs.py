"""Choice of the photographs of a folder that are compared."""

from collections.abc import Iterable, Sequence
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform
from mapless_server.method.pairs.readings.errors import Pair
from mapless_server.method.pairs.readings.repeats import same_poses

PAIR_COUNT = 24
"""Enough that a median over them is settled; their features take seconds."""
MAX_TURN_DEG = 40.0
"""Beyond it SIFT finds few matches, and the views may share nothing."""
BASELINE_SHARE = 0.05
"""Least baseline as a share of the scene's extent: for neighbours in a video almost any pose would fit."""
SAME_POSE_GROUPS, SAME_POSE_PAIRS = 6, 6
"""Groups with the same pose that are compared, and pairs of each."""
ORDER_STEPS = (1, 3, 10, 30)
"""How far apart in the folder's order photographs are compared if their poses do not show which are near."""


def pairs_by_pose(poses: Sequence[RigidTransform]) -> list[Pair]:
    """Pairs of neighbours that look the same way, with a good baseline; of few photographs each is in several."""
    near = _Neighbours(poses)
    rounds = (_partner_of_each(near, len(poses), rank) for rank in range(3))
    return _distinct(chain.from_iterable(rounds))


def pairs_of_same_pose(poses: Sequence[RigidTransform]) -> list[Pair]:
    """Pairs of photographs with exactly the same pose: some of each group, those that are furthest apart in the order.

    Neighbours in the order may show the same although the camera moved.
    """
    pairs = []
    for group in same_poses(dict(enumerate(poses)))[:SAME_POSE_GROUPS]:
        half = (len(group) + 1) // 2
        found = [(group[k], group[(k + half) % len(group)]) for k in range(len(group))]
        spread = [found[int(k)] for k in np.linspace(0, len(found) - 1, min(len(found), SAME_POSE_PAIRS)).round()]
        pairs += [(min(pair), max(pair)) for pair in spread]
    return list(dict.fromkeys(pairs))


def more_pairs(poses: Sequence[RigidTransform], reference: int, known: Sequence[Pair], count: int) -> list[Pair]:
    """Further pairs of one photograph."""
    near = _Neighbours(poses)
    candidates = [(min(reference, other), max(reference, other)) for other in near.ranked(reference)]
    return [pair for pair in candidates if pair not in known][:count]


def pairs_by_order(frame_count: int) -> list[Pair]:
    """Pairs of photographs that are near in the folder's order, spread over it."""
    each = PAIR_COUNT // len(ORDER_STEPS)
    pairs = (
        (int(first), int(first) + step)
        for step in ORDER_STEPS
        if step < frame_count
        for first in np.linspace(0, frame_count - 1 - step, each).round()
    )
    return _distinct(pairs)


class _Neighbours:
    def __init__(self, poses: Sequence[RigidTransform]) -> None:
        self._centre: Array = np.array([pose.translation for pose in poses])
        self._ahead: Array = np.array([pose.rotation[:, 2] for pose in poses])
        extent = 2 * float(np.median(np.linalg.norm(self._centre - np.median(self._centre, axis=0), axis=1)))
        sample = np.linspace(0, len(poses) - 1, min(len(poses), PAIR_COUNT)).round().astype(int)
        nearest = [distances.min() for i in sample if len(distances := self._distances(int(i))[1])]
        self._baseline = max(float(np.median(nearest)) if nearest else 0.0, BASELINE_SHARE * extent)

    def ranked(self, reference: int) -> list[int]:
        """Photographs that look the same way, the best baseline first."""
        others, distances = self._distances(reference)
        aligned = self._ahead[others] @ self._ahead[reference] > np.cos(np.radians(MAX_TURN_DEG))
        others, distances = others[aligned], distances[aligned]
        return [int(i) for i in others[np.argsort(np.abs(np.log(distances / self._baseline)), kind="stable")]]

    def _distances(self, reference: int) -> tuple[NDArray[np.intp], Array]:
        distances = np.linalg.norm(self._centre - self._centre[reference], axis=1)
        elsewhere = np.flatnonzero(distances > 1e-6)
        return elsewhere, distances[elsewhere]


def _partner_of_each(near: _Neighbours, frame_count: int, rank: int) -> list[Pair]:
    anchors = np.linspace(0, frame_count - 1, min(frame_count, PAIR_COUNT)).round().astype(int)
    found = ((int(anchor), near.ranked(int(anchor))[rank : rank + 1]) for anchor in anchors)
    return [(min(anchor, others[0]), max(anchor, others[0])) for anchor, others in found if others]


def _distinct(pairs: Iterable[Pair]) -> list[Pair]:
    return list(dict.fromkeys(pairs))[:PAIR_COUNT]
