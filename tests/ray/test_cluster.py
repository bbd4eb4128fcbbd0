"""mapless on a real Ray cluster with Serve's ingress and a real PostgreSQL behaves like one server.

Two replicas. They answer as the plain server does, bit for bit, with its errors and limits, and callers with the
client's usual retries notice nothing when replicas are replaced, killed, or broken. What needs no cluster is in
tests/ray.
"""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent import futures
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from pydantic import SecretStr
from support import corner
from support.clients import FAILING_CALLS, assert_fails_alike
from support.images import encode
from support.messages import essence
from support.postgres import Cluster as Database
from support.postgres import require
from support.servers import CAMERA, PHOTO, localize_request, serving
from support.waiting import wait_until

from bench.load.driving import photo_request
from mapless import (
    Client,
    ConnectOptions,
    DeadlineExceeded,
    LocalizationResult,
    MaplessError,
    NewReference,
    NotFound,
    RigidTransform,
    Unavailable,
)
from mapless.errors import from_rpc_error
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless_server.security import create_token
from mapless_server.services.handlers import SERVICE_NAMES
from mapless_server.store import Store
from mapless_tools.child import child_server
from mapless_tools.demo import Photograph, Place, split_folder

pytest.importorskip("ray.serve", reason="needs Ray Serve: the extra `ray`")

from support.ray_app import FAILS, HANGS, SECRET

from bench.load_ray.cluster import Cluster, Replica, application, running_cluster
from bench.load_ray.replacing import Calls, Scenes, calling

pytestmark = [pytest.mark.timeout(300), pytest.mark.nightly("ray")]

DATA = Path(os.environ.get("TEST_DATA", Path(__file__).parents[3] / "shared" / "data"))
LIMIT_S = 60.0
SCENES = [f"scene-{i}" for i in range(16)]
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
AT_ONCE: dict[str, Any] = {"rolling_update_percentage": 1.0}


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    require()
    database = Database()
    try:
        yield database.fresh_url()
    finally:
        database.remove()


@pytest.fixture(scope="module")
def cluster(url: str) -> Iterator[Cluster]:
    """A cluster whose replicas find the database in their environment, where its password belongs."""
    environment = {"MAPLESS_DATABASE_URL": url, "PYTHONPATH": str(Path(__file__).parents[1])} | ONE_THREAD
    with running_cluster(environment) as running:
        yield running


# The same answers


@pytest.fixture(scope="module")
def real(cluster: Cluster) -> Cluster:
    """Replicas as they are deployed."""
    cluster.deploy(application({"workers": 1, "insecure": True}))
    return cluster


def rendered() -> Place:
    """A papered corner: six photographs, two of which are asked for."""
    poses = map(corner.pose, range(-20, 21, 8))
    own = [Photograph(f"r{i}", corner.photograph(it), corner.CAMERA, it) for i, it in enumerate(poses)]
    return Place("a corner", [own[i] for i in (0, 1, 4, 5)], [own[2], own[3]], metric=True)


def photographed() -> Place:
    if not (DATA / "fountain-P11" / "cameras.json").is_file():
        pytest.skip(f"needs real photographs, {DATA} has none")
    return split_folder(DATA / "fountain-P11")


def asked(place: Place) -> list[bytes]:
    """Requests with references named and with none, so that the server chooses; and two that it must reject.

    With generic radii: the scene calibrates itself at some time between two of them.
    """
    generic = pb.LocalizeRequest(options=pb.LocalizeOptions(ignore_calibration=True)).SerializeToString()
    first, second = place.queries[:2]
    names = [reference.name for reference in place.references[:5]]
    grey = np.full((first.camera.height_px, first.camera.width_px, 3), 127, np.uint8)
    requests = [
        photo_request(first.data, first.camera, names),
        photo_request(first.data, first.camera, ()),
        photo_request(second.data, second.camera, ()),
        photo_request(encode(".jpg", grey), first.camera, ()),
        photo_request(first.data, first.camera, names[:1]),
    ]
    return [request + generic for request in requests]  # concatenated messages are merged


def answered(address: str, request: bytes) -> bytes:
    with grpc.insecure_channel(address, [("grpc.max_send_message_length", -1)]) as channel:
        data = channel.unary_unary("/mapless.v1.LocalizationService/Localize")(request, timeout=LIMIT_S)
    return essence(pb.LocalizeResponse.FromString(data))


