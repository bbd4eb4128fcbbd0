"""A network as the coarse stage: order, cache, conditions, errors; small networks, and one of known output."""

from __future__ import annotations

import asyncio
import hashlib
import logging
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch", reason="the networks' extra is not installed")
pytest.importorskip("PIL", reason="the networks' extra is not installed")

import torch
from safetensors.torch import save_file
from support.images import textured
from support.programs import printed
from support.small_networks import (
    GRIDS,
    MAPANYTHING,
    PI3,
    photograph,
    references_of,
    small_network,
    small_request,
    small_runner,
    view_of,
)

from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.engine.failures import failure_of
from mapless_server.method.choices import NETWORKS
from mapless_server.method.coarse import Bucket, Outcome, Request, make, reconstruct_one
from mapless_server.method.coarse.device import DeviceReconstruction
from mapless_server.method.coarse.geometric import GeometricReconstructor
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.coarse.network import NetworkOptions, NetworkReconstructor, condition_poses
from mapless_server.method.coarse.token_cache import TokenCacheOptions
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.views import PosedView, Reconstruction, View
from mapless_server.networks import mapanything, pi3
from mapless_server.networks.conditions import normalize_poses
from mapless_server.networks.mapanything import MapAnything
from mapless_server.networks.network import NetworkOutput
from mapless_server.networks.pi3 import Pi3
from mapless_server.networks.runner import NetworkRunner
from mapless_server.networks.weights import CATALOGUE, CheckpointError, WeightsMissing, named
from mapless_server.scheduling import Done, Flow, Job, Observer, Stage, StageResult, Step, WorkQueue, WorkQueueOptions

OPTIONS = NetworkOptions(grids=GRIDS)
UNCACHED = NetworkOptions(grids=GRIDS, cache=TokenCacheOptions(0, 0))


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@dataclass
class GreyRunner:
    """Stands in for a network: a view's token is its mean grey, and its pose lies there along x.

    Attributes:
        most_scenes: more at a time are out of memory.
        failing_batches: so many first calls of `reconstruct` are out of memory.
        failing_encodings: so many first calls of `encode` are out of memory.
        has_rays: whether each call of `encode` got intrinsics.
        given: poses, posed and metric of each call of `reconstruct`.
        encoded: views of each call of `encode`.
        batches: scenes of each call of `reconstruct`.
    """

    name: str = "grey"
    weights_sha256: str = "none"
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    dtype: torch.dtype = torch.float32
    conditioned: bool = False
    metre_sigma: float | None = None
    most_scenes: int = 100
    failing_batches: int = 0
    failing_encodings: int = 0
    has_rays: list[bool] = field(default_factory=list)
    given: list[tuple[torch.Tensor | None, ...]] = field(default_factory=list)
    encoded: list[int] = field(default_factory=list)
    batches: list[int] = field(default_factory=list)

    def encode(self, images: torch.Tensor, intrinsics: torch.Tensor | None = None) -> torch.Tensor:
        self.encoded.append(len(images))
        self.has_rays.append(intrinsics is not None)
        if len(self.encoded) <= self.failing_encodings:
            raise torch.OutOfMemoryError("no room to encode")
        return images.mean((1, 2, 3))[:, None, None]

    def reconstruct(self, tokens: torch.Tensor, grid: tuple[int, int], mapped: int, *given: Any) -> NetworkOutput:
        scenes, views = tokens.shape[:2]
        self.given.append(given)
        self.batches.append(scenes)
        if scenes > self.most_scenes or len(self.batches) <= self.failing_batches:
            raise torch.OutOfMemoryError("no room to reconstruct")
        poses = torch.eye(4).repeat(scenes, views, 1, 1)
        poses[:, :, 0, 3] = 255 * tokens[..., 0, 0]
        maps = (scenes, mapped, 14 * grid[0], 14 * grid[1])
        return NetworkOutput(torch.ones(*maps, 3) * poses[:, :mapped, 0, 3, None, None, None], torch.zeros(maps), poses)


