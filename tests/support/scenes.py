"""Scenes with a planted truth: points, cameras and local features without a single photograph.

References stand on an arc around a box of points and look at its middle; the query stands off the arc. Each point owns
a descriptor, and every view sees it with a little noise, so that true matches pass a ratio test of 0.85 by far.
"""

import math
import zlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapless.geometry import Array, Camera, RigidTransform
from mapless_server.method.features.views import Features, PosedView, View

SUITE_SEED = 20261121

CAMERA = Camera(960, 720, 816.0, 816.0, 479.5, 359.5)


def random_for(*case: object) -> np.random.Generator:
    """A generator seeded by the suite and the case, so that tests do not disturb one another and a failure replays."""
    return np.random.default_rng([SUITE_SEED, zlib.crc32(repr(case).encode())])


@dataclass(frozen=True)
class SceneOptions:
    """The faults to plant.

    Attributes:
        point_count: scene points, uniform in the box.
        box_m: full extents of the box in world x, y, z, centred at the world's origin; a zero makes the scene planar.
        reference_count: references on the arc.
        baseline_m: distance between neighbouring references along the arc.
        distance_m: radius of the arc around the box's middle.
        query_offset_m: how far the query stands from the arc's middle, world axes (x along the arc, y down, z ahead).
        noise_px: standard deviation of each keypoint coordinate.
        outlier_share: share of seen points whose keypoint lies anywhere in the image: their matches are wrong.
        seen_share: probability that a view sees a point inside its image.
        distractor_count: keypoints per view that belong to no point.
        descriptor_size: D.
        descriptor_noise: length of the noise added to a point's unit descriptor.
    """

    point_count: int = 600
    box_m: tuple[float, float, float] = (4.0, 2.4, 2.0)
    reference_count: int = 6
    baseline_m: float = 0.5
    distance_m: float = 4.0
    query_offset_m: tuple[float, float, float] = (0.2, -0.15, 0.3)
    noise_px: float = 0.5
    outlier_share: float = 0.0
    seen_share: float = 0.9
    distractor_count: int = 100
    descriptor_size: int = 128
    descriptor_noise: float = 0.3
    camera: Camera = field(default=CAMERA)


@dataclass(frozen=True, eq=False)
class SyntheticScene:
    """The planted truth and what the pipeline may see of it.

    Attributes:
        x_in_world: (N, 3) metres.
        descriptors: (N, D) unit length.
        references: as the store gives them.
        reference_points: per reference, (M,) the point that each keypoint shows, -1 for outliers and distractors.
        query: as decoding gives it.
        query_points: (M,) the same for the query.
        world_from_query: the pose to find.
    """

    x_in_world: Array
    descriptors: NDArray[np.float32]
    references: tuple[PosedView, ...]
    reference_points: tuple[NDArray[np.int64], ...]
    query: View
    query_points: NDArray[np.int64]
    world_from_query: RigidTransform


def make_scene(random: np.random.Generator, options: SceneOptions | None = None) -> SyntheticScene:
    """A scene; the same generator state and options give the same one."""
    options = options or SceneOptions()
    x_in_world = (random.random((options.point_count, 3)) - 0.5) * options.box_m
    descriptors = unit_rows(random.standard_normal((options.point_count, options.descriptor_size)))
    references, reference_points = [], []
    for i, pose in enumerate(arc_poses(options)):
        view, points = observe(random, options, x_in_world, descriptors, pose)
        references.append(PosedView(f"key-{i}", f"scenes/synthetic/references/r{i:02d}", view, pose))
        reference_points.append(points)
    world_from_query = look_at(np.array(options.query_offset_m) - [0.0, 0.0, options.distance_m], [0.1, 0.05, 0.0])
    query, query_points = observe(random, options, x_in_world, descriptors, world_from_query)
    return SyntheticScene(
        x_in_world,
        descriptors.astype(np.float32),
        tuple(references),
        tuple(reference_points),
        query,
        query_points,
        world_from_query,
    )


def arc_poses(options: SceneOptions) -> list[RigidTransform]:
    """``world_from_camera`` of the references, from left to right, all looking at the box's middle."""
    angles = (np.arange(options.reference_count) - (options.reference_count - 1) / 2) * (
        2 * math.asin(options.baseline_m / (2 * options.distance_m))
    )
    centres = options.distance_m * np.stack([np.sin(angles), np.zeros_like(angles), -np.cos(angles)], axis=-1)
    return [look_at(centre, np.zeros(3)) for centre in centres]


def look_at(centre: ArrayLike, target: ArrayLike) -> RigidTransform:
    """``world_from_camera`` of an upright camera in a world whose y axis points down."""
    centre = np.asarray(centre, float)
    ahead = unit_rows(np.asarray(target, float) - centre)
    right = unit_rows(np.cross([0.0, 1.0, 0.0], ahead))
    return RigidTransform(np.stack([right, np.cross(ahead, right), ahead], axis=-1), centre)


def observe(
    random: np.random.Generator,
    options: SceneOptions,
    x_in_world: Array,
    descriptors: NDArray[np.floating],
    world_from_camera: RigidTransform,
) -> tuple[View, NDArray[np.int64]]:
    """One view of the points, keypoints in random order, and the point that each keypoint shows (-1: none)."""
    camera = options.camera
    size = np.array([camera.width_px, camera.height_px])
    exact = camera.project(world_from_camera.inverse().apply(x_in_world))
    inside = ((exact > -0.5) & (exact < size - 0.5)).all(axis=-1)
    seen = np.flatnonzero(inside & (random.random(len(exact)) < options.seen_share))

    keypoints = exact[seen] + random.normal(0.0, options.noise_px, (len(seen), 2))
    outliers = random.random(len(seen)) < options.outlier_share
    keypoints[outliers] = random.random((int(outliers.sum()), 2)) * size - 0.5
    noise = unit_rows(random.standard_normal((len(seen), descriptors.shape[1]))) * options.descriptor_noise
    observed = unit_rows(descriptors[seen] + noise)

    distractors = random.random((options.distractor_count, 2)) * size - 0.5
    keypoints = np.concatenate([keypoints, distractors])
    observed = np.concatenate(
        [observed, unit_rows(random.standard_normal((options.distractor_count, descriptors.shape[1])))]
    )
    points = np.concatenate([np.where(outliers, -1, seen), np.full(options.distractor_count, -1)])

    order = random.permutation(len(points))
    features = Features(
        keypoints[order].astype(np.float32), observed[order].astype(np.float32), np.full(len(order), 8.0, np.float32)
    )
    return View(camera, features), points[order].astype(np.int64)


def unit_rows(vectors: NDArray[np.floating]) -> Array:
    """Vectors (..., D) scaled to length one."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True), float)
