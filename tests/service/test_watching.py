"""WatchQueries through a real server: events, permission, and how a stream ends."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import pytest
from support.servers import CAMERA, PHOTO, RunningServer, ending, localize_request, pose, serving

from mapless import Client, NewReference
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub

LIMIT_S = 30.0
REQUEST = pb.WatchQueriesRequest(scene="scenes/hall")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    with serving(tmp_path_factory.mktemp("data"), allow_watching=True) as running:
        with Client(running.address) as client:
            fill(client, "hall")
            fill(client, "cellar")
        yield running


def fill(client: Client, scene: str) -> None:
    client.create_scene(scene)
    client.add_references(scene, [NewReference("r", PHOTO, CAMERA, pose(1.0))])


@pytest.fixture
def stub(server: RunningServer) -> Iterator[LocalizationServiceStub]:
    with grpc.insecure_channel(server.address) as channel:
        yield LocalizationServiceStub(channel)


def watching(stub: LocalizationServiceStub, scene: str = "hall", **arguments: Any) -> Any:
    """A watch that has begun: whatever is answered from now on is seen."""
    call = stub.WatchQueries(pb.WatchQueriesRequest(scene=f"scenes/{scene}"), timeout=LIMIT_S, **arguments)
    call.initial_metadata()
    return call


def test_confidential_calls_are_not_shown(stub: LocalizationServiceStub) -> None:
    seen = watching(stub)
    request = localize_request("hall")
    request.options.confidential = True
    stub.Localize(request, timeout=LIMIT_S, metadata=(("x-request-id", "secret"),))
    stub.Localize(localize_request("hall"), timeout=LIMIT_S, metadata=(("x-request-id", "open"),))
    assert next(seen).answer.diagnostics.request_id == "open"


def test_answers_of_the_watched_scene_alone_arrive_at_once(
    server: RunningServer, stub: LocalizationServiceStub
) -> None:
    seen = watching(stub)
    stub.Localize(localize_request("cellar"), timeout=LIMIT_S)
    own = stub.Localize(localize_request("hall"), timeout=LIMIT_S, metadata=(("x-request-id", "mine"),))
    message = next(seen)
    assert message.image == PHOTO
    assert message.intrinsics == localize_request("hall").intrinsics
    assert message.answer.localization == own.localization
    assert message.answer.diagnostics.request_id == "mine"
    assert not own.HasField("debug")
    seen.cancel()


def test_it_needs_to_be_allowed(tmp_path: Path) -> None:
    with serving(tmp_path) as closed, grpc.insecure_channel(closed.address) as channel:
        failure = ending(LocalizationServiceStub(channel).WatchQueries(REQUEST, timeout=LIMIT_S))
    assert (failure.code, failure.reason) == ("FAILED_PRECONDITION", "WATCHING_NOT_ALLOWED")
    assert failure.request_id


def test_a_scene_that_is_not_there_and_a_name_that_is_none(stub: LocalizationServiceStub) -> None:
    absent = ending(stub.WatchQueries(pb.WatchQueriesRequest(scene="scenes/absent"), timeout=LIMIT_S))
    assert (absent.code, absent.field) == ("NOT_FOUND", "scene")
    senseless = ending(stub.WatchQueries(pb.WatchQueriesRequest(scene="hall"), timeout=LIMIT_S))
    assert (senseless.code, senseless.field) == ("INVALID_ARGUMENT", "scene")


def test_the_end_of_the_server_ends_it_at_once(tmp_path: Path) -> None:
    with serving(tmp_path, allow_watching=True, drain_grace_s=60) as leaving:
        with Client(leaving.address) as client:
            fill(client, "hall")
        with grpc.insecure_channel(leaving.address) as channel:
            seen = watching(LocalizationServiceStub(channel))
            leaving.stop()
            failure = ending(seen)
    assert (failure.code, failure.reason) == ("UNAVAILABLE", "DRAINING")
