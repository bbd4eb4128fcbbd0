"""The coarse stage: query and references reconstructed together, up to one common scale.

A seam. The paper calls a feed-forward network here (its equation for Phi); whatever else gives local points,
confidences and poses in one local frame will do. A backend is one file in this package with a `Reconstructor`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera, RigidTransform

from ..correspond import Correspondences
from ..priors.known import NO_PRIORS, Priors
from ..rejection import Rejection
from ..views import PosedView, View

if TYPE_CHECKING:  # it needs torch
    from .device import DeviceReconstruction


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
        """Rows and columns (N,) of the maps' cells that hold pixels (N, 2) of the view's camera, and which exist."""
        return map_cells(self.camera, pixels, camera)


def map_cells(
    map_camera: Camera, pixels: NDArray[np.floating], camera: Camera
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Rows and columns (N,) of the cells of one camera's maps that hold pixels (N, 2) of another; and which exist."""
    mapped = np.rint(map_camera.project(camera.rays(pixels)))
    inside = np.asarray(((mapped >= 0) & (mapped < (map_camera.width_px, map_camera.height_px))).all(axis=1))
    columns, rows = np.where(inside[:, None], mapped, 0).astype(np.intp).T
    return rows, columns, inside


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Query and references in one local frame whose scale is unknown.

    Attributes:
        query: the query's part.
        references: one for each reference, in their order.
    """

    query: ReconstructedView
    references: tuple[ReconstructedView, ...]


Outcome: TypeAlias = "Reconstruction | DeviceReconstruction | Rejection"
"""What a backend says of one query: its reconstruction, or why there is none."""


@dataclass(frozen=True)
class Bucket:
    """Queries of one bucket may be reconstructed together; as text, a short name of it.

    Attributes:
        backend: its name.
        reference_count: of each query.
        grid: rows and columns of the pictures' patches; None for a backend that has none.
    """

    backend: str
    reference_count: int
    grid: tuple[int, int] | None = None

    def __str__(self) -> str:
        grid = [] if self.grid is None else ["x".join(map(str, self.grid))]
        return "-".join([self.backend, *grid, str(self.reference_count)])


@dataclass(frozen=True, eq=False)
class Request:
    """What is to be reconstructed together.

    Attributes:
        query: the photograph to localize.
        references: with known poses.
        correspondences: between them all; a network looks at the images alone and needs none.
        priors: what is known of the query's pose, in the world of the references; a network does not listen.
    """

    query: View
    references: Sequence[PosedView]
    correspondences: Correspondences | None = None
    priors: Priors = NO_PRIORS


class Reconstructor(Protocol):
    """A coarse backend.

    Attributes:
        name: "geometric", "pi3", ...
        weights_sha256: of the network's weights; empty without any.
        uses_correspondences: whether the answer depends on them. A network's does not, so it is asked once for a query,
            whatever else is tried with it.
    """

    @property
    def name(self) -> str:
        """See the class."""
        ...

    @property
    def weights_sha256(self) -> str:
        """See the class."""
        ...

    @property
    def uses_correspondences(self) -> bool:
        """See the class."""
        ...

    def close(self) -> None:
        """Gives back threads and devices; nothing follows."""
        ...

    def bucket(self, query: View, references: Sequence[PosedView]) -> Bucket:
        """With which other queries this one, of one reference at least, may be reconstructed in one go.

        Raises:
            ValueError: a view lacks what the backend looks at.
        """
        ...

    def reconstruct_many(self, requests: Sequence[Request]) -> list[Outcome | Exception]:
        """Reconstructs each query and its references, as far as it can in one go.

        Returns:
            For each request, in their order, the reconstruction, why there is none, or the exception that is its own,
            among them one of too little memory for it alone. What company a request has changes its outcome by no
            more than rounding.

        Raises:
            Exception: of the batch as a whole. Halves of it tell whose fault it was.
        """
        ...


def reconstruct_one(
    reconstructor: Reconstructor,
    query: View,
    references: Sequence[PosedView],
    correspondences: Correspondences | None = None,
    priors: Priors = NO_PRIORS,
) -> Outcome:
    """The outcome of a single request; raises the exception that it had."""
    (outcome,) = reconstructor.reconstruct_many([Request(query, references, correspondences, priors)])
    if isinstance(outcome, Exception):
        raise outcome
    return outcome
