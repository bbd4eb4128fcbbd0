"""Whether a folder's poses are in the scene's world: else every answer is wrong, and all are wrong in the same way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapless.geometry import RigidTransform
from mapless_tools.evaluate.metrics import pose_error

from .queries import Outcome

MIN_ANSWERS = 3
"""Two could agree by chance."""
FAR = 3.0
"""Answers are suspected where half of them are off by more than so many of their claimed 95 % radii."""
EXPLAINED = 0.2
"""One rigid motion explains them if it leaves at most this share of half of the errors."""


@dataclass(frozen=True)
class OtherWorld:
    """How a folder's world lies in the scene's, as the answers say.

    Attributes:
        moved_m, turned_deg: of the folder's frame.
        left_m: median error once that is undone.
    """

    moved_m: float
    turned_deg: float
    left_m: float

    def __str__(self) -> str:
        return (
            f"the folder's poses are in another world than the scene: answers agree with them to {self.left_m:.3g} m, "
            f"once these are turned by {self.turned_deg:.3g} degrees and moved by {self.moved_m:.3g} m"
        )


def other_world(outcomes: Sequence[Outcome]) -> OtherWorld | None:
    """The motion between the two worlds; None where answers do not say that there is one.

    Each answer's scene_from_folder = answered pose times inverse true pose is a candidate; the one that leaves the
    smallest median error is taken.
    """
    found = [it for it in outcomes if it.pose is not None and it.position is not None]
    if len(found) < MIN_ANSWERS:
        return None
    in_radii = [it.error_m / max(it.position.radius_95, np.finfo(float).tiny) for it in found if it.position]
    if np.median(in_radii) <= FAR:
        return None
    candidates = [it.pose.compose(it.true_pose.inverse()) for it in found if it.pose]
    left = [_median_error_m(found, candidate) for candidate in candidates]
    best = int(np.argmin(left))
    if left[best] > EXPLAINED * float(np.median([it.error_m for it in found])):
        return None
    moved_m, turned_deg = pose_error(RigidTransform(np.eye(3), np.zeros(3)), candidates[best])
    return OtherWorld(moved_m, turned_deg, left[best])


def _median_error_m(found: Sequence[Outcome], scene_from_folder: RigidTransform) -> float:
    off = [it.pose.translation - scene_from_folder.apply(it.true_pose.translation) for it in found if it.pose]
    return float(np.median(np.linalg.norm(off, axis=1)))