def grey_request(*greys: int, size: tuple[int, int] = (96, 72)) -> tuple[View, tuple[PosedView, ...]]:
    """A query of the first grey, references of the others."""
    photos = [photograph(np.full((size[1], size[0], 3), grey, np.uint8)) for grey in greys]
    return view_of(photos[0]), references_of(photos[1:])


def grey_backend(runner: GreyRunner, options: NetworkOptions = OPTIONS) -> NetworkReconstructor:
    return NetworkReconstructor(cast(NetworkRunner, runner), options)


def greys_of(outcome: Outcome | Exception) -> list[int]:
    """The greys in the network's output: the query's, then the references'."""
    assert isinstance(outcome, Reconstruction)
    views = (outcome.query, *outcome.references)
    for view in outcome.references:
        np.testing.assert_allclose(view.point_map, view.local_from_camera.translation[0], atol=1e-3)
    return [round(view.local_from_camera.translation[0]) for view in views]


def arrays_of(outcome: Outcome | Exception) -> list[NDArray[np.floating]]:
    assert isinstance(outcome, Reconstruction)
    views = (*outcome.references, outcome.query)
    return [
        *(view.point_map for view in outcome.references),
        *(view.confidence for view in outcome.references),
        *(view.local_from_camera.matrix() for view in views),
    ]


def assert_same_bits(actual: Outcome | Exception, expected: Outcome | Exception) -> None:
    for one, other in zip(arrays_of(actual), arrays_of(expected), strict=True):
        np.testing.assert_array_equal(one, other)


# What is asked of the network


def test_the_catalogue_has_the_weights_of_every_backend() -> None:
    assert {it.name for it in CATALOGUE if it.purpose == "backend"} == set(NETWORKS)


def test_views_keep_their_order_in_the_reconstruction() -> None:
    runner = GreyRunner()
    outcome = reconstruct_one(grey_backend(runner), *grey_request(7, 50, 100, 150))
    assert greys_of(outcome) == [7, 50, 100, 150]
    assert isinstance(outcome, Reconstruction)
    assert outcome.query.camera.width_px == 70
    assert [view.confidence.shape for view in outcome.references] == [(56, 70)] * 3
    np.testing.assert_array_equal(outcome.references[0].confidence, np.float32(0.5))
    assert runner.encoded == [1, 1, 1, 1]


@pytest.mark.parametrize("name", NETWORKS)
def test_maps_have_the_cameras_of_the_pictures(name: str) -> None:
    """Point maps are of the grid's size, confidence is 0 to 1, and both differ from reference to reference."""
    outcome = reconstruct_one(NetworkReconstructor(small_runner(name), OPTIONS), *small_request(3))
    assert isinstance(outcome, Reconstruction)
    for view in outcome.references:
        assert view.point_map.shape == (56, 70, 3)
        assert np.isfinite(view.point_map).all()
        assert (view.camera.width_px, view.camera.height_px) == (70, 56)
        assert 0 < view.confidence.min() < view.confidence.max() < 1
        np.testing.assert_allclose(
            view.local_from_camera.rotation @ view.local_from_camera.rotation.T, np.eye(3), atol=1e-5
        )
    assert np.abs(outcome.references[0].point_map - outcome.references[1].point_map).max() > 0.01


@pytest.mark.parametrize(("name", "sigma"), [("pi3", None), ("pi3x", 0.31), ("mapanything", 0.2)])
def test_the_unit_of_the_output_is_about_the_metre(name: str, sigma: float | None) -> None:
    """Where the network predicts metres and the scene is in metres; only then is one reference enough."""
    backend = NetworkReconstructor(small_runner(name), OPTIONS)
    request = Request(*small_request(1))
    outcomes = backend.reconstruct_many([request, replace(request, is_metric=False)])
    for outcome, expected in zip(outcomes, (sigma, None), strict=True):
        assert isinstance(outcome, Reconstruction)
        assert outcome.metre_sigma == expected


