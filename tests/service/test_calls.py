"""Every call has a limit, a deadline, a request id, and errors with what the caller may know and no log."""

import logging
from collections.abc import Iterator
from concurrent import futures
from pathlib import Path
from typing import Any

import grpc
import pytest
from google.rpc import error_details_pb2, status_pb2
from grpc_health.v1 import health_pb2
from support.servers import CAMERA, PHOTO, RunningServer, Stubs, failure_of, localize_request, make_scene, pose, serving
from support.waiting import wait_until

from mapless import (
    Client,
    ConnectOptions,
    DeadlineExceeded,
    LocalizationResult,
    NewReference,
    Rejected,
    ResourceExhausted,
)
from mapless.requests import create_request
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1 import reference_service_pb2 as reference_pb
from mapless_server.services.handlers import SERVICE_NAMES


@pytest.fixture
def pool() -> Iterator[futures.ThreadPoolExecutor]:
    with futures.ThreadPoolExecutor(64) as threads:
        yield threads


def test_a_full_queue_refuses_with_a_retry_delay(tmp_path: Path, pool: futures.ThreadPoolExecutor) -> None:
    calls: list[futures.Future[LocalizationResult | Rejected]] = []

    def has_arrived() -> bool:
        return calls[-1].done() or server.engine.queue.job_count == len(calls)

    with (
        serving(tmp_path, max_queued_s=2.0) as server,
        Client(server.address, ConnectOptions(max_attempts=1)) as client,
        server.method.held(),
    ):
        scene = make_scene(client, count=3)
        while not calls or not calls[-1].done():
            calls.append(pool.submit(client.localize, PHOTO, CAMERA, scene))
            wait_until(has_arrived)
            assert len(calls) < 50
        refused = calls.pop().exception()
        assert isinstance(refused, ResourceExhausted)
        assert refused.reason == "QUEUE_FULL"
        assert refused.retry_after_s is not None
        assert 0 < refused.retry_after_s < 60
        assert server.value("mapless_admission_rejected_total") == 1
        # The loop is free meanwhile: what needs no thread is answered.
        assert client.is_serving()
        assert client.get_scene(scene).reference_count == 3
        assert len(calls) > 2
        server.method.gate.set()
        assert all(isinstance(it.result(30), LocalizationResult) for it in calls)
    wait_until(lambda: server.engine.queue.job_count == 0)


def test_a_cancelled_call_is_not_computed(
    server: RunningServer, client: Client, scene: str, stubs: Stubs, pool: futures.ThreadPoolExecutor
) -> None:
    before = server.method.call_count
    with server.method.held():
        running = [pool.submit(client.localize, PHOTO, CAMERA, scene) for _ in range(2)]
        wait_until(lambda: server.method.call_count == before + 2)
        expires = pool.submit(client.localize, PHOTO, CAMERA, scene, timeout_s=2.0)
        cancelled = stubs.localization.Localize.future(localize_request(scene))
        wait_until(lambda: server.engine.queue.job_count == 4)
        with pytest.raises(DeadlineExceeded):
            expires.result(30)
        cancelled.cancel()
        wait_until(lambda: server.engine.queue.job_count == 2)
    for future in running:
        future.result(30)
    client.localize(PHOTO, CAMERA, scene)
    assert server.method.call_count == before + 3


@pytest.mark.parametrize("given", ["robot-7.frame_12", "x" * 64])
def test_a_request_id_is_taken_over(stubs: Stubs, scene: str, given: str) -> None:
    response, call = stubs.localization.Localize.with_call(
        localize_request(scene), metadata=[("x-request-id", given)], timeout=30
    )
    assert response.diagnostics.request_id == given
    assert dict(call.trailing_metadata())["x-request-id"] == given
    error = failure_of(stubs.localization.Localize, pb.LocalizeRequest(), metadata=[("x-request-id", given)])
    assert error.request_id == given


def test_a_message_over_the_limit(server: RunningServer, stubs: Stubs, client: Client, scene: str) -> None:
    request = localize_request(scene)
    request.image = bytes(33 * 2**20)
    assert failure_of(stubs.localization.Localize, request).code == "RESOURCE_EXHAUSTED"
    small = Client(server.address, ConnectOptions(max_message_mib=1, batch_mib=1))
    with small, pytest.raises(ResourceExhausted):
        small.localize(bytes(2 * 2**20), CAMERA, scene)
    client.localize(PHOTO, CAMERA, scene)


