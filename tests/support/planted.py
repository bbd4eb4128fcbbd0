"""The input of a stage if all earlier stages were perfect: matches, tracks, structure, scale."""

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, Similarity, rotation_from_vector
from mapless_server.method.bundle.estimate import PoseEstimate
from mapless_server.method.bundle.intrinsics import IntrinsicsEquations
from mapless_server.method.features.matching import mutual_matches
from mapless_server.method.features.tracks import Tracks
from mapless_server.method.features.views import Matches, PosedView, View
from mapless_server.method.pairs.correspond import Correspondences
from mapless_server.method.pose.pnp import PnpOptions, solve_pose
from mapless_server.method.structure.model import MetricScale, PointMatches, ScaleStage, Structure
from mapless_server.method.structure.observations import (
    ONE_PIXEL,
    KeypointNoise,
    adjust_points,
    estimate_noise,
    triangulate,
)
from mapless_server.method.structure.structure import observe
from support.scenes import SyntheticScene

NO_INTRINSICS = IntrinsicsEquations(np.empty(0), np.empty(0), np.empty(0), np.empty(0), np.empty((6, 0)))
"""The equations of a problem whose unknowns contain no errors of the intrinsics."""


def true_correspondences(scene: SyntheticScene) -> Correspondences:
    """The matches of keypoints that show the same point."""
    shown = scene.reference_points
    return Correspondences(
        {(i, j): same_points(shown[i], shown[j]) for i, j in combinations(range(len(shown)), 2)},
        tuple(same_points(scene.query_points, points) for points in shown),
    )


def same_points(first: NDArray[np.int64], second: NDArray[np.int64]) -> Matches:
    """(M, 2) keypoints that show the same point, of two lists of the point that each keypoint shows (-1: none)."""
    _, in_first, in_second = np.intersect1d(first, second, return_indices=True)
    matches = np.stack([in_first, in_second], axis=1).astype(np.int32)
    return matches[first[in_first] >= 0]


def true_tracks(scene: SyntheticScene) -> tuple[Tracks, NDArray[np.intp]]:
    """The tracks of all points that two references see, and which points (P,) of the scene these are."""
    seen = [
        (int(p), view, k) for view, shown in enumerate(scene.reference_points) for k, p in enumerate(shown) if p >= 0
    ]
    points, views, keypoints = (np.array(column, np.intp) for column in zip(*sorted(seen), strict=True))
    often = np.bincount(points, minlength=len(scene.x_in_world)) >= 2
    keep = often[points]
    renumbered = np.cumsum(often) - 1
    return Tracks(renumbered[points[keep]], views[keep], keypoints[keep]), np.flatnonzero(often)


def true_structure(scene: SyntheticScene, noise: KeypointNoise = ONE_PIXEL) -> tuple[Structure, PointMatches]:
    """All points that two references see, where they are, and the query's matches with them."""
    tracks, points = true_tracks(scene)
    index = np.full(len(scene.x_in_world), -1)
    index[points] = np.arange(len(points))
    matched = np.where(scene.query_points >= 0, index[scene.query_points], -1)
    keypoint = np.flatnonzero(matched >= 0)
    matches = PointMatches(matched[keypoint], keypoint, np.zeros(len(keypoint), bool), radius_px=0.0)
    return Structure(scene.x_in_world[points], tracks, noise), matches


NOISE = KeypointNoise(0.5, 0.0)
"""Noise of the scenes' keypoints by default."""


def metric_scale(world_from_local: Similarity, world_from_query: RigidTransform) -> MetricScale:
    """The scale stage's answer when that is the truth."""
    return MetricScale(world_from_local.scale, ScaleStage.TRIANGULATION, 0.0, 0, world_from_local, world_from_query)


def moved_references(references: tuple[PosedView, ...], world: RigidTransform) -> tuple[PosedView, ...]:
    """The same references in another world frame, with keys of their own."""
    moved = f"moved {hash(world.matrix().tobytes())}"
    return tuple(PosedView(f"{r.key} {moved}", r.name, r.view, world.compose(r.world_from_camera)) for r in references)


def stages(scene: SyntheticScene, references: tuple[PosedView, ...]) -> tuple[Structure, PointMatches, PoseEstimate]:
    """Structure and pose as the stages before would hand them over, from true matches and the given reference poses."""
    truth, matches = true_structure(scene)
    observations = observe(truth.tracks, references, NOISE)
    points = adjust_points(observations, triangulate(observations), 2.0, 8)
    noise = estimate_noise(observations, points, NOISE)
    structure = Structure(points, truth.tracks, noise)
    estimate = solve_pose(scene.query, structure, matches, scene.world_from_query, PnpOptions())
    assert isinstance(estimate, PoseEstimate)
    return structure, matches, estimate


def disturbed(
    references: tuple[PosedView, ...], random: np.random.Generator, metres: float, degrees: float
) -> tuple[PosedView, ...]:
    """The references with poses that are not exact."""

    def disturb(pose: RigidTransform) -> RigidTransform:
        turn = rotation_from_vector(np.radians(random.normal(0, degrees, 3)))
        return RigidTransform(turn @ pose.rotation, pose.translation + random.normal(0, metres, 3))

    return tuple(replace(r, world_from_camera=disturb(r.world_from_camera)) for r in references)


def drift_field(places: Array, spacing_m: float, random: np.random.Generator, planes: int = 2000) -> Array:
    """(N, 6) values at places (N, 3), zero at the first, of a random walk over space.

    The differences of two places have the variance |x_i - x_j| / spacing_m: random planes cut the world, each with a
    random step across it, and the number of planes between two places is in proportion to their distance.
    """
    radius_m = 2 * np.linalg.norm(places - places.mean(axis=0), axis=1).max()
    normals = random.normal(size=(planes, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = random.uniform(-radius_m, radius_m, planes)
    beyond = (places - places.mean(axis=0)) @ normals.T > offsets
    crossed = beyond.astype(float) - beyond[0]
    # A plane is between two places at distance d with the probability E|cos| d / 2 r = d / 4 r.
    steps = random.normal(0, np.sqrt(4 * radius_m / planes / spacing_m), (planes, 6))
    return np.asarray(crossed @ steps)


def drifted(
    references: tuple[PosedView, ...], query_centre: Array, random: np.random.Generator, metres: float, degrees: float
) -> tuple[PosedView, ...]:
    """The references with poses that drift with the distance from the query, by so much at their median spacing."""
    centres = np.array([r.world_from_camera.translation for r in references])
    spacing_m = float(np.median([np.linalg.norm(a - b) for a, b in combinations(centres, 2)]))
    errors = drift_field(np.concatenate([query_centre[None], centres]), spacing_m, random)[1:]

    def moved(pose: RigidTransform, error: Array) -> RigidTransform:
        turn = rotation_from_vector(np.radians(degrees) * error[3:])
        return RigidTransform(turn @ pose.rotation, pose.translation + metres * error[:3])

    return tuple(
        replace(r, world_from_camera=moved(r.world_from_camera, e)) for r, e in zip(references, errors, strict=True)
    )


class AnyRatio:
    """Nearest neighbours without a ratio; which pairs were seen."""

    name = "any-ratio"

    def __init__(self) -> None:
        self.seen: list[tuple[View, View]] = []

    def match_one(self, first: View, second: View, pause: Callable[[], None] = lambda: None) -> Matches:
        pause()
        self.seen.append((first, second))
        return mutual_matches(first.features, second.features, 1.0)