def answered_twice(address: str, request: bytes) -> tuple[bool, bytes]:
    """Whether there was a coarse answer before the final one, and the final one."""
    request += pb.LocalizeRequest(options=pb.LocalizeOptions(allow_coarse=True)).SerializeToString()  # is merged
    with grpc.insecure_channel(address, [("grpc.max_send_message_length", -1)]) as channel:
        stream = channel.unary_stream("/mapless.v1.LocalizationService/LocalizeProgressively")
        *coarse, final = map(pb.LocalizeProgressivelyResponse.FromString, stream(request, timeout=LIMIT_S))
    assert [it.is_final for it in (*coarse, final)] == [*[False] * len(coarse), True]
    return bool(coarse), essence(final.answer)


@pytest.mark.parametrize("make_place", [rendered, photographed])
def test_answers_are_those_of_the_plain_server_bit_for_bit(
    url: str, real: Cluster, make_place: Callable[[], Place]
) -> None:
    place = make_place()
    with Client(real.address) as client:
        client.create_scene("load")
        references = [NewReference(p.name, p.data, p.camera, p.world_from_camera) for p in place.references[:10]]
        client.add_references("load", references)
    ways = [real.address, *(replica.address for replica in real.replicas())]
    assert len(ways) == 3
    outcomes = set()
    with child_server(SecretStr(url), {"--workers": "1"}, ONE_THREAD) as plain:
        for request in asked(place):
            expected = answered(plain.address, request)
            assert [answered(way, request) for way in ways] == [expected] * 3
            outcome = pb.LocalizeResponse.FromString(expected).WhichOneof("outcome")
            assert answered_twice(real.address, request) == (outcome == "localization", expected)
            outcomes.add(outcome)
    assert outcomes == {"localization", "rejection"}
    with Client(real.address) as client:
        client.delete_scene("load")


# The same errors and limits


@dataclass(frozen=True)
class Guarded:
    """Replicas whose method does as the test says, and that require tokens.

    Attributes:
        cluster: they are in.
        tokens: by tenant and role.
        tokens_file: that they read.
    """

    cluster: Cluster
    tokens: dict[str, str]
    tokens_file: Path

    def options(self, caller: str = "writer") -> ConnectOptions:
        return ConnectOptions(token=self.tokens[caller])

    def client(self, caller: str = "writer", **options: Any) -> Client:
        return Client(self.cluster.address, replace(self.options(caller), **options))

    def metadata(self, *more: tuple[str, str]) -> list[tuple[str, str]]:
        return [("authorization", f"Bearer {self.tokens['writer']}"), *more]

    def application(self, **settings: Any) -> dict[str, Any]:
        given = {"workers": 2, "tokens_file": str(self.tokens_file), "stall_limit_s": 4.0, "allow_watching": True}
        return application(given | settings, import_path="support.ray_app:build", **AT_ONCE)

    @contextmanager
    def stub(self, address: str | None = None) -> Iterator[LocalizationServiceStub]:
        options = [("grpc.max_send_message_length", -1)]
        with grpc.insecure_channel(address or self.cluster.address, options) as channel:
            yield LocalizationServiceStub(channel)


CALLERS = {"writer": ("acme", "write"), "robot": ("acme", "localize"), "stranger": ("other", "write")}


def fill(client: Client, scene: str, x_s: float = 0.0, how: float = 0.0) -> None:
    client.create_scene(scene)
    client.add_reference(scene, NewReference("r", PHOTO, CAMERA, RigidTransform(np.eye(3), np.array([x_s, how, 0.0]))))


