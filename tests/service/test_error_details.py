"""Details of errors for other clients, and what strangers cannot make a server write into its log."""

import logging
from typing import Any

import grpc
import pytest
from google.rpc import error_details_pb2, status_pb2
from grpc_health.v1 import health_pb2
from support.servers import CAMERA, PHOTO, RunningServer, Stubs, localize_request, pose

from mapless import Client, NewReference
from mapless.requests import create_request
from mapless.v1 import reference_service_pb2 as pb
from mapless_server.services.handlers import SERVICE_NAMES


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
        (stubs.references.GetScene, pb.GetSceneRequest(name="scenes/nowhere"), scene_kind, "scenes/nowhere"),
        (stubs.localization.Localize, localize_request("nowhere"), scene_kind, "scenes/nowhere"),
        (stubs.references.CreateScene, pb.CreateSceneRequest(scene_id=scene), scene_kind, f"scenes/{scene}"),
        (stubs.references.GetReference, pb.GetReferenceRequest(name=lost), reference_kind, lost),
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
    server: RunningServer, method: str, caplog: pytest.LogCaptureFixture
) -> None:
    """33 MiB of zeros are 33 KB as gzip; grpc rejects them when it has inflated them, while the handler waits."""
    caplog.set_level(logging.INFO)
    with grpc.insecure_channel(server.address, options=[("grpc.max_send_message_length", 2**27)]) as channel:
        call = channel.stream_stream(f"/{method}")
        for _ in range(3):  # grpc's status and the handler's race
            with pytest.raises(grpc.RpcError) as caught:
                list(call(iter([bytes(33 * 2**20)]), timeout=20, compression=grpc.Compression.Gzip))
            failure: Any = caught.value
            assert failure.code() in (grpc.StatusCode.RESOURCE_EXHAUSTED, grpc.StatusCode.UNIMPLEMENTED)
    # The server writes in another thread, but before the next call has its answer.
    with grpc.insecure_channel(server.address) as channel:
        channel.unary_unary("/grpc.health.v1.Health/Check")(b"", timeout=20)
    assert [record.getMessage() for record in caplog.records if record.exc_info] == []
