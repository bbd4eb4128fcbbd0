"""A coarse backend made from the truth: a synthetic scene under a random similarity, with planted faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, Similarity, resized_pixel, rotation_from_vector
from mapless_server.method.coarse import Outcome, Request
from mapless_server.method.features.views import PosedView, ReconstructedView, Reconstruction, View
from support.scenes import SyntheticScene, random_for


@dataclass(frozen=True)
class FakeNetworkOptions:
    """The network's errors; metres are those of the true world.

    Attributes:
        depth_noise_m: standard deviation of predicted depths.
        bad_depth_share: share of keypoints whose depth is grossly wrong.
        bad_depth_factors: wrong depths are the true ones times a factor between these two, uniform in its logarithm;
            twice the same one is an error that all agree on.
        pose_noise_m, pose_noise_deg: standard deviation of predicted poses, each axis.
        bad_pose_count: the first so many references are predicted `bad_pose_m` from where they stand.
        reference_confidences: of every pixel that is known, one for each of the scene's references; None gives all 0.9.
        dense: pixels that show no point get the median depth of those that do; otherwise they stay unknown.
        map_width_px, map_height_px: size of the maps; smaller than the image, as those of a real network.
    """

    depth_noise_m: float = 0.0
    bad_depth_share: float = 0.0
    bad_depth_factors: tuple[float, float] = (0.3, 3.0)
    pose_noise_m: float = 0.0
    pose_noise_deg: float = 0.0
    bad_pose_count: int = 0
    bad_pose_m: float = 0.0
    reference_confidences: tuple[float, ...] | None = None
    dense: bool = False
    map_width_px: int = 320
    map_height_px: int = 240


class FakeNetwork:
    """A `Reconstructor` of one scene's query with any of its references, in any order.

    What it says of a view depends on the seed and the view alone, as with a permutation-equivariant network.

    Attributes:
        world_from_local: the similarity to find.
    """

    name = "fake"
    weights_sha256 = ""
    uses_correspondences = False
    is_batched = True

    def __init__(self, scene: SyntheticScene, seed: int = 0, options: FakeNetworkOptions | None = None) -> None:
        self.world_from_local = random_similarity(random_for("fake network", seed))
        self._scene = scene
        self._seed = seed
        self._options = options or FakeNetworkOptions()
        self._index = {reference.key: i for i, reference in enumerate(scene.references)}

    def close(self) -> None:
        """Nothing to give back."""

    def bucket(self, query: View, references: Sequence[PosedView]) -> str:
        """By the number of references alone."""
        return f"{self.name}-{len(references)}"

    def reconstruct_many(self, requests: Sequence[Request]) -> list[Outcome | Exception]:
        """See Reconstructor.reconstruct_many."""
        return [self.reconstruct(request.query, request.references) for request in requests]

    def reconstruct(self, query: View, references: Sequence[PosedView]) -> Reconstruction:
        """The truth with the ordered faults; looks at no correspondences."""
        predicted_query = self._predict("query", query, self._scene.query_points, self._scene.world_from_query)
        return Reconstruction(predicted_query, tuple(self._predict_reference(reference) for reference in references))

    def _predict_reference(self, reference: PosedView) -> ReconstructedView:
        options, index = self._options, self._index[reference.key]
        return self._predict(
            reference.key,
            reference.view,
            self._scene.reference_points[index],
            self._scene.references[index].world_from_camera,
            confidence=0.9 if options.reference_confidences is None else options.reference_confidences[index],
            offset_m=options.bad_pose_m if index < options.bad_pose_count else 0.0,
        )

    def _predict(
        self,
        key: str,
        view: View,
        points: NDArray[np.int64],
        world_from_camera: RigidTransform,
        confidence: float = 0.9,
        offset_m: float = 0.0,
    ) -> ReconstructedView:
        random = random_for("fake network", self._seed, key)
        known = np.flatnonzero(points >= 0)
        depth_m = world_from_camera.inverse().apply(self._scene.x_in_world[points[known]])[:, 2]
        depth_m = self._spoil_depths(random, depth_m)
        point_map = self._scatter(view, view.features.keypoints[known], depth_m / self.world_from_local.scale)
        return ReconstructedView(
            view.camera.resized(self._options.map_width_px, self._options.map_height_px),
            point_map.astype(np.float32),
            np.where(np.isfinite(point_map[..., 2]), confidence, 0.0).astype(np.float32),
            self.world_from_local.inverse().transform_pose(self._spoil_pose(random, world_from_camera, offset_m)),
        )

    def _spoil_depths(self, random: np.random.Generator, depth_m: Array) -> Array:
        options = self._options
        noisy = depth_m + random.normal(0.0, options.depth_noise_m, len(depth_m))
        low, high = np.log(options.bad_depth_factors).tolist()
        factors = np.exp(random.uniform(low, high, len(depth_m)))
        spoilt: Array = np.where(random.random(len(depth_m)) < options.bad_depth_share, noisy * factors, noisy)
        return spoilt

    def _spoil_pose(
        self, random: np.random.Generator, world_from_camera: RigidTransform, offset_m: float
    ) -> RigidTransform:
        turn = rotation_from_vector(np.radians(random.normal(0.0, self._options.pose_noise_deg, 3)))
        direction = random.standard_normal(3)
        shift = random.normal(0.0, self._options.pose_noise_m, 3) + offset_m * direction / np.linalg.norm(direction)
        return RigidTransform(world_from_camera.rotation @ turn, world_from_camera.translation + shift)

    def _scatter(self, view: View, keypoints: NDArray[np.float32], depth: Array) -> Array:
        """A point map (H, W, 3) with these depths (N,) in the cells of their keypoints (N, 2)."""
        camera, width, height = view.camera, self._options.map_width_px, self._options.map_height_px
        point_map = np.full((height, width, 3), np.nan)
        if self._options.dense:
            point_map[:] = camera.resized(width, height).rays(np.indices((height, width))[::-1].transpose(1, 2, 0))
            point_map *= np.median(depth)
        columns = resized_pixel(keypoints[:, 0], width / camera.width_px)
        rows = resized_pixel(keypoints[:, 1], height / camera.height_px)
        cells = tuple(np.clip(np.rint(c), 0, n - 1).astype(np.intp) for c, n in ((rows, height), (columns, width)))
        point_map[cells] = camera.rays(keypoints) * depth[:, None]
        return point_map


def random_similarity(random: np.random.Generator) -> Similarity:
    """Any rotation, a scale between 1/20 and 20, a translation of some metres."""
    scale = float(np.exp(random.uniform(-np.log(20), np.log(20))))
    return Similarity(scale, rotation_from_vector(random.uniform(-2.0, 2.0, 3)), random.normal(0.0, 10.0, 3))
