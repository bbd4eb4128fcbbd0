"""Poses and photographs that are given several times.

References with exactly the same pose are photographs from one place: of a camera that stands still, or of a tracker
that had not begun and gave the same pose, often the identity, to photographs of different things. The same photograph
with two poses has at least one wrong one.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from mapless.geometry import RigidTransform, rotation_angle_deg

from .errors import FEW_SHARE, MatchedPair, Pair, PairError, Views

OFF_FACTOR = 4.0
"""Photographs of one place show different things if their error is so many times that of a good pair; a pose that is
given to the next frames of a video, too, is off by less."""
SAME_PX = 0.5
"""Largest median distance of the matched keypoints of one photograph that is stored twice, encoded anew."""
SAME_TURN_DEG = 1.0
"""Poses of such a photograph contradict each other if they differ by more: a camera that stands still has the
tracking's noise. Distances contradict from `FEW_SHARE` of the median distance of matched pairs on."""
EXACT_DIGITS = 8
"""Digits after the point to which numbers of a pose are equal but for rounding."""


def decimal(digits: int) -> float:
    """The unit of the last of so many digits after the point."""
    return 10.0**-digits


def same_poses(poses: Mapping[int, RigidTransform]) -> list[tuple[int, ...]]:
    """Groups of two and more photographs with exactly the same pose."""
    groups: dict[tuple[float, ...], list[int]] = {}
    for i, pose in poses.items():
        numbers = np.concatenate([pose.rotation.ravel(), pose.translation])
        groups.setdefault(tuple((np.round(numbers, EXACT_DIGITS) + 0.0).tolist()), []).append(i)
    return [tuple(group) for group in groups.values() if len(group) > 1]


def is_start(pose: RigidTransform) -> bool:
    """Whether a pose is the identity, as that of a tracker that has not begun; possibly in a format's other axes."""
    axes, least = np.abs(pose.rotation), decimal(EXACT_DIGITS)
    return bool(np.abs(pose.translation).max() < least and np.abs(axes - np.round(axes)).max() < least)


def contradicting_groups(
    poses: Mapping[int, RigidTransform], errors: Sequence[PairError], unmatched: Sequence[Pair] = ()
) -> list[tuple[int, ...]]:
    """Groups with exactly the same pose whose photographs show different things, by errors and pairs without matches.

    A pair without matches alone contradicts nothing: light or season may have changed.
    """
    found = []
    for group in same_poses(poses):
        inside = [it for it in errors if set(it.pair) <= set(group)]
        off = sum(it.error_px > OFF_FACTOR * it.threshold_px for it in inside)
        missing = sum(set(pair) <= set(group) for pair in unmatched)
        if off + missing > len(inside) - off and (off or (len(group) > 2 and missing > 1)):
            found.append(group)
    return found


def same_photographs(views: Views, matched: Sequence[MatchedPair]) -> list[Pair]:
    """Pairs that are one photograph, with poses that differ."""
    differences = [pose_difference(*(views[i].world_from_camera for i in item.pair)) for item in matched]
    baselines = [apart for apart, _ in differences]
    typical = float(np.median([it for it in baselines if it > 0])) if any(baselines) else 0.0
    found = []
    for item, (apart, turn_deg) in zip(matched, differences, strict=True):
        first, second = (views[i].view for i in item.pair)
        if not first.has_camera_of(second) or len(item.matches) < min(len(first.features), len(second.features)) / 2:
            continue
        ours, theirs = (view.features.keypoints[item.matches[:, side]] for side, view in enumerate((first, second)))
        is_other = turn_deg > SAME_TURN_DEG or apart > FEW_SHARE * typical
        if is_other and np.median(np.linalg.norm(ours - theirs, axis=1)) < SAME_PX:
            found.append(item.pair)
    return found


def pose_difference(first: RigidTransform, second: RigidTransform) -> tuple[float, float]:
    """Distance of two cameras, in the poses' unit, and the angle between them, degrees."""
    apart = float(np.linalg.norm(first.translation - second.translation))
    return apart, rotation_angle_deg(first.rotation.T @ second.rotation)