def test_confidence_is_zero_where_a_picture_is_filled() -> None:
    query, references = small_request(2)
    portrait = references_of([photograph(textured(72, 96, seed=i)) for i in range(3)])[2]
    outcome = reconstruct_one(NetworkReconstructor(small_runner("pi3"), OPTIONS), query, [*references, portrait])
    assert isinstance(outcome, Reconstruction)
    filled = outcome.references[2]
    assert (outcome.references[0].confidence > 0).all()
    assert (filled.confidence[:, :10] == 0).all()
    assert (filled.confidence[:, 30:40] > 0).all()
    corners = filled.camera.project(portrait.view.camera.rays(np.array([[-0.5, -0.5], [71.5, 95.5]])))
    np.testing.assert_allclose(corners, [[13.5, -0.5], [55.5, 55.5]], atol=0.51)


def test_without_references_a_query_is_rejected() -> None:
    query, _ = small_request(0)
    outcome = reconstruct_one(grey_backend(GreyRunner()), query, [])
    assert isinstance(outcome, Rejection)
    assert outcome.reason is RejectionReason.NO_USABLE_REFERENCES


def test_a_view_without_a_photograph_is_refused() -> None:
    query, references = small_request(2)
    bare = replace(references[1], view=replace(references[1].view, photograph=None))
    with pytest.raises(ValueError, match="r1 has no photograph"):
        reconstruct_one(grey_backend(GreyRunner()), query, [references[0], bare])


# Kept tokens


@pytest.mark.parametrize("name", NETWORKS)
def test_cached_tokens_give_the_same_bits(name: str) -> None:
    reads: list[str] = []
    query, references = small_request(4, reads=reads)
    runner = small_runner(name)
    backend = NetworkReconstructor(runner, OPTIONS)
    reconstruct_one(backend, query, references[:3])
    reconstruct_one(backend, query, references[2:])
    reads.clear()
    kept = reconstruct_one(backend, query, references)
    assert query.photograph is not None
    assert reads == [query.photograph.sha256]
    assert backend.cache.counters.device_hits == 5
    assert_same_bits(kept, reconstruct_one(NetworkReconstructor(runner, UNCACHED), query, references))
    assert len(reads) == 6


@pytest.mark.parametrize("name", NETWORKS)
def test_tokens_from_the_host_give_the_same_bits(name: str) -> None:
    request = small_request(4)
    runner = small_runner(name)
    backend = NetworkReconstructor(runner, OPTIONS)
    reconstruct_one(backend, *request)
    one_view_bytes = backend.cache.counters.device_bytes // 4
    # On a device of its own memory; here both levels are the host's.
    backend.cache = type(backend.cache)(runner.device, TokenCacheOptions(one_view_bytes, 4 * one_view_bytes))
    first, second = reconstruct_one(backend, *request), reconstruct_one(backend, *request)
    assert backend.cache.counters.host_hits == 3 + 1
    assert_same_bits(first, second)
    assert_same_bits(second, reconstruct_one(NetworkReconstructor(runner, UNCACHED), *request))


def test_another_photograph_of_the_same_name_misses_the_cache() -> None:
    query, references = grey_request(7, 50, 100)
    backend = grey_backend(GreyRunner())
    reconstruct_one(backend, query, references)
    changed = replace(references[1], view=grey_request(200)[0])
    assert greys_of(reconstruct_one(backend, query, [references[0], changed])) == [7, 50, 200]


def test_another_grid_misses_the_cache() -> None:
    query, references = grey_request(7, 50, 100)
    portraits = grey_request(7, 60, 70, 80, size=(72, 96))[1]
    backend = grey_backend(GreyRunner())
    reconstruct_one(backend, query, references)
    assert greys_of(reconstruct_one(backend, query, [references[0], *portraits])) == [7, 50, 60, 70, 80]
    assert backend.cache.counters.device_hits == 0
    assert greys_of(reconstruct_one(backend, query, references)) == [7, 50, 100]
    assert backend.cache.counters.device_hits == 2


