"""Servers that keep depth with references: made once by a network, used by queries without it, never if it is wrong."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.servers import RunningServer, serving_really
from support.stores import Folder
from support.waiting import wait_until

from mapless import Client, LocalizationResult, NewReference
from mapless.geometry import RigidTransform
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.method.coarse import Outcome, Reconstructor, Request
from mapless_server.method.features.views import PosedView, ReconstructedView, Reconstruction, View
from mapless_server.method.structure import kept_depth
from mapless_server.observability.metrics import Metrics
from mapless_server.security import RateLimiter
from mapless_server.serve.assembly import Parts, engine_options, engine_over
from mapless_server.serve.features import make_tiers
from mapless_server.settings import Settings
from mapless_server.store import Store
from mapless_tools.demo import Photograph, depth_map_m, room

pytestmark = pytest.mark.nightly
"""References are matched with one another first; the parts are tested in `scenes`, `store` and `method`."""

REFERENCES = 7
UNIT_M = 1.7


@cache
def photographs() -> dict[str, Photograph]:
    return {hashlib.sha256(it.data).hexdigest(): it for it in (*room().references, *room().queries)}


class PlantedNetwork:
    """Knows the demo's room: its depths, and where each photograph was taken, in a unit of its own.

    Attributes:
        factor: on all depths.
        failure: raised instead.
    """

    name = "planted"
    weights_sha256 = "c0ffee"
    uses_correspondences = False
    is_batched = True

    def __init__(self, factor: float = 1.0, failure: Exception | None = None) -> None:
        self.factor, self.failure = factor, failure
        self.runs = 0

    def close(self) -> None:
        pass

    def bucket(self, query: View, references: Sequence[PosedView]) -> str:
        return f"{self.name}-{len(references)}"

    def reconstruct_many(self, requests: Sequence[Request]) -> list[Outcome | Exception]:
        self.runs += 1
        return [self.failure or self._reconstruct(request) for request in requests]

    def _reconstruct(self, request: Request) -> Reconstruction:
        query, *others = (self._view(it) for it in (request.query, *(it.view for it in request.references)))
        return Reconstruction(query, tuple(others))

    def _view(self, view: View) -> ReconstructedView:
        assert view.photograph is not None
        shown = photographs()[view.photograph.sha256]
        depth: NDArray[np.float32] = depth_map_m(shown.name) * self.factor / UNIT_M
        camera = view.camera.resized(depth.shape[1], depth.shape[0])
        pixels = np.indices(depth.shape)[::-1].reshape(2, -1).T.astype(float)
        rays = camera.rays(pixels)
        points = (rays / rays[:, 2:]).reshape(*depth.shape, 3) * depth[..., None]
        pose = shown.world_from_camera
        local = RigidTransform(pose.rotation, pose.translation / UNIT_M)
        return ReconstructedView(camera, points.astype(np.float32), np.ones(depth.shape, np.float32), local)


@contextmanager
def serving(data_dir: Path, network: Reconstructor | None = None, **options: Any) -> Iterator[RunningServer]:
    """A real server of SIFT, with depths by a network if there is one, as the setting says."""

    def make(settings: Settings, store: Store, metrics: Metrics, quota: RateLimiter | None) -> QueueEngine:
        parts = Parts(metrics, quota, background_observer=metrics, depth_network=network)
        return engine_over(store, make_tiers(settings), engine_options(settings), parts)

    with serving_really(data_dir, make=make, **({"features": "sift"} | options)) as server:
        yield server


OFF: dict[str, Any] = {"reference_depth": "off", "background_matching": False}
STORED: dict[str, Any] = {"reference_depth": "stored", "background_matching": False}
MAKING: dict[str, Any] = {"reference_depth": "stored", "background_matching": True}
"""With a network, which makes them."""


def answers(server: RunningServer, count: int = 2) -> list[LocalizationResult]:
    """Answers to the first photographs, without what a scene's calibration changes."""
    found = []
    with Client(server.address) as client:
        for query in room().queries[:count]:
            answer = client.localize(query.data, query.camera, "room", ignore_calibration=True)
            assert isinstance(answer, LocalizationResult)
            found.append(answer)
    return found


