"""The reconstruction of a network whose output stays on the device."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mapless.geometry import Camera, RigidTransform

from ..views import ReconstructedView, Reconstruction


@dataclass(frozen=True, eq=False)
class DeviceReconstruction:
    """Query and references in one local frame of unknown scale, its arrays on the network's device.

    Only `fetch` waits for the device.

    Attributes:
        reference_cameras: K pinholes, in pixels of the maps; see ReconstructedView.camera.
        query_camera: the same for the query.
        point_maps: (K, H, W, 3) float32, of the references alone: the point at each pixel, in that camera's frame.
        confidence: (K, H, W) float32, 0 to 1; 0 where the point is unknown.
        local_from_camera: (K + 1, 4, 4) float32, of the references in order, then of the query.
        backend: its name, for messages.
        metre_sigma: see Reconstruction.
    """

    reference_cameras: tuple[Camera, ...]
    query_camera: Camera
    point_maps: Tensor
    confidence: Tensor
    local_from_camera: Tensor
    backend: str
    metre_sigma: float | None = None

    def __post_init__(self) -> None:
        count, camera = len(self.reference_cameras), self.query_camera
        size = self.confidence.shape[1:]
        if self.point_maps.shape != (count, *size, 3) or self.confidence.shape != (count, *size):
            raise ValueError(f"maps {self.point_maps.shape}, {self.confidence.shape} do not fit {count} references")
        if self.local_from_camera.shape != (count + 1, 4, 4):
            raise ValueError(f"poses {self.local_from_camera.shape} do not fit {count} references and a query")
        if any((c.height_px, c.width_px) != tuple(size) for c in (*self.reference_cameras, camera)):
            raise ValueError(f"cameras are not of the maps' size {tuple(size)}")

    def broken_pixels(self) -> Tensor:
        """Counts pixels without a finite confidence, or with one above 0 and no finite point; a scalar tensor."""
        point_is_finite = self.point_maps.isfinite().all(-1)
        return (~self.confidence.isfinite() | ((self.confidence > 0) & ~point_is_finite)).sum()

    def fetch(self) -> Reconstruction:
        """Returns the reconstruction on the host, copied in one transfer; the query's own point map is NaN."""
        parts = (self.point_maps, self.confidence, self.local_from_camera)
        flat = torch.cat([part.float().reshape(-1) for part in parts]).cpu().numpy()
        point_maps, confidence, poses = (
            values.reshape(part.shape)
            for values, part in zip(np.split(flat, np.cumsum([p.numel() for p in parts])[:-1]), parts, strict=True)
        )
        # Unchecked: the scale stage rejects poses that are not finite.
        local_from_camera = [RigidTransform(pose[:3, :3], pose[:3, 3]) for pose in poses.astype(np.float64)]
        query = ReconstructedView(
            self.query_camera,
            np.full((*confidence.shape[1:], 3), np.nan, np.float32),
            np.zeros(confidence.shape[1:], np.float32),
            local_from_camera[-1],
        )
        views = zip(self.reference_cameras, point_maps, confidence, local_from_camera[:-1], strict=True)
        return Reconstruction(query, tuple(ReconstructedView(*view) for view in views), self.metre_sigma)
