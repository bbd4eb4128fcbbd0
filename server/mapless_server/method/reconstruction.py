"""Reconstruction, the result of the coarse stage: query and references in one local frame, up to one common scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera, RigidTransform


@dataclass(frozen=True, eq=False)
class ReconstructedView:
    """One view's part of a reconstruction.

    Attributes:
        camera: pinhole, in pixels of the maps below; the view's own camera, moved and scaled along the axes.
        point_map: (H, W, 3) float32, the point seen at each pixel, in this camera's frame, up to the common scale; NaN
            where unknown.
        confidence: (H, W) float32, 0 to 1; 0 where unknown.
        local_from_camera: the camera's pose in the reconstruction's frame, up to the common scale.
    """

    camera: Camera
    point_map: NDArray[np.float32]
    confidence: NDArray[np.float32]
    local_from_camera: RigidTransform

    def depth_at(self, pixels: NDArray[np.floating], camera: Camera) -> NDArray[np.float64]:
        """Depth (N,) at pixels (N, 2) of the view's camera, nearest neighbour; NaN where unknown."""
        rows, columns, inside = self.cells(pixels, camera)
        depth = np.full(len(pixels), np.nan)
        depth[inside] = self.point_map[rows[inside], columns[inside], 2]
        return depth

    def cells(
        self, pixels: NDArray[np.floating], camera: Camera
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
        """Rows and columns (N,) of the maps' cells at pixels (N, 2) of the view's camera, and which lie in the maps."""
        return map_cells(self.camera, pixels, camera)


def map_cells(
    map_camera: Camera, pixels: NDArray[np.floating], camera: Camera
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Rows and columns (N,) of the cells of one camera's maps at pixels (N, 2) of another; and which lie inside."""
    mapped = np.rint(map_camera.project(camera.rays(pixels)))
    inside = np.asarray(((mapped >= 0) & (mapped < (map_camera.width_px, map_camera.height_px))).all(axis=1))
    columns, rows = np.where(inside[:, None], mapped, 0).astype(np.intp).T
    return rows, columns, inside


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Query and references in one local frame whose scale is unknown.

    Attributes:
        query: the query.
        references: the references, in order.
    """

    query: ReconstructedView
    references: tuple[ReconstructedView, ...]