# Many queries at a time


@pytest.mark.parametrize("name", NETWORKS)
def test_queries_of_a_batch_equal_single_ones(name: str) -> None:
    requests = [
        small_request(3, 1),
        small_request(2, 2),
        small_request(3, 3),
        small_request(3, 4, size=(72, 96)),
        small_request(3, 5),
    ]
    runner = small_runner(name)
    together = NetworkReconstructor(runner, OPTIONS).reconstruct_many([Request(*request) for request in requests])
    for request, outcome in zip(requests, together, strict=True):
        alone = reconstruct_one(NetworkReconstructor(runner, OPTIONS), *request)
        for one, other in zip(arrays_of(outcome), arrays_of(alone), strict=True):
            np.testing.assert_allclose(one, other, atol=2e-4 * float(np.abs(other).max()))


@pytest.mark.parametrize("cache", [OPTIONS.cache, TokenCacheOptions(0, 0)], ids=["kept", "not kept"])
def test_each_view_of_a_batch_is_encoded_once(cache: TokenCacheOptions) -> None:
    runner = GreyRunner()
    _, references = grey_request(0, 50, 100, 150)
    requests = [Request(grey_request(i)[0], references) for i in (1, 2, 3, 4)]
    outcomes = grey_backend(runner, replace(OPTIONS, cache=cache)).reconstruct_many(requests)
    assert [greys_of(outcome) for outcome in outcomes] == [[i, 50, 100, 150] for i in (1, 2, 3, 4)]
    assert sum(runner.encoded) == 3 + 4
    assert runner.batches == [4]


@pytest.mark.parametrize("name", NETWORKS)
def test_queries_with_common_references_equal_single_ones(name: str) -> None:
    _, references = small_request(3)
    queries = [small_request(1, seed)[0] for seed in (1, 2, 3, 4)]
    runner = small_runner(name)
    together = NetworkReconstructor(runner, UNCACHED).reconstruct_many([Request(q, references) for q in queries])
    for query, outcome in zip(queries, together, strict=True):
        alone = reconstruct_one(NetworkReconstructor(runner, UNCACHED), query, references)
        for one, other in zip(arrays_of(outcome), arrays_of(alone), strict=True):
            np.testing.assert_allclose(one, other, atol=2e-4 * float(np.abs(other).max()))


def test_queries_of_one_bucket_are_one_batch_of_the_network() -> None:
    backend = grey_backend(GreyRunner())
    assert backend.bucket(*grey_request(1, 50, 60)) == Bucket("grey", 2, (4, 5))
    assert str(backend.bucket(*grey_request(1, 50, 60))) == "grey-4x5-2"
    assert str(backend.bucket(*grey_request(1, 50, size=(72, 96)))) == "grey-5x4-1"
    query, _ = grey_request(1, 50)
    with pytest.raises(ValueError, match="the query has no photograph"):
        backend.bucket(replace(query, photograph=None), grey_request(1, 50)[1])


def test_one_requests_error_does_not_fail_the_others() -> None:
    requests = [grey_request(1, 50), grey_request(2, 60), grey_request(3, 70)]
    query, (reference,) = requests[1]
    requests[1] = (query, (replace(reference, view=replace(reference.view, photograph=None)),))
    outcomes = grey_backend(GreyRunner()).reconstruct_many([Request(*request) for request in requests])
    assert isinstance(outcomes[1], ValueError)
    assert [greys_of(outcomes[i]) for i in (0, 2)] == [[1, 50], [3, 70]]


# Out of memory


def test_out_of_memory_is_retried_after_tokens_are_released() -> None:
    runner = GreyRunner(failing_batches=1)
    backend = grey_backend(runner)
    outcomes = backend.reconstruct_many([Request(*grey_request(i, 50, 100)) for i in range(4)])
    assert [greys_of(outcome) for outcome in outcomes] == [[i, 50, 100] for i in range(4)]
    assert runner.batches == [4, 4]
    assert sum(runner.encoded) == 2 + 4, "the batch's own tokens stay"
    assert backend.cache.counters.device_bytes == 0