def details_of(call: Any, request: Any, request_id: str = "r-1") -> dict[str, Any]:
    """The details of the error that a call fails with, by their type."""
    with pytest.raises(grpc.RpcError) as caught:
        call(request, timeout=20, metadata=[("x-request-id", request_id)])
    failure: Any = caught.value
    status = status_pb2.Status.FromString(dict(failure.trailing_metadata())["grpc-status-details-bin"])
    kinds: Any = error_details_pb2
    found = {}
    for packed in status.details:
        detail = getattr(kinds, packed.type_url.rpartition(".")[2])()
        assert packed.Unpack(detail)
        found[type(detail).__name__] = detail
    return found


def test_what_is_missing_or_taken_is_named_as_a_resource(client: Client, stubs: Stubs, scene: str) -> None:
    reference = NewReference("taken", PHOTO, CAMERA, pose(0.0))
    client.add_reference(scene, reference)
    scene_kind, reference_kind = "mapless.v1.Scene", "mapless.v1.Reference"
    lost, taken = f"scenes/{scene}/references/lost", f"scenes/{scene}/references/taken"
    naming = localize_request(scene)
    naming.references.append(lost)
    calls: list[tuple[Any, Any, str, str]] = [
        (stubs.references.GetScene, reference_pb.GetSceneRequest(name="scenes/nowhere"), scene_kind, "scenes/nowhere"),
        (stubs.localization.Localize, localize_request("nowhere"), scene_kind, "scenes/nowhere"),
        (stubs.references.CreateScene, reference_pb.CreateSceneRequest(scene_id=scene), scene_kind, f"scenes/{scene}"),
        (stubs.references.GetReference, reference_pb.GetReferenceRequest(name=lost), reference_kind, lost),
        (stubs.localization.Localize, naming, reference_kind, lost),
        (stubs.references.CreateReference, create_request(f"scenes/{scene}", reference), reference_kind, taken),
    ]
    for call, request, kind, name in calls:
        found = details_of(call, request)["ResourceInfo"]
        assert (found.resource_type, found.resource_name) == (kind, name)
        assert found.description


def test_health_lists_all_services(server: RunningServer) -> None:
    with grpc.insecure_channel(server.address) as channel:
        call = channel.unary_unary(
            "/grpc.health.v1.Health/List", response_deserializer=health_pb2.HealthListResponse.FromString
        )
        listed = call(b"", timeout=20)
    assert set(listed.statuses) == {"", *SERVICE_NAMES}
    assert {it.status for it in listed.statuses.values()} == {health_pb2.HealthCheckResponse.SERVING}


@pytest.fixture(scope="module")
def strict(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    """A server whose messages have at most two MiB."""
    with serving(tmp_path_factory.mktemp("strict"), max_image_mib=1, max_message_mib=2) as running:
        yield running


@pytest.mark.parametrize(
    "method",
    [
        "mapless.v1.LocalizationService/Localize",
        "mapless.v1.LocalizationService/LocalizeProgressively",
        "grpc.health.v1.Health/Check",
        "grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
        "grpc.health.v1.Health/List",
        "grpc.health.v1.Health/Nothing",
    ],
)
def test_no_message_puts_a_stack_trace_into_the_log(
    strict: RunningServer, method: str, caplog: pytest.LogCaptureFixture
) -> None:
    """3 MiB of zeros are 3 KB as gzip; grpc rejects them when it has inflated them, while the handler waits."""
    caplog.set_level(logging.INFO)
    with grpc.insecure_channel(strict.address) as channel:
        call = channel.stream_stream(f"/{method}")
        for _ in range(3):  # grpc's status and the handler's race
            with pytest.raises(grpc.RpcError) as caught:
                list(call(iter([bytes(3 * 2**20)]), timeout=20, compression=grpc.Compression.Gzip))
            failure: Any = caught.value
            assert failure.code() in (grpc.StatusCode.RESOURCE_EXHAUSTED, grpc.StatusCode.UNIMPLEMENTED)
    # The server writes in another thread, but before the next call has its answer.
    with grpc.insecure_channel(strict.address) as channel:
        channel.unary_unary("/grpc.health.v1.Health/Check")(b"", timeout=20)
    assert [record.getMessage() for record in caplog.records if record.exc_info] == []
