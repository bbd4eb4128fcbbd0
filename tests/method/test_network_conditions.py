"""Known poses and rays as conditions of a network: their scale, origin and unit, and where they have no effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch", reason="the networks' extra is not installed")
pytest.importorskip("PIL", reason="the networks' extra is not installed")

import torch
from support.grey_network import (
    OPTIONS,
    GreyRunner,
    arrays_of,
    assert_close,
    assert_same_bits,
    grey_backend,
    grey_request,
    greys_of,
)
from support.small_networks import small_request, small_runner

from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.method.coarse import Request, reconstruct_one
from mapless_server.method.coarse.network import NetworkReconstructor, condition_poses
from mapless_server.networks.conditions import normalize_poses

# Known poses (Pi3X)


def random_poses(count: int, offset_m: float = 0.0) -> list[RigidTransform]:
    random = np.random.default_rng(count)
    return [
        RigidTransform(rotation_from_vector(random.normal(0, 0.4, 3)), random.normal(0, 3.0, 3) + offset_m)
        for _ in range(count)
    ]


def normalized(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    stacked = torch.from_numpy(poses)[None]
    return normalize_poses(stacked)[0].numpy()


def test_the_querys_placeholder_does_not_change_the_scale() -> None:
    """The references' poses are normalized as without the query; a far placeholder would change them."""
    poses = random_poses(5, offset_m=20.0)
    alone = normalized(np.stack([pose.matrix() for pose in poses]))
    assert np.linalg.norm(alone[1:, :3, 3], axis=1).mean() == pytest.approx(1.0)
    conditions = condition_poses(poses)
    assert conditions.shape == (6, 4, 4)
    np.testing.assert_allclose(normalized(conditions)[:5], alone, atol=1e-6)
    for far in (np.eye(4), poses[0].shifted([30.0, 0.0, 0.0]).matrix()):
        shifted = normalized(np.stack([*(pose.matrix() for pose in poses), far]))[:5]
        assert np.abs(shifted - alone).max() > 0.3


def test_a_single_posed_view_has_no_effect() -> None:
    query, (reference,) = small_request(1)
    backend = NetworkReconstructor(small_runner("pi3x"), OPTIONS)
    moved = replace(reference, world_from_camera=random_poses(1)[0])
    assert_same_bits(reconstruct_one(backend, query, [reference]), reconstruct_one(backend, query, [moved]))


# Known poses (MapAnything)


def test_the_unit_of_poses_is_the_metre_as_the_scene_says() -> None:
    """Not where all are at one place: they have no size then."""
    runner = GreyRunner(conditioned=True)
    backend = grey_backend(runner)
    query, references = grey_request(1, 50, 60)
    same_place = [replace(it, world_from_camera=references[0].world_from_camera) for it in references]
    requests = [Request(query, references), Request(query, references, is_metric=False), Request(query, same_place)]
    backend.reconstruct_many(requests)
    (given,) = runner.given
    poses, posed, metric = given
    assert poses is not None
    assert metric is not None
    assert metric.tolist() == [[True] * 3, [False] * 3, [False] * 3]
    assert posed is not None
    assert posed.tolist() == [[True, True, False]] * 3
    assert torch.equal(poses[:, 0], torch.eye(4).expand(3, 4, 4))
    reconstruct_one(backend, query, references[:1])
    single = runner.given[-1][2]
    assert single is not None
    assert single.tolist() == [[False, False]]


def test_the_querys_rays_are_left_out_by_option() -> None:
    """Also where the photograph is that of a reference, whose tokens are others then."""
    runner = GreyRunner(conditioned=True)
    references = grey_request(1, 50, 60)[1]
    query = references[0].view
    for query_rays, expected in ((True, [True, True]), (False, [True, True, False])):
        runner.has_rays.clear()
        options = replace(OPTIONS, query_rays=query_rays)
        assert greys_of(reconstruct_one(grey_backend(runner, options), query, references)) == [50, 50, 60]
        assert runner.has_rays == expected


@pytest.mark.parametrize("name", ["pi3x", "mapanything"])
def test_poses_and_rays_of_a_conditioned_network_have_an_effect(name: str) -> None:
    query, references = small_request(3)
    runner = small_runner(name)
    plain = reconstruct_one(NetworkReconstructor(runner, OPTIONS), query, references)
    without_rays = reconstruct_one(NetworkReconstructor(runner, replace(OPTIONS, query_rays=False)), query, references)
    turned = [replace(it, world_from_camera=pose) for it, pose in zip(references, random_poses(3), strict=True)]
    other_poses = reconstruct_one(NetworkReconstructor(runner, OPTIONS), query, turned)
    for other in (without_rays, other_poses):
        assert np.abs(arrays_of(other)[0] - arrays_of(plain)[0]).max() > 1e-3


@pytest.mark.parametrize("name", ["pi3x", "mapanything"])
def test_a_rigid_motion_of_the_world_does_not_change_the_output(name: str) -> None:
    query, references = small_request(3)
    backend = NetworkReconstructor(small_runner(name), OPTIONS)
    motion = random_poses(1, offset_m=1e4)[0]
    moved = [replace(it, world_from_camera=motion.compose(it.world_from_camera)) for it in references]
    plain, same = (reconstruct_one(backend, query, it) for it in (references, moved))
    assert_close(same, plain, 1e-4)


def test_metric_and_other_scenes_of_a_batch_equal_single_ones() -> None:
    query, references = small_request(3)
    runner = small_runner("mapanything")
    requests = [Request(query, references, is_metric=is_metric) for is_metric in (True, False)]
    together = NetworkReconstructor(runner, OPTIONS).reconstruct_many(requests)
    assert np.abs(arrays_of(together[0])[0] - arrays_of(together[1])[0]).max() > 1e-3
    for request, outcome in zip(requests, together, strict=True):
        (alone,) = NetworkReconstructor(runner, OPTIONS).reconstruct_many([request])
        assert_close(outcome, alone)
