"""Votes: the query's matches with each reference, carried to the points that the references' keypoints observe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform

from ..perturbation import reprojection_errors_px
from ..results import Structure, Support
from ..views import Matches, PosedView, View


@dataclass(frozen=True, eq=False)
class Votes:
    """Matches with each reference, carried to points; row v is one match.

    Attributes:
        reference: (V,) index of the reference.
        keypoint: (V,) of the query.
        x_in_world: (V, 3) the point.
        pixels: (V, 2) the keypoint.
    """

    reference: NDArray[np.intp]
    keypoint: NDArray[np.intp]
    x_in_world: Array
    pixels: Array

    def __getitem__(self, rows: NDArray[np.bool_]) -> Votes:
        return Votes(self.reference[rows], self.keypoint[rows], self.x_in_world[rows], self.pixels[rows])

    def errors_px(self, camera: Camera, world_from_camera: RigidTransform) -> Array:
        """Distances (V,) of the points' projections from the keypoints; NaN behind the camera."""
        return reprojection_errors_px(camera, world_from_camera, self.x_in_world, self.pixels)

    def keypoint_count(self, rows: NDArray[np.bool_]) -> int:
        """Number of different keypoints among the selected rows (V,)."""
        return len(np.unique(self.keypoint[rows]))


def votes_of(support: Support, query_matches: Sequence[Matches]) -> Votes:
    """The matches with keypoints of triangulated points."""
    return votes_on(support.query, support.references, support.structure, query_matches)


def votes_on(
    query: View, references: Sequence[PosedView], structure: Structure, query_matches: Sequence[Matches]
) -> Votes:
    """The matches of a query with keypoints of a structure's points; `references` in the order of its tracks."""
    tracks = structure.tracks
    offsets = np.concatenate([[0], np.cumsum([len(r.view.features) for r in references])])
    point_of = np.full(offsets[-1], -1)
    point_of[offsets[tracks.view] + tracks.keypoint] = tracks.point
    reference = np.repeat(np.arange(len(query_matches)), [len(m) for m in query_matches])
    pairs = np.concatenate([np.asarray(m, np.intp).reshape(-1, 2) for m in query_matches])
    point = point_of[offsets[reference] + pairs[:, 1]]
    known = point >= 0
    keypoint = pairs[known, 0]
    pixels = query.features.keypoints[keypoint].astype(np.float64)
    return Votes(reference[known], keypoint, structure.x_in_world[point[known]], pixels)