def poses(server: RunningServer) -> list[bytes]:
    return [it.world_from_camera.matrix().tobytes() for it in answers(server)]


def references() -> list[Photograph]:
    return list(room().references[::2][:REFERENCES])


def fill(data_dir: Path) -> None:
    with serving(data_dir, **OFF) as server, Client(server.address) as client:
        client.create_scene("room")
        added = references()
        client.add_references("room", [NewReference(it.name, it.data, it.camera, it.world_from_camera) for it in added])


@pytest.fixture(autouse=True)
def needed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The demo's photographs match so many triangulated points that depths would not be used."""
    monkeypatch.setattr(kept_depth, "vote", lambda *_: SimpleNamespace(point=np.zeros(0, np.intp)))


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    data_dir = tmp_path_factory.mktemp("filled") / "data"
    fill(data_dir)
    return data_dir


@pytest.fixture
def data_dir(filled: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(filled, tmp_path / "data"))


def wait_for_depths(server: RunningServer) -> None:
    """Until every reference was claimed, and its work is done."""

    def is_done() -> bool:
        made = server.value("mapless_depths_total") > 0
        return made and server.value("mapless_depth_waiting") == 0

    wait_until(is_done)


@pytest.fixture(scope="module")
def kept_once(filled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    data_dir = Path(shutil.copytree(filled, tmp_path_factory.mktemp("kept") / "data"))
    network = PlantedNetwork()
    with serving(data_dir, network, **MAKING) as server:
        wait_for_depths(server)
        assert server.value("mapless_depths_total", result="kept") >= REFERENCES - 1
        assert server.value("mapless_depth_failures_total") == 0
        assert network.runs < REFERENCES, "one run serves several references"
    return data_dir


@pytest.fixture
def kept(kept_once: Path, tmp_path: Path) -> Path:
    """A copy of the folder with the depths of all references, or all but one."""
    return Path(shutil.copytree(kept_once, tmp_path / "data"))


def test_queries_use_what_is_kept_without_the_network(kept: Path) -> None:
    with serving(kept, **OFF) as server:
        without = poses(server)
        assert server.value("mapless_stored_depths_total") == 0
    network = PlantedNetwork(failure=AssertionError("a query ran the network"))
    with serving(kept, network, **STORED) as server:
        by_its_maker = poses(server)
    with serving(kept, **STORED) as server:
        found = answers(server)
        assert server.value("mapless_stored_depths_total", result="stored") >= REFERENCES - 1
        assert [it.world_from_camera.matrix().tobytes() for it in found] == by_its_maker
        for answer, query in zip(found, room().queries, strict=False):
            off_m = answer.world_from_camera.translation - query.world_from_camera.translation
            assert np.linalg.norm(off_m) < 0.01
    assert by_its_maker != without
    assert network.runs == 0


def test_radii_follow_the_calibration_with_depths(kept: Path) -> None:
    query = room().queries[0]
    with serving(kept, **(STORED | {"background_matching": True})) as server, Client(server.address) as client:
        wait_until(lambda: server.value("mapless_calibrations_total") > 0)
        answer = client.localize(query.data, query.camera, "room")
    assert isinstance(answer, LocalizationResult)
    assert answer.accuracy is not None
    assert answer.accuracy.calibration == "SELF"


@pytest.mark.parametrize("factor", [1.6, float("nan")], ids=["another scale", "NaN"])
def test_a_network_that_is_wrong_keeps_nothing(data_dir: Path, factor: float) -> None:
    """All depths 1.6 times as large as its own poses say: triangulated points contradict them."""
    with serving(data_dir, **OFF) as server:
        without = poses(server)
    network = PlantedNetwork(factor)
    with serving(data_dir, network, **MAKING) as server:
        wait_for_depths(server)
        assert server.value("mapless_depths_total", result="kept") == 0
        assert server.value("mapless_depths_total", result="dropped") > 0
        assert poses(server) == without
        runs = network.runs
        assert runs <= REFERENCES, "once for each reference, not again and again"
    assert Folder(data_dir).fetch("SELECT count(*) FROM reference_depth") == [(0,)]
