"""Poses by time, and trees of frames as tf has them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from mapless.geometry import RigidTransform


class Trajectory:
    """Poses at times, and interpolated between them: positions linearly, rotations along the shortest arc."""

    def __init__(self, table: ArrayLike, max_gap_s: float, lost_s: ArrayLike = ()) -> None:
        """Reads rows of time (seconds), position and quaternion x y z w, in any order; of equal times the first counts.

        `max_gap_s` is the largest time to the poses before and after. Between two poses with one of the times `lost_s`
        between them there is none. Raises ValueError for fewer than two poses.
        """
        rows = np.asarray(table, float).reshape(-1, 8)
        _, order = np.unique(rows[:, 0], return_index=True)
        rows = rows[order]
        if len(rows) < 2:
            raise ValueError("holds fewer than two poses")
        self._max_gap_s = max_gap_s
        self._lost_s = np.sort(np.asarray(lost_s, float))
        self._time_s: NDArray[np.float64] = rows[:, 0]
        self._position = rows[:, 1:4]
        self._slerp = Slerp(self._time_s, Rotation.from_quat(rows[:, 4:]))

    def at(self, time_s: float) -> RigidTransform:
        """The pose at a time; ValueError if no pose is near."""
        after = int(np.searchsorted(self._time_s, time_s))
        before = after if after < len(self._time_s) and self._time_s[after] == time_s else after - 1
        if before < 0 or after >= len(self._time_s):
            raise ValueError("pose: its time lies outside those of the poses")
        gap_s = max(time_s - self._time_s[before], self._time_s[after] - time_s)
        if gap_s > self._max_gap_s:
            limit = f"{1000 * self._max_gap_s:g} ms"
            raise ValueError(f"pose: there is none within {limit} before and after, only {1000 * gap_s:.0f}")
        if np.searchsorted(self._lost_s, self._time_s[before], "right") < np.searchsorted(
            self._lost_s, self._time_s[after]
        ):
            raise ValueError("pose: tracking was lost at that time")
        span_s = self._time_s[after] - self._time_s[before]
        share = (time_s - self._time_s[before]) / span_s if span_s else 0.0
        position = (1 - share) * self._position[before] + share * self._position[after]
        return RigidTransform(self._slerp(time_s).as_matrix(), position)


@dataclass(frozen=True, eq=False)
class Edge:
    """A frame's parent, and its pose in the parent: constant, or by time."""

    parent: str
    pose: RigidTransform | Trajectory

    def at(self, time_s: float) -> RigidTransform:
        """The pose parent_from_child; ValueError as in `Trajectory.at`."""
        return self.pose if isinstance(self.pose, RigidTransform) else self.pose.at(time_s)


@dataclass(frozen=True, eq=False)
class FrameTree:
    """Frames by name, each with the edge to its parent."""

    edges: Mapping[str, Edge]

    def lineage(self, frame: str) -> list[str]:
        """The frame, its parent and so on, up to a root."""
        found = [frame]
        while (edge := self.edges.get(found[-1])) is not None and edge.parent not in found:
            found.append(edge.parent)
        return found

    def lookup(self, target: str, source: str, time_s: float) -> RigidTransform:
        """Gives target_from_source at a time; LookupError if no frames connect them, ValueError without a pose then."""
        ancestors = self.lineage(target)
        common = next((it for it in self.lineage(source) if it in ancestors), None)
        if common is None:
            raise LookupError(f"nothing connects frame {source!r} with {target!r}")
        return self._up(target, common, time_s).inverse().compose(self._up(source, common, time_s))

    def _up(self, frame: str, ancestor: str, time_s: float) -> RigidTransform:
        pose = RigidTransform.identity()
        while frame != ancestor:
            edge = self.edges[frame]
            pose, frame = edge.at(time_s).compose(pose), edge.parent
        return pose
