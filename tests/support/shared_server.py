"""A server shared by the tests of a module: fixtures, which the conftest of a folder imports."""

import time
from collections.abc import Iterator

import grpc
import pytest

from mapless import Client
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless.v1.reference_service_pb2_grpc import ReferenceServiceStub
from support.servers import RunningServer, Stubs, make_scene, serving


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    with serving(tmp_path_factory.mktemp("data")) as running:
        yield running


@pytest.fixture(scope="module")
def stubs(server: RunningServer) -> Iterator[Stubs]:
    with grpc.insecure_channel(server.address, [("grpc.max_send_message_length", 64 * 2**20)]) as channel:
        yield Stubs(LocalizationServiceStub(channel), ReferenceServiceStub(channel))


@pytest.fixture(scope="module")
def client(server: RunningServer) -> Iterator[Client]:
    with Client(server.address) as connected:
        yield connected


@pytest.fixture
def scene(client: Client) -> Iterator[str]:
    """A scene of three references, at x = 0, 1 and 2 m."""
    scene_id = f"scene-{time.monotonic_ns()}"
    make_scene(client, scene_id, 3)
    yield scene_id
    client.delete_scene(scene_id)
