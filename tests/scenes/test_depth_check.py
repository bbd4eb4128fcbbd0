"""What is kept of predicted depths: right ones, scaled by triangulation; wrong ones are dropped by pixel or whole."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import SceneOptions, make_scene, random_for

from mapless.geometry import Array, RigidTransform, Similarity, rotation_from_vector
from mapless_server.method.correspond import Correspondences, Matcher
from mapless_server.method.results import MetricScale, ScaleStage
from mapless_server.method.views import KeptDepth, ReconstructedView, Reconstruction
from mapless_server.scenes.depth.check import DepthCheckOptions, checked_depths

SCENE = make_scene(random_for("depth check"), SceneOptions(reference_count=4, box_m=(4.0, 2.4, 0.0)))
"""A wall at z = 0."""
MAP = 96, 72
IDENTITY = RigidTransform(np.eye(3), np.zeros(3))
Change = Callable[[int, Array], Array]


@cache
def correspondences() -> Correspondences:
    return Matcher().correspond(SCENE.query, SCENE.references)


def wall_depth(index: int) -> NDArray[np.float64]:
    """The true depth map of a reference."""
    pose = SCENE.references[index].world_from_camera
    camera = SCENE.references[index].view.camera.resized(*MAP)
    rays = camera.rays(np.indices(MAP[::-1])[::-1].reshape(2, -1).T.astype(float)) @ pose.rotation.T
    ahead = pose.rotation[:, 2]
    return np.asarray((-pose.translation[2] / rays[:, 2] * (rays @ ahead)).reshape(MAP[::-1]))


def predicted(index: int, depth: Array) -> ReconstructedView:
    camera = SCENE.references[index].view.camera.resized(*MAP)
    rays = camera.rays(np.indices(MAP[::-1])[::-1].reshape(2, -1).T.astype(float)).reshape(*MAP[::-1], 3)
    points = (rays / rays[..., 2:] * depth[..., None]).astype(np.float32)
    confidence = np.isfinite(depth).astype(np.float32)
    return ReconstructedView(camera, points, confidence, SCENE.references[index].world_from_camera)


def checked(
    change: Change = lambda _, depth: depth,
    found: RigidTransform = SCENE.world_from_query,
    options: DepthCheckOptions | None = None,
    unit: float = 2.0,
) -> list[KeptDepth | None]:
    """What is kept of the true depths, changed, in a unit of its own."""
    views = tuple(predicted(i, change(i, wall_depth(i)) / unit) for i in range(len(SCENE.references)))
    nothing = ReconstructedView(views[0].camera, views[0].point_map, views[0].confidence, IDENTITY)
    scale = MetricScale(unit, ScaleStage.TRIANGULATION, 0.0, 0, Similarity(unit, np.eye(3), np.zeros(3)), found)
    reconstruction = Reconstruction(nothing, views)
    given = SCENE.references, SCENE.world_from_query, correspondences(), options or DepthCheckOptions()
    return checked_depths(reconstruction, scale, *given)


def off(kept: KeptDepth | None, index: int) -> Array:
    """Relative errors of what is kept."""
    assert kept is not None
    error = np.log(kept.depth / wall_depth(index))
    return np.asarray(error[np.isfinite(error)])


def only(wanted: int, change: Callable[[Array], Array]) -> Change:
    return lambda index, depth: change(depth) if index == wanted else depth


def test_right_depths_are_kept_in_metres() -> None:
    for index, kept in enumerate(checked()):
        assert kept is not None
        assert np.isfinite(kept.depth).mean() > 0.95
        assert np.abs(off(kept, index)).max() < 0.01
        assert kept.relative_sigma == DepthCheckOptions().min_sigma


@pytest.mark.parametrize("factor", [0.85, 1.15])
def test_a_references_scale_follows_its_triangulated_points(factor: float) -> None:
    kept = checked(only(1, lambda depth: factor * depth))
    assert np.abs(off(kept[1], 1)).max() < 0.01


@pytest.mark.parametrize("sigma", [0.02, 0.05])
def test_the_standard_deviation_is_that_of_the_errors(sigma: float) -> None:
    random = np.random.default_rng(0)
    options = DepthCheckOptions(max_step=2.0)
    kept = checked(lambda _, depth: depth * np.exp(random.normal(0, sigma, depth.shape)), options=options)
    for it in kept:
        assert it is not None
        assert it.relative_sigma == pytest.approx(sigma, rel=0.25)


@pytest.mark.parametrize(
    "change",
    [
        lambda depth: 1.5 * depth,
        lambda depth: depth * np.exp(np.random.default_rng(0).normal(0, 0.2, depth.shape)),
        lambda depth: np.full_like(depth, np.nan),
        lambda depth: -depth,
        lambda depth: np.zeros_like(depth),
        lambda depth: np.linspace(1.5, 9.0, depth.shape[1])[None].repeat(depth.shape[0], 0),
    ],
    ids=["another scale", "noise", "nothing", "behind", "zero", "another shape"],
)
def test_a_reference_with_wrong_depths_is_dropped_alone(change: Callable[[Array], Array]) -> None:
    kept = checked(only(2, change), options=DepthCheckOptions(max_step=3.0))
    assert kept[2] is None
    assert all(kept[i] is not None for i in (0, 1, 3))


def test_what_others_look_through_is_dropped_by_pixel() -> None:
    patch = np.s_[20:40, 40:60]

    def nearer(depth: Array) -> Array:
        depth = depth.copy()
        depth[patch] *= 0.6
        return depth

    kept = checked(only(1, nearer))[1]
    assert kept is not None
    assert np.isnan(kept.depth[patch]).mean() > 0.95
    outside = np.ones(kept.depth.shape, bool)
    outside[18:42, 38:62] = False
    assert np.isfinite(kept.depth[outside]).mean() > 0.95


def test_edges_of_depth_are_dropped() -> None:
    def stepped(depth: Array) -> Array:
        depth = depth.copy()
        depth[:, 48:] *= 1.4
        return depth

    kept = checked(only(3, stepped), options=DepthCheckOptions(max_sigma=0.5, max_scale=2.0, max_wrong=1.0))[3]
    assert kept is not None
    assert np.isnan(kept.depth[:, 47:49]).all()


@pytest.mark.parametrize(
    "found",
    [
        RigidTransform(SCENE.world_from_query.rotation, SCENE.world_from_query.translation + [0.5, 0, 0]),
        RigidTransform(
            SCENE.world_from_query.rotation @ rotation_from_vector([0, np.deg2rad(6), 0]),
            SCENE.world_from_query.translation,
        ),
        RigidTransform(np.full((3, 3), np.nan), np.full(3, np.nan)),
    ],
    ids=["position", "rotation", "not finite"],
)
def test_nothing_is_kept_if_the_known_pose_is_not_found(found: RigidTransform) -> None:
    assert checked(found=found) == [None] * 4


def test_without_confidence_nothing_is_kept() -> None:
    views = [predicted(i, wall_depth(i)) for i in range(4)]
    doubted = tuple(replace(it, confidence=0.05 * it.confidence) for it in views)
    scale = MetricScale(
        1.0, ScaleStage.TRIANGULATION, 0.0, 0, Similarity(1.0, np.eye(3), np.zeros(3)), SCENE.world_from_query
    )
    given = SCENE.references, SCENE.world_from_query, correspondences(), DepthCheckOptions()
    assert checked_depths(Reconstruction(views[0], doubted), scale, *given) == [None] * 4
