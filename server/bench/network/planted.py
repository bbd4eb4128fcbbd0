"""A network's backend whose output is replaced by the truth, so that the later stages have realistic work.

The output of random weights has no relation to a scene, and the time of the stages after them depends on it. Here the
network computes as it would, and its output is replaced by the rendered room's true depths and poses, up to a scale.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform
from mapless_server.method.coarse import Outcome, Request
from mapless_server.method.coarse.grids import PIXEL_LIMIT, common_grid, lay_out
from mapless_server.method.coarse.network import NetworkReconstructor
from mapless_server.method.features.views import PosedView, ReconstructedView, Reconstruction, View
from mapless_server.method.rejection import Rejection

UNITS_PER_METRE = 0.3
"""Unit of the planted reconstruction, so that there is a scale to find."""


@dataclass(frozen=True, eq=False)
class Truth:
    """A photograph's camera and pose, and its depths (h, w) in metres, for the camera resized to that size."""

    camera: Camera
    world_from_camera: RigidTransform
    depth_m: NDArray[np.float32]


class PlantedReconstructor:
    """A `Reconstructor` that waits for the network, which computes, and returns the truth."""

    uses_correspondences = False
    is_batched = True

    def __init__(self, network: NetworkReconstructor, truths: Mapping[str, Truth]) -> None:
        """The `truths` are by the SHA-256 of the views' images."""
        self.network = network
        self._truths = truths
        self._maps = {sha256: true_points(truth) for sha256, truth in truths.items()}

    @property
    def name(self) -> str:
        """Name of the network."""
        return self.network.name

    @property
    def weights_sha256(self) -> str:
        """SHA-256 of the network's weights."""
        return self.network.weights_sha256

    def close(self) -> None:
        """Ends the network's thread."""
        self.network.close()

    def bucket(self, query: View, references: Sequence[PosedView]) -> str:
        """See the network's `bucket`."""
        return self.network.bucket(query, references)

    def reconstruct_many(self, requests: Sequence[Request]) -> "list[Outcome | Exception]":
        """See Reconstructor.reconstruct_many."""
        outcomes = self.network.reconstruct_many(requests)
        return [self._planted(request, outcome) for request, outcome in zip(requests, outcomes, strict=True)]

    def _planted(self, request: Request, outcome: "Outcome | Exception") -> "Outcome | Exception":
        if isinstance(outcome, Rejection | Exception):
            return outcome
        query, references = request.query, request.references
        keys = [_sha256(view) for view in (*(reference.view for reference in references), query)]
        poses = np.stack([self._local_pose(key, keys[0]) for key in keys])
        assert isinstance(outcome, Reconstruction)
        views = [
            replace(view, point_map=self._maps[key], confidence=np.ones_like(view.confidence))
            for view, key in zip(outcome.references, keys, strict=False)
        ]
        parts = zip((*views, outcome.query), poses, strict=True)
        posed: list[ReconstructedView] = [
            replace(view, local_from_camera=RigidTransform(pose[:3, :3], pose[:3, 3])) for view, pose in parts
        ]
        return Reconstruction(posed[-1], tuple(posed[:-1]))

    def _local_pose(self, key: str, anchor: str) -> Array:
        """Pose (4, 4) in the planted frame, which is the first reference's camera."""
        local_from_world = self._truths[anchor].world_from_camera.inverse()
        pose = local_from_world.compose(self._truths[key].world_from_camera).matrix()
        pose[:3, 3] *= UNITS_PER_METRE
        return pose


def true_points(truth: Truth) -> NDArray[np.float32]:
    """Points (H, W, 3) that the pixels of the network's picture show, in the camera's frame, planted units."""
    camera = lay_out(truth.camera, common_grid([truth.camera], PIXEL_LIMIT), PIXEL_LIMIT).camera
    rows, columns = np.indices((camera.height_px, camera.width_px))
    rays = camera.rays(np.stack([columns, rows], axis=-1))
    height, width = truth.depth_m.shape
    pixels = np.rint(truth.camera.resized(width, height).project(rays)).astype(int)
    column, row = np.moveaxis(np.clip(pixels, 0, (width - 1, height - 1)), -1, 0)
    points = rays / rays[..., 2:] * truth.depth_m[row, column][..., None]
    return np.ascontiguousarray(UNITS_PER_METRE * points, np.float32)


def _sha256(view: View) -> str:
    if view.photograph is None:
        raise ValueError("a network looks at photographs")
    return view.photograph.sha256