def test_a_batch_that_still_does_not_fit_raises() -> None:
    runner = GreyRunner(most_scenes=2)
    with pytest.raises(torch.OutOfMemoryError):
        grey_backend(runner).reconstruct_many([Request(*grey_request(i, 50, 100)) for i in range(4)])
    assert runner.batches == [4, 4]


def test_the_queue_splits_a_batch_that_does_not_fit() -> None:
    """Else each full batch would fail anew, and empty the cache each time."""
    runner = GreyRunner(most_scenes=2)
    backend, observer, gate = grey_backend(runner), CountingObserver(), threading.Event()

    def compute(jobs: Sequence[Job]) -> list[StageResult]:
        if jobs[0].step.bucket == "plug":
            assert gate.wait(20)
            return [Done(None)]
        made = backend.reconstruct_many([job.step.payload for job in jobs])
        return [it if isinstance(it, Exception) else Done(it) for it in made]

    async def test() -> None:
        options = WorkQueueOptions(max_queued_s=1e6)
        stages = {Stage("coarse", "toy-device", max_batch=4): compute}
        queue = WorkQueue(stages, {"toy-device": 1}, options, observer, failure_of)

        def submit(bucket: str, payload: Request | None = None) -> asyncio.Task[Any]:
            step = Step("coarse", "toy", bucket, payload)
            return asyncio.ensure_future(queue.run(Job(Flow("t", "c"), step, time.monotonic() + 600, 1)))

        try:
            for expected in ([4, 4, 2, 2], [2, 2]):
                runner.batches.clear()
                gate.clear()
                plug = submit("plug")
                calls = [submit("b", Request(*grey_request(i, 50))) for i in range(4)]
                while queue.job_count < 5:
                    await asyncio.sleep(0.002)
                gate.set()
                results = await asyncio.wait_for(asyncio.gather(*calls, plug), 20)
                assert [greys_of(outcome) for outcome in results[:4]] == [[i, 50] for i in range(4)]
                assert runner.batches == expected
                assert observer.out_of_memory == 1
        finally:
            gate.set()
            await queue.close()

    asyncio.run(test())


def test_a_single_query_is_retried_once() -> None:
    runner = GreyRunner(most_scenes=0)
    with pytest.raises(torch.OutOfMemoryError):
        reconstruct_one(grey_backend(runner), *grey_request(1, 50))
    assert runner.batches == [1, 1]


@pytest.mark.parametrize("failing", [1, 2])
@pytest.mark.parametrize("queries", [1, 2])
def test_encoding_is_retried_once(failing: int, queries: int) -> None:
    backend = grey_backend(GreyRunner(failing_encodings=failing))
    requests = [Request(*grey_request(i, 50)) for i in range(queries)]
    if failing == 1:
        assert [greys_of(outcome) for outcome in backend.reconstruct_many(requests)] == [
            [i, 50] for i in range(queries)
        ]
    elif queries == 1:
        assert isinstance(backend.reconstruct_many(requests)[0], torch.OutOfMemoryError)
    else:  # it may be the others that have taken the room
        with pytest.raises(torch.OutOfMemoryError):
            backend.reconstruct_many(requests)


class CountingObserver(Observer):
    """Counts how often memory did not suffice."""

    def __init__(self) -> None:
        self.out_of_memory = 0

    def ran_out_of_memory(self) -> None:
        self.out_of_memory += 1


class LostDevice(RuntimeError):
    """As torch raises it when the context is poisoned."""


