"""Two servers behind a real Envoy, configured as deployed: routing, and answers as without it."""

import json
import ssl
import subprocess
import threading
import time
from collections.abc import Iterator
from concurrent import futures
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from http.client import HTTPSConnection
from pathlib import Path
from typing import Any

import grpc
import pytest
import yaml  # type: ignore[import-untyped]
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from support.certificates import authority, signed
from support.clients import FAILING_CALLS, Recording, assert_fails_alike, hosted
from support.documents import blocks
from support.envoys import ENVOY, Gateway, configured, fetched, gateway, program
from support.postgres import shared_cluster
from support.programs import gated
from support.servers import CAMERA, PHOTO, RunningServer, localize_request, pose, serving
from support.waiting import wait_until

from mapless import (
    Client,
    DeadlineExceeded,
    InvalidArgument,
    LocalizationResult,
    MaplessError,
    NewReference,
    ResourceExhausted,
    Unavailable,
    wire,
)
from mapless.errors import from_rpc_error
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless_server.services.handlers import SERVICE_NAMES
from mapless_server.store import Store

SCENES = [f"scene-{i}" for i in range(16)]
ASKING = 3
"""How many ask at a time."""


def fill(client: Client) -> None:
    for scene in SCENES:
        client.create_scene(scene)
        client.add_reference(scene, NewReference("r", PHOTO, CAMERA, pose(1.0)))


@pytest.fixture(scope="module")
def url() -> str:
    """The URL of a database with the scenes."""
    return shared_cluster().fresh_url()


@dataclass
class Fleet:
    """Two servers and what is in front of them; a server is known by the inliers that it claims, 100 or 101."""

    servers: list[RunningServer]
    gateway: Gateway
    client: Client

    def who(self, scene: str) -> int:
        """The server that answers."""
        answer = self.client.localize(PHOTO, CAMERA, scene)
        assert isinstance(answer, LocalizationResult)
        return answer.inlier_count - 100


@contextmanager
def fleet_of(folder: Path, url: str, **settings: Any) -> Iterator[Fleet]:
    with ExitStack() as stack:
        servers = []
        for i in range(2):
            server = stack.enter_context(serving(folder / f"server-{i}", store=Store.connect(url), **settings))
            server.method.inlier_count = 100 + i
            servers.append(server)
        running = stack.enter_context(gateway(folder / "gateway", [server.address for server in servers]))
        yield Fleet(servers, running, stack.enter_context(Client(running.address, running.options)))


