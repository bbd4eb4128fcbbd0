"""The Ray adapter without a cluster: methods on Serve's gRPC server, checks, and the sample configuration."""

import asyncio
import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

pytest.importorskip("ray.serve", reason="needs Ray Serve: the extra `ray`")

from ray.serve._private.constants import SERVE_LOGGER_NAME
from ray.serve._private.grpc_util import gRPCGenericServer

from mapless.errors import from_rpc_error
from mapless_ray import ingress, replica
from mapless_ray.environment import check_environment, variables
from mapless_ray.ingress import Ingress, add_services
from mapless_server.observability.metrics import Metrics
from mapless_server.serve.startup import StartupError
from mapless_server.services.handlers import SERVICE_NAMES, Services
from mapless_server.settings import Settings
from mapless_server.store import Store

RAY = Path(__file__).parents[2] / "deploy" / "ray"


def no_way_of_serves(**_: Any) -> Any:
    """Serve's own handlers, which must not be asked for."""
    raise AssertionError(SERVE_LOGGER_NAME)


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path)


@pytest.fixture(autouse=True)
def _no_replica() -> Iterator[None]:
    yield
    Ingress.current = None


async def called(server: Any, method: str) -> Any:
    """How a call ends that sends nothing."""
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    try:
        async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
            ask: Any = channel.unary_unary(method)
            with pytest.raises(grpc.aio.AioRpcError) as caught:
                await ask(b"", timeout=20)
            return from_rpc_error(caught.value)
    finally:
        await server.stop(0)


@pytest.mark.parametrize("service", SERVICE_NAMES)
def test_without_a_replica_every_method_is_unavailable(service: str) -> None:
    (found,) = [it for it in ingress._SERVICES if it.full_name == service]

    async def run() -> list[Any]:
        ended = []
        for method in found.methods:
            server: Any = gRPCGenericServer(no_way_of_serves)
            add_services(None, server)
            ended.append(await called(server, f"/{service}/{method.name}"))
        return ended

    for error in asyncio.run(run()):
        assert (error.code, error.reason, error.retry_after_s) == ("UNAVAILABLE", "STARTING", 1.0)


@pytest.mark.parametrize("service", ["", *SERVICE_NAMES])
def test_without_a_replica_health_is_not_serving(service: str) -> None:
    async def run() -> Any:
        server: Any = gRPCGenericServer(no_way_of_serves)
        add_services(None, server)
        port = server.add_insecure_port("127.0.0.1:0")
        await server.start()
        async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
            stub: Any = health_pb2_grpc.HealthStub(channel)
            answer = await stub.Check(health_pb2.HealthCheckRequest(service=service), timeout=20)
        await server.stop(0)
        return answer.status

    assert asyncio.run(run()) == health_pb2.HealthCheckResponse.NOT_SERVING


def test_a_replicas_handlers_are_those_of_the_plain_server(settings: Settings) -> None:
    """None is replaced by Serve's, and an error has the reason and the id that ours have."""

    async def run() -> Any:
        store = Store.open(settings.data_dir)
        services = Services(settings, store, Metrics())
        listener = Ingress(settings, services, None)
        await listener.start()
        server: Any = gRPCGenericServer(no_way_of_serves)
        add_services(None, server)
        registered = {it for (handlers,) in server.generic_rpc_handlers for it in handlers._method_handlers}
        assert registered == {f"/{name}/{it}" for name, methods in services.handlers.items() for it in methods}
        error = await called(server, f"/{SERVICE_NAMES[0]}/Localize")
        await listener.close()
        await services.close()
        store.close()
        return error

    error = asyncio.run(run())
    assert (error.code, error.reason) == ("UNAVAILABLE", "STARTING")
    assert error.request_id


async def test_a_server_that_serve_stops_is_drained_first(settings: Settings) -> None:
    events: list[Any] = []

    class Stopped:
        async def drain(self, delay_s: float, grace_s: float) -> None:
            events.append(("drained", delay_s, grace_s))

    async def stop(grace_s: float | None) -> None:
        events.append("stopped")

    await Ingress(settings, Stopped(), None).drained(stop)(7.0)  # type: ignore[arg-type]
    assert events == [("drained", 0.0, 7.0), "stopped"]


async def test_tls_is_rejected_behind_serve(settings: Settings) -> None:
    with pytest.raises(StartupError, match="tls_certificate"):
        Ingress(settings, None, grpc.ssl_server_credentials([(b"", b"")]))  # type: ignore[arg-type]


# The environment


@pytest.mark.parametrize(
    "name",
    ["RAY_SERVE_ENABLE_HA_PROXY", "RAY_SERVE_RUN_USER_CODE_IN_SEPARATE_THREAD", "RAY_SERVE_GRPC_MAX_MESSAGE_SIZE"],
)
def test_a_variable_that_is_missing_or_wrong_is_named(settings: Settings, name: str) -> None:
    good = variables(settings.max_message_mib)
    check_environment(settings, good)
    for bad in ({it: good[it] for it in good if it != name}, good | {name: "17"}):
        with pytest.raises(StartupError, match=f"{name}={good[name]}"):
            check_environment(settings, bad)


def test_the_limit_of_messages_is_that_of_the_settings(tmp_path: Path) -> None:
    larger = Settings(data_dir=tmp_path, max_message_mib=64)
    check_environment(larger, variables(64))
    with pytest.raises(StartupError, match="RAY_SERVE_GRPC_MAX_MESSAGE_SIZE"):
        check_environment(larger, variables())


def test_each_replica_of_a_machine_has_its_own_metrics_port(settings: Settings) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        first = taken.getsockname()[1]
        wanted = settings.model_copy(update={"metrics_port": first})
        claims = [replica.claim_metrics_port(wanted) for _ in range(2)]
        ports = [port for port, _ in claims]
        assert len({first, *ports}) == 3
        assert all(first < port < first + replica.METRICS_PORTS for port in ports)
        for _, claim in claims:
            assert claim is not None
            claim.close()
        assert replica.claim_metrics_port(wanted)[0] == ports[0]


def test_a_shell_takes_the_environment_as_it_is_printed() -> None:
    show = f'eval "$({sys.executable} -m mapless_ray.environment)"; exec {sys.executable} -c "{_SHOW}"'
    shown = subprocess.run(["sh", "-c", show], check=True, capture_output=True, text=True, timeout=60).stdout
    assert variables().items() <= json.loads(shown).items()


_SHOW = "import json, os; print(json.dumps(dict(os.environ)))"


def test_the_readme_names_every_variable() -> None:
    text = (RAY / "README.md").read_text()
    assert [name for name in variables() if f"`{name}`" not in text] == []
