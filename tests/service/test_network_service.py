"""The whole service on a small network with random weights: its poses are meaningless, but no call fails."""

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch", reason="the networks' extra is not installed")
pytest.importorskip("PIL", reason="the networks' extra is not installed")

import grpc
import torch
from support.images import encode, textured
from support.servers import RunningServer, failure_of, localize_request, serving
from support.small_networks import PIXEL_LIMIT, small_network
from support.waiting import wait_until

from mapless import Client, LocalizationResult, NewReference, Rejected, Unavailable, wire
from mapless.geometry import Camera, RigidTransform
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless_server.choices import NETWORKS
from mapless_server.engine.query import Tier
from mapless_server.engine.stages import Method
from mapless_server.method import pipeline
from mapless_server.method.coarse.network import NetworkOptions, NetworkReconstructor
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.pipeline import Pipeline
from mapless_server.networks.network import Network
from mapless_server.networks.runner import NetworkRunner

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
DISTANCE_M = 3.0
by_one = pytest.mark.parametrize(
    "name", [it if it == "pi3x" else pytest.param(it, marks=pytest.mark.nightly) for it in NETWORKS]
)
"""Tests that no network decides, each of which has tests of its own; nightly with the others."""
WALL = textured(800, 240, seed=8)
"""Wallpaper: it moves by 100 px when the camera moves by a metre along it."""
NAMES = ["r0", "r1", "r2", "r3"]


def photograph_at(x_m: float) -> NDArray[np.uint8]:
    start = round(x_m * CAMERA.focal_x_px / DISTANCE_M)
    return WALL[:, start : start + CAMERA.width_px]


def pose_at(x_m: float) -> RigidTransform:
    return RigidTransform(np.eye(3), np.array([x_m, 0.0, 0.0]))


@contextmanager
def on_network(
    data_dir: Path, network: Network, name: str, method: Method | None = None, **options: Any
) -> Iterator[tuple[Client, NetworkReconstructor, RunningServer]]:
    """A client of a server on this network, with the real method and SIFT, and a scene of four photographs."""
    torch.set_num_threads(1)
    runner = NetworkRunner(network, name, f"sha-of-{name}", "cpu")
    with (
        closing(NetworkReconstructor(runner, NetworkOptions(pixel_limit=PIXEL_LIMIT))) as backend,
        serving(
            data_dir, method=method or Method(), tier=Tier(SiftExtractor(), Pipeline(backend)), **options
        ) as server,
        Client(server.address) as client,
    ):
        client.create_scene("wall")
        photos = [
            NewReference(f"r{i}", encode(".png", photograph_at(x_m)), CAMERA, pose_at(x_m))
            for i, x_m in enumerate((0.0, 0.5, 1.0, 1.5))
        ]
        client.add_references("wall", photos)
        yield client, backend, server


@by_one
def test_a_random_network_is_answered_for(tmp_path: Path, name: str) -> None:
    """Nothing but the answer's form is known: the network is random, but matches and poses of references are true."""
    with on_network(tmp_path, small_network(name), name) as (client, backend, _):
        answers = [client.localize(encode(".png", photograph_at(x_m)), CAMERA, "wall", NAMES) for x_m in (0.7, 1.2)]
        for answer in answers:
            assert isinstance(answer, (LocalizationResult, Rejected))
            used = answer.diagnostics
            assert (used.backend, used.weights_sha256) == (name, f"sha-of-{name}")
            assert "coarse" in used.stage_s
        single = client.localize(encode(".png", photograph_at(0.7)), CAMERA, "wall", ["r1"])
        assert isinstance(single, (LocalizationResult, Rejected)), "with its own metres or none"
        # The references' tokens were kept from the first query to the second.
        assert backend.cache.counters.misses == 4
        assert backend.cache.counters.device_hits >= 4