def test_errors_of_the_device_are_passed_on_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether it is lost while one view is encoded or in the middle of the batch, the error comes out unchanged."""
    lost = LostDevice("CUDA error: an illegal memory access was encountered")

    def fail(*_: Any) -> None:
        raise lost

    runner = GreyRunner()
    backend = grey_backend(runner)
    requests = [Request(*grey_request(i, 50)) for i in (1, 2)]
    with monkeypatch.context() as patch:
        patch.setattr(runner, "reconstruct", fail)
        with pytest.raises(LostDevice) as raised:
            backend.reconstruct_many(requests)
        assert raised.value is lost
    monkeypatch.setattr(runner, "encode", fail)
    assert all(outcome is lost for outcome in grey_backend(runner).reconstruct_many(requests))


# Not a number


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("part", ["fc_t.bias", "2.bias"], ids=["poses", "maps"])
def test_output_that_is_not_finite_is_rejected(name: str, part: str, caplog: pytest.LogCaptureFixture) -> None:
    network = small_network(name)
    layers = ("fc_t.bias",) if part == "fc_t.bias" else ("conf_head.proj.bias", "output_block.0.2.bias", "conv2.2.bias")
    for key, parameter in network.named_parameters():
        if key.endswith(layers):
            parameter.data[:] = float("nan")
    runner = NetworkRunner(network, name, "sha", "cpu")
    outcome = reconstruct_one(NetworkReconstructor(runner, OPTIONS), *small_request(2))
    assert isinstance(outcome, Rejection)
    assert outcome.reason is RejectionReason.SCALE_UNRELIABLE
    assert name in outcome.message
    assert [record.message for record in caplog.records] == [f"{name}: the network's output is not finite"]
    kept = reconstruct_one(NetworkReconstructor(runner, replace(OPTIONS, keep_on_device=True)), *small_request(2))
    assert isinstance(kept, DeviceReconstruction)
    assert kept.local_from_camera.isnan().any() or kept.broken_pixels() > 0


@pytest.mark.parametrize("name", NETWORKS)
def test_a_reconstruction_on_the_device_equals_the_fetched_one(name: str) -> None:
    runner, request = small_runner(name), small_request(3)
    kept = reconstruct_one(NetworkReconstructor(runner, replace(OPTIONS, keep_on_device=True)), *request)
    assert isinstance(kept, DeviceReconstruction)
    assert kept.backend == name
    assert_same_bits(kept.fetch(), reconstruct_one(NetworkReconstructor(runner, OPTIONS), *request))


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


def test_conditions_do_not_depend_on_the_worlds_origin() -> None:
    np.testing.assert_allclose(
        condition_poses(random_poses(4, offset_m=5e6)), condition_poses(random_poses(4)), atol=1e-8
    )


def test_references_at_one_place_keep_their_scale() -> None:
    pose = random_poses(1)[0]
    np.testing.assert_allclose(normalized(condition_poses([pose, pose])), [np.eye(4)] * 3, atol=1e-12)


def test_pi3x_normalizes_by_the_references_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a plain computation, with a far query pose and the mean without it; with it the output differs."""
    query, references = small_request(3)
    runner = small_runner("pi3x")
    outcome = reconstruct_one(NetworkReconstructor(runner, OPTIONS), query, references)
    assert isinstance(outcome, Reconstruction)
    ours = np.stack([view.point_map for view in outcome.references])

    scene = [*(reference.view for reference in references), query]
    images = torch.stack([torch.from_numpy(_official_picture(view)) for view in scene])
    intrinsics = torch.stack([torch.from_numpy(_official_intrinsics(view)).float() for view in scene])
    tokens = runner.encode(images, intrinsics)[None]
    far = RigidTransform(np.eye(3), np.full(3, 40.0))
    world_from_views = [*(reference.world_from_camera for reference in references), far]
    poses = torch.from_numpy(np.stack([pose.matrix() for pose in world_from_views])).float()[None]
    posed = torch.tensor([[True, True, True, False]])

    misled = runner.reconstruct(tokens, (4, 5), 3, poses, posed).local_points[0].numpy()
    monkeypatch.setattr(pi3, "normalize_poses", _normalize_without_the_last)
    plain = runner.reconstruct(tokens, (4, 5), 3, poses, posed).local_points[0].numpy()
    np.testing.assert_allclose(ours, plain, atol=5e-5 * float(np.abs(plain).max()))
    assert np.abs(misled - plain).max() > 1e-3 * float(np.abs(plain).max())