@pytest.fixture(scope="module")
def guarded(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Guarded:
    tokens_file = tmp_path_factory.mktemp("tokens") / "tokens.json"
    tokens = {caller: create_token(tokens_file, caller, *held, None) for caller, held in CALLERS.items()}
    running = Guarded(cluster, tokens, tokens_file)
    cluster.deploy(running.application())
    with running.client(timeout_s=120.0) as client:  # the replicas' processes start meanwhile
        for scene in SCENES:
            fill(client, scene)
        fill(client, "slow", 1.5)
        fill(client, "faulty", how=FAILS)
    return running


@pytest.fixture
def client(guarded: Guarded) -> Iterator[Client]:
    with guarded.client() as connected:
        yield connected


def who(client: Client, scene: str) -> int:
    """The process that answers."""
    answer = client.localize(PHOTO, CAMERA, scene)
    assert isinstance(answer, LocalizationResult)
    return answer.inlier_count


def test_errors_are_those_of_the_plain_server_with_details(url: str, guarded: Guarded, tmp_path: Path) -> None:
    with (
        serving(tmp_path, store=Store.connect(url), tokens_file=guarded.tokens_file) as plain,
        Client(plain.address, guarded.options()) as direct,
        guarded.client() as through,
    ):
        for failing in FAILING_CALLS:
            assert_fails_alike(failing, SCENES[0], direct, through)


def test_errors_are_internal_without_the_exceptions_text(guarded: Guarded) -> None:
    with guarded.stub() as stub, pytest.raises(grpc.RpcError) as caught:
        stub.Localize(localize_request("faulty"), timeout=30, metadata=guarded.metadata(("x-request-id", "mine")))
    assert from_rpc_error(caught.value).code == "INTERNAL"
    failure: Any = caught.value
    assert failure.details() == "internal error, id=mine"
    assert SECRET not in repr(failure.trailing_metadata())


def test_invalid_tokens_and_other_tenants_are_kept_out(guarded: Guarded) -> None:
    with Client(guarded.cluster.address) as nobody, pytest.raises(MaplessError) as caught:
        nobody.get_scene(SCENES[0])
    assert caught.value.code == "UNAUTHENTICATED"
    with guarded.client("robot") as robot, pytest.raises(MaplessError) as caught:
        robot.create_scene("mine")
    assert caught.value.code == "PERMISSION_DENIED"
    with guarded.client("stranger") as stranger, pytest.raises(NotFound):
        stranger.get_scene(SCENES[0])


def test_the_callers_deadline_comes_along(guarded: Guarded, client: Client) -> None:
    """The replica itself says that it passed; and refuses at once what it knows to take longer."""
    with pytest.raises(DeadlineExceeded) as caught:
        client.localize(PHOTO, CAMERA, "slow", timeout_s=0.8)
    assert caught.value.request_id
    for _ in range(3):
        client.localize(PHOTO, CAMERA, "slow")

    def reason(_: int) -> str:
        with guarded.client() as own:
            try:
                own.localize(PHOTO, CAMERA, "slow", timeout_s=1.6)
            except MaplessError as error:
                return str(error.reason)
        return ""  # the first in the queue may still be in time

    with futures.ThreadPoolExecutor(12) as pool:
        assert "DEADLINE_INFEASIBLE" in set(pool.map(reason, range(12)))


def test_too_much_is_refused_with_the_time_to_come_back(guarded: Guarded) -> None:
    with guarded.client(max_attempts=1) as once, futures.ThreadPoolExecutor(32) as pool:
        calls = [pool.submit(once.localize, PHOTO, CAMERA, "slow", timeout_s=30) for _ in range(32)]
        errors = [error for call in calls if (error := call.exception(LIMIT_S)) is not None]
    assert 0 < len(errors) < 32
    for error in errors:
        assert isinstance(error, MaplessError)
        assert (error.code, error.reason) == ("RESOURCE_EXHAUSTED", "QUEUE_FULL")
        assert error.retry_after_s


def test_health_and_reflection_are_the_standard_ones(guarded: Guarded) -> None:
    with grpc.insecure_channel(guarded.cluster.address) as channel:
        for name in ("", *SERVICE_NAMES):
            request = health_pb2.HealthCheckRequest(service=name)
            assert health_pb2_grpc.HealthStub(channel).Check(request, timeout=30).status == 1
        ask = reflection_pb2.ServerReflectionRequest(list_services="")
        (response,) = reflection_pb2_grpc.ServerReflectionStub(channel).ServerReflectionInfo(iter([ask]), timeout=30)
    listed = [service.name for service in response.list_services_response.service]
    assert set(SERVICE_NAMES) < set(listed)
    assert len(listed) == len(set(listed))


# Which replica answers


def test_calls_of_a_scene_reach_one_replica_and_scenes_both(guarded: Guarded, client: Client) -> None:
    at = {scene: who(client, scene) for scene in SCENES}
    assert set(at.values()) == {replica.process_id for replica in guarded.cluster.replicas()}
    with guarded.client() as another:
        assert {scene: who(another, scene) for scene in SCENES} == at


def test_calls_that_name_no_scene_come_to_both_by_turns(guarded: Guarded) -> None:
    with guarded.stub() as stub:
        request = localize_request(SCENES[0])
        answers = [stub.Localize(request, timeout=30, metadata=guarded.metadata()) for _ in range(20)]
    counts = [answer.localization.inlier_count for answer in answers]
    assert min(counts.count(replica.process_id) for replica in guarded.cluster.replicas()) >= 8


# Replicas come and go


@contextmanager
def called(guarded: Guarded) -> Iterator[Calls]:
    """Callers of all kinds meanwhile; at the end no call has failed and nothing that was acknowledged is lost."""
    scenes = Scenes(4, PHOTO, CAMERA)

    def long(client: Client, *_: Any) -> None:
        client.localize(PHOTO, CAMERA, "slow")

    with guarded.client() as client:
        scenes.remove(client)
        scenes.store(client)
    kinds = [scenes.localize, scenes.get, long, scenes.add]
    with calling(guarded.cluster.address, kinds, 0.02, guarded.options()) as calls:
        wait_until(lambda: len(calls.ended) > 20)
        yield calls
        begin_s = time.monotonic()
        wait_until(lambda: min(sum(it.caller == i and it.begin_s > begin_s for it in calls.ended) for i in range(4)))
    assert calls.failed == []
    assert len(calls.acknowledged) > 0
    with guarded.client() as client:
        assert scenes.lost(client, calls) == set()


def replaced(cluster: Cluster, gone: set[Replica]) -> bool:
    now = set(cluster.replicas())
    return len(now) == 2 and not now & gone


def test_a_replica_that_is_killed_costs_retries_and_no_call(guarded: Guarded) -> None:
    victim = guarded.cluster.replicas()[0]
    with called(guarded):
        os.kill(victim.process_id, signal.SIGKILL)
        wait_until(lambda: replaced(guarded.cluster, {victim}))


def test_a_replica_whose_queue_hangs_ends_and_is_replaced(guarded: Guarded, client: Client) -> None:
    fill(client, "hanging", how=HANGS)
    victim = guarded.cluster.replicas()[0]
    with Client(victim.address, replace(guarded.options(), max_attempts=1)) as direct, called(guarded):
        with pytest.raises(MaplessError):
            direct.localize(PHOTO, CAMERA, "hanging", timeout_s=20)
        wait_until(lambda: replaced(guarded.cluster, {victim}))
    assert not Path(f"/proc/{victim.process_id}").exists()


def test_a_redeploy_costs_no_call_and_ends_endless_streams(guarded: Guarded) -> None:
    """Not even a retry: calls that run are finished, and new ones come to the replicas that are left."""
    before = set(guarded.cluster.replicas())
    ended: list[str] = []

    def watch(stub: LocalizationServiceStub) -> None:
        request = pb.WatchQueriesRequest(scene=f"scenes/{SCENES[0]}")
        call = stub.WatchQueries(request, timeout=LIMIT_S, metadata=guarded.metadata())
        call.initial_metadata()
        with pytest.raises(grpc.RpcError) as caught:
            list(call)
        ended.append(from_rpc_error(caught.value).code)

    application = guarded.application(max_queued_s=3.0)
    del application["deployments"][0]["rolling_update_percentage"]  # one after the other
    with guarded.stub() as stub, called(guarded):
        watching = threading.Thread(target=watch, args=(stub,))
        watching.start()
        guarded.cluster.deploy(application)
        watching.join(LIMIT_S)
    assert ended == ["UNAVAILABLE"]
    assert not before & set(guarded.cluster.replicas())


def test_without_any_replica_calls_may_be_retried(guarded: Guarded) -> None:
    with guarded.client(max_attempts=1, timeout_s=5.0) as once, guarded.client() as patient:
        for replica in guarded.cluster.replicas():
            os.kill(replica.process_id, signal.SIGKILL)
        errors = []

        def is_refused() -> bool:
            try:
                once.get_scene(SCENES[0])
            except Unavailable as error:
                errors.append(error)
            return bool(errors) and errors[-1].retry_after_s is not None

        wait_until(is_refused)
        assert (errors[-1].reason, errors[-1].retry_after_s) == ("STARTING", 1.0)
        assert not once.is_serving()
        assert patient.get_scene(SCENES[0]).scene_id == SCENES[0]
