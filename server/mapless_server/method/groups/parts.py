"""What each photograph contributes to the adjustment of its group: points, tracks, and how often each was measured.

A reference's keypoint that serves several photographs is one measurement, not several: its information is divided among
them. So points that are the same one, known by two photographs, need not be found.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform

from ..pnp import reprojection_errors_px
from ..results import PointMatches
from ..tracks import Tracks
from ..uncertainty.linearization import tracks_with_query
from .freedom import Freedom
from .images import MatchedImage


@dataclass(frozen=True, eq=False)
class Part:
    """What a photograph contributes.

    Attributes:
        source: the photograph.
        world_from_camera: its pose at the start.
        chosen: (P_b,) points of its structure that it is matched with.
        tracks: of these, over its references and, last, the photograph itself.
    """

    source: MatchedImage
    world_from_camera: RigidTransform
    chosen: NDArray[np.intp]
    tracks: Tracks


def part_of(
    source: MatchedImage, matches: PointMatches, freedom: Freedom, max_error_px: float, max_matches: int
) -> Part:
    """With the matches that are near enough, evenly thinned."""
    structure, pose = source.structure, freedom.camera_from_world(source.image).inverse()
    pixels = source.query.features.keypoints[matches.keypoint].astype(np.float64)
    errors_px = reprojection_errors_px(source.query.camera, pose, structure.x_in_world[matches.point], pixels)
    used = np.flatnonzero(errors_px < max_error_px)
    used = used[:: max(1, -(-len(used) // max_matches))]
    tracks, chosen = tracks_with_query(structure, matches.point[used], matches.keypoint[used], len(source.references))
    return Part(source, pose, np.flatnonzero(chosen), tracks)


class Shared:
    """How often measurements of keypoints stand in a group."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self._times: Counter[object] = Counter()
        for part in parts:
            self._times.update(_measurements(part))

    def times(self, part: Part) -> Array:
        """(O,) of a part's observations."""
        return np.array([self._times[it] for it in _measurements(part)], np.float64)


def _measurements(part: Part) -> list[object]:
    """What identifies each observation: the photograph and the keypoint."""
    views = [it.view for it in part.source.references]
    # A photograph of the group that was sent twice was measured once.
    names: list[object] = [it.key for it in part.source.references]
    names.append(part.source.query.features.keypoints.tobytes())
    keypoints = [it.features.keypoints for it in (*views, part.source.query)]
    rows = zip(part.tracks.view.tolist(), part.tracks.keypoint.tolist(), strict=True)
    return [(names[v], *keypoints[v][k].tolist()) for v, k in rows]