@pytest.fixture(scope="module")
def fleet(url: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    with fleet_of(tmp_path_factory.mktemp("fleet"), url) as running:
        fill(running.client)
        yield running


def test_the_deployed_configuration_is_valid_and_up_to_date(tmp_path: Path) -> None:
    path = configured(tmp_path, authority(), ["127.0.0.1:1"])
    command = [program(), "--mode", "validate", "--config-path", str(path)]
    said = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert said.returncode == 0, said.stderr
    assert "OK" in said.stdout + said.stderr
    assert "deprecated" not in said.stderr.lower()


def test_servers_may_have_certificates_as_the_readme_says(tmp_path: Path) -> None:
    by = authority("servers")
    signed(by, "server").write(tmp_path / "tls.crt", tmp_path / "tls.key")
    (tmp_path / "ca.crt").write_bytes(by.certificate_pem)
    (block,) = blocks(ENVOY.parent / "README.md", "yaml")
    said = block.replace("/etc/mapless/servers", str(tmp_path)).replace("mapless-headless", "localhost")

    def with_it(text: str) -> str:
        config = yaml.safe_load(text)
        for cluster in config["static_resources"]["clusters"][:2]:
            cluster |= yaml.safe_load(said)
        return str(yaml.safe_dump(config))

    with (
        serving(tmp_path / "server", tls_certificate=tmp_path / "tls.crt", tls_key=tmp_path / "tls.key") as server,
        gateway(tmp_path / "gateway", [server.address], with_it) as running,
        Client(running.address, running.options) as client,
    ):
        client.create_scene("s")
        assert [scene.scene_id for scene in client.list_scenes()] == ["s"]


def test_calls_of_a_scene_come_to_one_server_and_scenes_to_both(fleet: Fleet) -> None:
    at = {scene: fleet.who(scene) for scene in SCENES}
    assert set(at.values()) == {0, 1}
    for _ in range(3):
        assert {scene: fleet.who(scene) for scene in SCENES} == at
    with Client(fleet.gateway.address, fleet.gateway.options) as another:
        assert {scene: Fleet(fleet.servers, fleet.gateway, another).who(scene) for scene in SCENES} == at


def test_a_scene_that_is_asked_for_too_often_gets_help(fleet: Fleet) -> None:
    """One server holds at most one and a half times its share of the calls under way."""
    with ExitStack() as stack, futures.ThreadPoolExecutor(16) as pool:
        for server in fleet.servers:
            stack.enter_context(server.method.held())
        calls = [pool.submit(fleet.who, SCENES[0]) for _ in range(8)]
        wait_until(lambda: all(server.engine.queue.job_count for server in fleet.servers))
        for server in fleet.servers:
            server.method.gate.set()
        assert {call.result(60) for call in calls} == {0, 1}


def test_callers_that_name_no_scene_in_metadata_come_to_either(fleet: Fleet) -> None:
    with channel_to(fleet.gateway) as channel:
        stub = LocalizationServiceStub(channel)
        answers = [stub.Localize(localize_request(SCENES[0]), timeout=30) for _ in range(40)]
    assert {answer.localization.inlier_count for answer in answers} == {100, 101}


@contextmanager
def channel_to(running: Gateway) -> Iterator[grpc.Channel]:
    credentials = grpc.ssl_channel_credentials(running.options.root_certificates)
    options = [("grpc.max_send_message_length", 64 * 2**20)]
    with grpc.secure_channel(running.address, credentials, options) as channel:
        yield channel


# What callers get is the server's


@pytest.mark.parametrize("what", FAILING_CALLS)
def test_errors_pass_with_all_their_details(fleet: Fleet, what: str) -> None:
    with Client(fleet.servers[0].address) as direct:
        failure = assert_fails_alike(what, SCENES[0], direct, fleet.client)
    assert len(failure.request_id) == 36  # the gateway's own, by which its log and the server's go together


def test_a_refusal_has_a_retry_delay(url: str, fleet: Fleet, tmp_path: Path) -> None:
    """No retry of the gateway's hides it, and no server is left out for it."""
    with (
        fleet_of(tmp_path, url, max_queued_s=2.0) as full,
        ExitStack() as stack,
        futures.ThreadPoolExecutor(200) as pool,
    ):
        for server in full.servers:
            stack.enter_context(server.method.held())
        client = stack.enter_context(Client(full.gateway.address, replace(full.gateway.options, max_attempts=1)))
        calls: list[futures.Future[Any]] = []

        def refused() -> list[BaseException]:
            return [error for it in calls if it.done() and (error := it.exception())]

        while not refused():
            calls.append(pool.submit(client.localize, PHOTO, CAMERA, SCENES[len(calls) % 16]))
            assert len(calls) < 200
            futures.wait(calls[-1:], 0.02)
        for server in full.servers:
            server.method.gate.set()
        futures.wait(calls, 60)
        for error in refused():
            assert isinstance(error, ResourceExhausted)
            assert error.reason == "QUEUE_FULL"
            assert error.retry_after_s is not None
            assert error.retry_after_s > 0
        assert full.gateway.healthy("by_scene") == {server.address for server in full.servers}


def test_faults_of_a_server_take_none_away(fleet: Fleet) -> None:
    """They would otherwise be taken away one after the other, for one bad scene."""
    for server in fleet.servers:
        server.method.failure = RuntimeError("secret")
    try:
        for scene in SCENES:
            with pytest.raises(MaplessError) as caught:
                fleet.who(scene)
            assert caught.value.code == "INTERNAL"
            assert "secret" not in str(caught.value)
    finally:
        for server in fleet.servers:
            server.method.failure = None
    assert fleet.gateway.healthy("by_scene") == {server.address for server in fleet.servers}
    assert {fleet.who(scene) for scene in SCENES} == {0, 1}


def test_health_is_the_servers(fleet: Fleet) -> None:
    assert fleet.client.is_serving()
    with channel_to(fleet.gateway) as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        for name in SERVICE_NAMES:
            answer = stub.Check(health_pb2.HealthCheckRequest(service=name), timeout=30)
            assert answer.status == health_pb2.HealthCheckResponse.SERVING


def test_what_is_not_for_callers_does_not_pass(fleet: Fleet) -> None:
    with channel_to(fleet.gateway) as channel:
        for method in ("/grpc.reflection.v1.ServerReflection/ServerReflectionInfo", "/other.Service/Method", "/ready"):
            with pytest.raises(grpc.RpcError) as caught:
                channel.unary_unary(method)(b"", timeout=30)
            assert from_rpc_error(caught.value).code == "UNIMPLEMENTED"


# Browsers


ORIGIN = "https://app.example"


@dataclass
class Page:
    """A page of an origin, whose browser speaks gRPC-Web over HTTP/1.1."""

    running: Gateway
    origin: str = ORIGIN

    def asks(self, method: str, headers: dict[str, str], body: bytes = b"") -> tuple[int, dict[str, str], bytes]:
        """Status, headers and body of a request to Localize."""
        trusted = ssl.create_default_context(cadata=(self.running.options.root_certificates or b"").decode())
        connection = HTTPSConnection("localhost", self.running.port, context=trusted, timeout=30)
        with closing(connection):
            path = "/mapless.v1.LocalizationService/Localize"
            connection.request(method, path, body, {"origin": self.origin, **headers})
            response = connection.getresponse()
            return response.status, {name.lower(): it for name, it in response.getheaders()}, response.read()

    def may_call(self) -> bool:
        """The headers of the answer to the browser's preflight."""
        wanted = {
            "access-control-request-method": "POST",
            "access-control-request-headers": "x-grpc-web,x-mapless-scene",
        }
        status, headers, _ = self.asks("OPTIONS", wanted)
        return status == 200 and headers.get("access-control-allow-origin") == self.origin

    def localizes(self) -> tuple[pb.LocalizeResponse, str, dict[str, str]]:
        """The answer, the trailers and the headers of a call."""
        request = localize_request(SCENES[0]).SerializeToString()
        headers = {
            "content-type": "application/grpc-web+proto",
            "x-grpc-web": "1",
            "x-mapless-scene": f"scenes/{SCENES[0]}",
        }
        status, answered, body = self.asks("POST", headers, b"\0" + len(request).to_bytes(4, "big") + request)
        assert (status, answered["content-type"]) == (200, "application/grpc-web+proto")
        size = int.from_bytes(body[1:5], "big")
        return pb.LocalizeResponse.FromString(body[5 : 5 + size]), body[5 + size + 5 :].decode(), answered


def test_a_page_of_a_listed_origin_localizes_by_grpc_web(fleet: Fleet, tmp_path: Path) -> None:
    def with_origin(text: str) -> str:
        config = text.replace("allow_origin_string_match: []", f"allow_origin_string_match: [{{exact: {ORIGIN}}}]")
        assert ORIGIN in config
        return config

    with gateway(tmp_path, [server.address for server in fleet.servers], with_origin) as running:
        page = Page(running)
        assert page.may_call()
        answer, trailers, headers = page.localizes()
        assert answer.localization.world_from_camera.translation_m.x == 1.0
        assert "grpc-status:0" in trailers
        assert headers["access-control-allow-origin"] == ORIGIN
        assert "grpc-status" in headers["access-control-expose-headers"]
        assert not Page(running, "https://other.example").may_call()


def test_pages_are_refused_unless_their_origin_is_listed(fleet: Fleet) -> None:
    page = Page(fleet.gateway)
    assert not page.may_call()
    assert page.asks("OPTIONS", {})[0] == 404
    _, _, headers = page.localizes()  # as another program than a browser may, which has no origin to check
    assert "access-control-allow-origin" not in headers
    assert page.asks("POST", {"content-type": "application/json"}, b"{}")[0] == 404
    assert page.asks("GET", {})[0] == 404


def test_a_cancelled_call_ends_at_the_server(fleet: Fleet) -> None:
    with ExitStack() as stack:
        for server in fleet.servers:
            stack.enter_context(server.method.held())
        channel = stack.enter_context(channel_to(fleet.gateway))
        running = LocalizationServiceStub(channel).Localize.future(localize_request(SCENES[0]))
        wait_until(lambda: sum(server.engine.queue.job_count for server in fleet.servers) == 1)
        running.cancel()
        with pytest.raises(DeadlineExceeded):
            fleet.client.localize(PHOTO, CAMERA, SCENES[1], timeout_s=1.0)
    wait_until(lambda: not any(server.engine.queue.job_count for server in fleet.servers))


@pytest.mark.parametrize(("size_mib", "expected"), [(20, InvalidArgument), (33, ResourceExhausted)])
def test_the_servers_limit_of_messages_is_the_limit(fleet: Fleet, size_mib: int, expected: type[MaplessError]) -> None:
    """Larger ones than the gateway keeps for a retry pass all the same."""
    request = pb.LocalizeRequest(
        scene=f"scenes/{SCENES[0]}", image=bytes(size_mib * 2**20), intrinsics=wire.camera_to_message(CAMERA)
    )
    failures = []
    with (
        channel_to(fleet.gateway) as through,
        grpc.insecure_channel(fleet.servers[0].address, [("grpc.max_send_message_length", 64 * 2**20)]) as direct,
    ):
        for channel in (direct, through):
            with pytest.raises(grpc.RpcError) as caught:
                LocalizationServiceStub(channel).Localize(request, timeout=60)
            failures.append(from_rpc_error(caught.value))
    here, there = failures
    assert type(there) is type(here) is expected
    assert (there.message, there.retry_after_s) == (here.message, here.retry_after_s)


def test_servers_get_the_callers_metadata_and_address(tmp_path: Path) -> None:
    echo = Recording()
    service = health.HealthServicer()
    service.set("mapless.v1.LocalizationService", health_pb2.HealthCheckResponse.SERVING)
    add = partial(health_pb2_grpc.add_HealthServicer_to_server, service)
    with hosted(echo, add=add) as address, gateway(tmp_path, [address]) as running, channel_to(running) as channel:
        call = channel.unary_unary("/mapless.v1.LocalizationService/Localize")
        call(b"", timeout=50)
        said = [
            ("x-client-id", "robot-7"),
            ("x-request-id", "mine"),
            ("authorization", "Bearer t"),
            ("x-mapless-scene", "scenes/hall"),
            ("x-envoy-upstream-rq-timeout-ms", "1"),  # not the caller's to say
        ]
        call(b"", timeout=50, metadata=said)
    silent, talkative = echo.metadata
    # Without it all callers of the gateway would be one to the server, which is to be fair between them.
    assert silent["x-client-id"] == "127.0.0.1"
    assert len(silent["x-request-id"]) == 36
    assert talkative.items() >= dict(said[:4]).items()
    assert "x-envoy-upstream-rq-timeout-ms" not in talkative
    # The caller's deadline, less the time on the way.
    assert all(30 < remaining_s < 51 for remaining_s in echo.remaining_s)


# Servers and gateways that go


@contextmanager
def asking(client: Client) -> Iterator[list[BaseException]]:
    """A caller that reads one scene after the other, until the block is left; gives the errors."""
    failures: list[BaseException] = []
    done = threading.Event()

    def ask() -> None:
        calls = 0
        while not done.is_set() or calls < 50:
            try:
                client.localize(PHOTO, CAMERA, SCENES[calls % len(SCENES)], timeout_s=30)
            except MaplessError as error:
                failures.append(error)
            calls += 1

    threads = [threading.Thread(target=ask) for _ in range(ASKING)]
    for thread in threads:
        thread.start()
    try:
        yield failures
    finally:
        done.set()
        for thread in threads:
            thread.join(60)
        assert not any(thread.is_alive() for thread in threads)


@pytest.mark.nightly
def test_calls_leave_a_draining_server_without_errors(url: str, fleet: Fleet, tmp_path: Path) -> None:
    with fleet_of(tmp_path, url, drain_delay_s=2.0) as leaving:
        once = replace(leaving.gateway.options, max_attempts=1)  # not even a retry hides anything
        stays = {leaving.servers[1].address}
        with Client(leaving.gateway.address, once) as client, asking(client) as failures:
            leaving.servers[0].stop()
            wait_until(lambda: leaving.gateway.healthy("by_scene") == stays)
            before = leaving.servers[0].method.call_count
            time.sleep(2.5)  # past the drain
            # Each of those who ask may have had a call on its way.
            assert leaving.servers[0].method.call_count <= before + ASKING
        assert failures == []
        assert {leaving.who(scene) for scene in SCENES} == {1}


@pytest.mark.nightly
def test_a_server_that_is_killed_costs_retries_and_no_call(url: str, fleet: Fleet, tmp_path: Path) -> None:
    with ExitStack() as stack:
        killed, left = (stack.enter_context(gated(tmp_path / str(i), database_url=url)) for i in range(2))
        for server in (killed, left):
            server.open_gate()
        running = stack.enter_context(gateway(tmp_path / "gateway", [killed.address, left.address]))
        with Client(running.address, running.options) as client, asking(client) as failures:
            wait_until(lambda: killed.began and left.began)
            killed.process.kill()
            wait_until(lambda: running.healthy("by_scene") == {left.address})
        assert failures == []
        # Without any server calls fail at once, with the code for which clients retry.
        left.process.kill()
        wait_until(lambda: not running.healthy("by_scene"))
        with Client(running.address, replace(running.options, max_attempts=1)) as client, pytest.raises(Unavailable):
            client.get_scene(SCENES[0])


def before_the_end(running: Gateway) -> list[str]:
    """The deployed pod's steps before it ends, but for the time that it then waits."""
    documents = yaml.safe_load_all((ENVOY / "gateway.yaml").read_text())
    (pod,) = [it["spec"]["template"]["spec"] for it in documents if it["kind"] == "Deployment"]
    *shell, script = pod["containers"][0]["lifecycle"]["preStop"]["exec"]["command"]
    port = running.administration.rpartition(":")[2]
    asked = script.replace("127.0.0.1/9901", f"127.0.0.1/{port}").replace(" && sleep 45", "")
    assert f"/{port} " in asked
    assert "sleep" not in asked
    return [*shell, asked]


@pytest.mark.nightly
def test_a_draining_gateway_reports_it_and_answers(url: str, fleet: Fleet, tmp_path: Path) -> None:
    (server,) = fleet.servers[:1]
    with gateway(tmp_path, [server.address]) as leaving:
        once = replace(leaving.options, max_attempts=1)
        with Client(leaving.address, once) as client, asking(client) as failures:
            assert fetched(f"{leaving.status}/ready")[0] == 200
            said = subprocess.run(before_the_end(leaving), capture_output=True, text=True, timeout=60)
            assert said.returncode == 0, said.stderr
            assert said.stdout.startswith("HTTP/1.1 200 OK")
            wait_until(lambda: fetched(f"{leaving.status}/ready")[0] == 503)
        assert failures == []
        _, text = fetched(f"{leaving.administration}/stats?filter=http.calls.downstream_cx_drain_close&format=json")
        assert sum(it["value"] for it in json.loads(text)["stats"]) >= 1  # clients were asked to reconnect


def test_the_status_port_shows_metrics_and_nothing_else(fleet: Fleet) -> None:
    code, text = fetched(f"{fleet.gateway.status}/metrics")
    assert code == 200
    assert 'envoy_cluster_upstream_rq_total{envoy_cluster_name="by_scene"}' in text
    for path, method in (("/quitquitquit", "POST"), ("/metrics", "POST"), ("/config_dump", "GET"), ("/", "GET")):
        assert fetched(fleet.gateway.status + path, method)[0] == 404
    assert fleet.client.is_serving()