def _normalize_without_the_last(poses: torch.Tensor) -> torch.Tensor:
    return torch.cat([normalize_poses(poses[:, :-1]), torch.eye(4)[None, None]], dim=1)


def _official_picture(view: View) -> NDArray[np.float32]:
    from PIL import Image

    assert view.photograph is not None
    resized = Image.fromarray(view.photograph.read()).resize((70, 56), Image.Resampling.LANCZOS)
    return np.asarray(resized, np.float32).transpose(2, 0, 1) / np.float32(255)


def _official_intrinsics(view: View) -> NDArray[np.float64]:
    """Scaled along each axis, where the top-left pixel's centre is (0.5, 0.5)."""
    camera = view.camera
    k = camera.matrix() + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    return np.diag([70 / camera.width_px, 56 / camera.height_px, 1.0]) @ k


def test_a_single_posed_view_has_no_effect() -> None:
    query, (reference,) = small_request(1)
    backend = NetworkReconstructor(small_runner("pi3x"), OPTIONS)
    moved = replace(reference, world_from_camera=random_poses(1)[0])
    assert_same_bits(reconstruct_one(backend, query, [reference]), reconstruct_one(backend, query, [moved]))


def test_pi3_gets_no_poses() -> None:
    query, references = small_request(3)
    backend = NetworkReconstructor(small_runner("pi3"), OPTIONS)
    moved = [replace(it, world_from_camera=pose) for it, pose in zip(references, random_poses(3), strict=True)]
    assert_same_bits(reconstruct_one(backend, query, references), reconstruct_one(backend, query, moved))


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
    for one, other in zip(arrays_of(plain), arrays_of(same), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4 * float(np.abs(other).max()))


def test_metric_and_other_scenes_of_a_batch_equal_single_ones() -> None:
    query, references = small_request(3)
    runner = small_runner("mapanything")
    requests = [Request(query, references, is_metric=is_metric) for is_metric in (True, False)]
    together = NetworkReconstructor(runner, OPTIONS).reconstruct_many(requests)
    assert np.abs(arrays_of(together[0])[0] - arrays_of(together[1])[0]).max() > 1e-3
    for request, outcome in zip(requests, together, strict=True):
        (alone,) = NetworkReconstructor(runner, OPTIONS).reconstruct_many([request])
        for one, other in zip(arrays_of(outcome), arrays_of(alone), strict=True):
            np.testing.assert_allclose(one, other, atol=2e-4 * float(np.abs(other).max()))


def test_a_first_view_without_a_pose_is_an_error_of_the_caller() -> None:
    runner = small_runner("mapanything")
    tokens = runner.encode(torch.rand(3, 3, 56, 70))[None]
    poses, nothing = torch.eye(4).repeat(1, 3, 1, 1), torch.zeros(1, 3, dtype=torch.bool)
    with pytest.raises(ValueError, match="the first view must have a pose"):
        runner.reconstruct(tokens, (4, 5), 2, poses, torch.tensor([[False, True, True]]))
    none_posed = runner.reconstruct(tokens, (4, 5), 2, poses, nothing)
    assert torch.equal(none_posed.camera_poses, runner.reconstruct(tokens, (4, 5), 2).camera_poses)


# Odd input