@by_one
def test_calls_waiting_for_a_network_become_one_batch(tmp_path: Path, name: str) -> None:
    sizes: list[int] = []
    entered, gate = threading.Semaphore(0), threading.Event()

    def reconstruct(batch: Any) -> Any:
        entered.release()
        assert gate.wait(60)
        sizes.append(len(batch))
        return pipeline.reconstruct(batch)

    options = {"workers": 2, "max_batch": 4, "max_queued_s": 60.0}
    with (
        ThreadPoolExecutor(5) as pool,
        on_network(tmp_path, small_network(name), name, Method(reconstruct=reconstruct), **options) as running,
    ):
        client, backend, server = running

        def localize(x_m: float) -> Any:
            return client.localize(encode(".png", photograph_at(x_m)), CAMERA, "wall", NAMES, timeout_s=60)

        calls = [pool.submit(localize, 0.2)]
        try:
            assert entered.acquire(timeout=30)
            calls += [pool.submit(localize, x_m) for x_m in (0.3, 0.6, 0.9, 1.2)]
            wait_until(lambda: server.value("mapless_queue_depth", stage="coarse") == 4)
        finally:
            gate.set()
        assert all(isinstance(call.result(60), LocalizationResult | Rejected) for call in calls)
        assert sizes == [1, 4]
        assert server.value("mapless_batch_size_sum", stage="coarse") == 5
        assert server.value("mapless_batch_size_count", stage="coarse") == 2
        # Each reference was encoded once: by the first query, for all of them.
        assert backend.cache.counters.misses == 4


@by_one
def test_too_little_memory_fails_the_call_alone(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A query that does not fit alone is UNAVAILABLE; a batch that does not fit is split, and answered."""
    photograph, most = encode(".png", photograph_at(0.7)), [0]
    reconstruct = NetworkRunner.reconstruct

    def limited(runner: NetworkRunner, tokens: torch.Tensor, *others: Any) -> Any:
        if len(tokens) > most[0]:
            raise torch.OutOfMemoryError("too little")
        return reconstruct(runner, tokens, *others)

    monkeypatch.setattr(NetworkRunner, "reconstruct", limited)
    entered, gate = threading.Semaphore(0), threading.Event()
    gate.set()

    def wait(batch: Any) -> Any:
        entered.release()
        assert gate.wait(60)
        return pipeline.reconstruct(batch)

    options = {"workers": 2, "max_batch": 4, "max_queued_s": 60.0}
    with (
        ThreadPoolExecutor(4) as pool,
        on_network(tmp_path, small_network(name), name, Method(reconstruct=wait), **options) as (client, _, server),
    ):
        with grpc.insecure_channel(server.address) as channel:  # the client would try again
            request = localize_request("wall")
            request.image = photograph
            request.intrinsics.CopyFrom(wire.camera_to_message(CAMERA))
            error = failure_of(LocalizationServiceStub(channel).Localize, request)
        assert isinstance(error, Unavailable)
        assert error.reason == "OUT_OF_MEMORY"
        most[0] = 1
        gate.clear()
        assert entered.acquire(timeout=30)

        def localize() -> Any:
            return client.localize(photograph, CAMERA, "wall", NAMES, timeout_s=60)

        calls = [pool.submit(localize)]
        try:
            assert entered.acquire(timeout=30)
            calls += [pool.submit(localize) for _ in range(3)]
            wait_until(lambda: server.value("mapless_queue_depth", stage="coarse") == 3)
        finally:
            gate.set()
        assert all(isinstance(call.result(60), LocalizationResult | Rejected) for call in calls)
        assert server.value("mapless_gpu_oom_total") >= 2


def test_a_scene_of_unknown_unit_has_no_metric_poses(tmp_path: Path) -> None:
    units: list[bool] = []

    def reconstruct(batch: Any) -> Any:
        units.extend(prepared.is_metric for prepared in batch)
        return pipeline.reconstruct(batch)

    with on_network(tmp_path, small_network("mapanything"), "mapanything", Method(reconstruct=reconstruct)) as (
        client,
        *_,
    ):
        client.localize(encode(".png", photograph_at(0.7)), CAMERA, "wall", NAMES)
        client.update_scene("wall", arbitrary_unit=True)
        client.localize(encode(".png", photograph_at(0.7)), CAMERA, "wall", NAMES)
    assert units == [True, False]