@pytest.mark.parametrize("name", NETWORKS)
def test_photographs_of_odd_shapes_and_intrinsics_are_reconstructed(name: str) -> None:
    """A panorama that fits no grid, references of mixed sizes, one whose focal length is thrice too long."""
    query = view_of(photograph(textured(400, 40, seed=9)))
    photos = [photograph(textured(*size, seed=i)) for i, size in enumerate([(96, 72), (72, 96), (640, 480)])]
    wrong = replace(photos[2].camera, focal_x_px=3 * photos[2].camera.focal_x_px)
    references = references_of([*photos[:2], replace(photos[2], camera=wrong)])
    outcome = reconstruct_one(NetworkReconstructor(small_runner(name), OPTIONS), query, references)
    assert all(np.isfinite(values).all() for values in arrays_of(outcome))


# From a name to a backend


def test_an_unknown_name_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="known: auto, geometric, pi3, pi3x, mapanything"):
        make_reconstructor("vggt", tmp_path)


def test_a_network_needs_its_weights(tmp_path: Path) -> None:
    with pytest.raises(WeightsMissing, match="mapless-server weights fetch pi3x"):
        make_reconstructor("pi3x", tmp_path)


def test_a_network_is_loaded_from_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pi3, "Pi3", lambda: Pi3(PI3))
    network = small_network("pi3", seed=4)
    save_file(network.state_dict(), tmp_path / "pi3.safetensors")
    made = make_reconstructor("pi3", tmp_path, "cpu", OPTIONS)
    assert made.name == "pi3"
    assert made.weights_sha256 == hashlib.sha256((tmp_path / "pi3.safetensors").read_bytes()).hexdigest()
    request = small_request(2)
    expected = reconstruct_one(NetworkReconstructor(NetworkRunner(network, "pi3", "sha", "cpu"), OPTIONS), *request)
    assert isinstance(made, NetworkReconstructor)
    assert_same_bits(reconstruct_one(made, *request), expected)
    with (tmp_path / "pi3.safetensors").open("r+b") as stream:
        stream.truncate(1000)
    with pytest.raises(CheckpointError):
        make_reconstructor("pi3", tmp_path, "cpu", OPTIONS)


def test_a_file_under_another_licence_does_not_serve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if it is put into the folder by hand: its tensors are those of the file that a company may use."""
    monkeypatch.setattr(mapanything, "MapAnything", lambda: MapAnything(MAPANYTHING))
    file = tmp_path / "mapanything.safetensors"
    save_file(small_network("mapanything").state_dict(), file)
    assert make_reconstructor("mapanything", tmp_path, "cpu", OPTIONS).name == "mapanything"
    known = named("mapanything")
    other = replace(known.look_alikes[0], sha256=hashlib.sha256(file.read_bytes()).hexdigest())
    monkeypatch.setattr(make, "named", lambda _: replace(known, look_alikes=(other,)))
    with pytest.raises(CheckpointError) as caught:
        make_reconstructor("mapanything", tmp_path, "cpu", OPTIONS)
    assert str(caught.value) == (
        f"{file} is the file of facebook/map-anything, whose licence is CC BY-NC 4.0, non-commercial. mapanything is "
        "the file of facebook/map-anything-apache, whose licence is Apache-2.0: "
        "`mapless-server weights fetch mapanything`"
    )


@pytest.mark.parametrize(("device", "reason"), [("cpu", "there is no CUDA device"), ("cuda", "weights fetch pi3`")])
def test_auto_falls_back_to_geometric_and_logs_the_reason(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, device: str, reason: str
) -> None:
    if device == "cpu":
        (tmp_path / "pi3.safetensors").touch()
    with caplog.at_level(logging.INFO):
        assert isinstance(make_reconstructor("auto", tmp_path, device), GeometricReconstructor)
    (record,) = caplog.records
    assert record.message.startswith("backend auto: geometric serves, not a network: ")
    assert reason in record.message


def test_geometric_does_not_import_torch() -> None:
    program = """if True:
        import sys; sys.modules['torch'] = sys.modules['PIL'] = None
        from pathlib import Path
        from mapless_server.method.coarse.make import make_reconstructor
        print(make_reconstructor('geometric', Path()).name, make_reconstructor('auto', Path()).name)
    """
    assert printed(program) == "geometric geometric\n"
