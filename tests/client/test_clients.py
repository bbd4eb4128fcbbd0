"""The blocking and the asynchronous client: the same tests with the same server."""

import asyncio
import inspect
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import grpc
import pytest
from support.clients import Connect, awaiting, failing, losing, status
from support.images import encode, textured
from support.servers import CAMERA, PHOTO, RunningServer, make_scene, pose, serving

import mapless
from mapless import (
    AlreadyExists,
    Client,
    ConnectOptions,
    InvalidArgument,
    LocalizationResult,
    NewReference,
    NotFound,
    Rejected,
    Unavailable,
    aio,
    shortcut,
)
from mapless.geodesy import Datum
from mapless.geometry import Quaternion
from mapless.v1 import localization_service_pb2 as localization_pb
from mapless.v1 import reference_service_pb2 as reference_pb
from mapless.v1 import reference_service_pb2_grpc as reference_rpcs

DATUM = Datum(47.0, 8.0, 400.0, Quaternion(0.1, -0.3, 0.3, 0.9))
FAST = ConnectOptions(initial_backoff_s=0.01, max_backoff_s=0.02)

both = pytest.mark.parametrize("connect", [Client, awaiting], ids=["blocking", "asyncio"])


def methods(kind: type) -> dict[str, inspect.Signature]:
    return {name: inspect.signature(it) for name, it in vars(kind).items() if callable(it) and name[0] != "_"}


def test_both_have_the_same_methods_with_the_same_parameters() -> None:
    blocking, asynchronous = methods(Client), methods(aio.Client)
    assert len(blocking) >= 15
    assert {name: [*it.parameters.values()] for name, it in blocking.items()} == {
        name: [*it.parameters.values()] for name, it in asynchronous.items() if name != "unblocked"
    }
    assert all(getattr(kind, name).__doc__ for kind in (Client, aio.Client) for name in blocking)
    assert {next(iter(it.parameters)) for it in (*blocking.values(), *asynchronous.values())} == {"self"}


def test_every_method_of_the_interface_is_there() -> None:
    """But for the feed of others' queries, which viewers read."""
    services = (
        localization_pb.DESCRIPTOR.services_by_name["LocalizationService"],
        reference_pb.DESCRIPTOR.services_by_name["ReferenceService"],
    )
    renamed = {"create_reference": "add_reference", "batch_create_references": "add_references"}
    for service in services:
        for method in service.methods:
            name = "".join(f"_{letter.lower()}" if letter.isupper() else letter for letter in method.name)[1:]
            if not method.server_streaming:
                assert renamed.get(name, name) in methods(Client), method.name


@both
def test_the_life_of_a_scene(server: RunningServer, connect: Connect, tmp_path: Path) -> None:
    path = tmp_path / "photo.png"
    path.write_bytes(PHOTO)
    name = f"life-{time.monotonic_ns()}"
    with connect(server.address) as client:
        assert client.is_serving()
        assert client.create_scene(name).reference_count == 0
        counts: list[int] = []
        stored = client.add_references(
            name, (NewReference(f"r{i}", path, CAMERA, pose(i)) for i in range(3)), on_progress=counts.append
        )
        assert ([it.reference_id for it in stored], counts[-1]) == (["r0", "r1", "r2"], 3)
        client.add_reference(name, NewReference("r3", PHOTO, CAMERA, pose(3)))
        assert client.get_scene(name).reference_count == 4
        assert [it.reference_id for it in client.list_references(name, page_size=3)] == ["r0", "r1", "r2", "r3"]
        assert name in [it.scene_id for it in client.list_scenes(page_size=1)]
        assert client.get_reference(name, "r1", include_image=True).image == PHOTO
        assert len(client.retrieve_references(path, CAMERA, name, 2)) == 2
        assert [it.name[-2:] for it in client.audit_scene(name, page_size=2)] == ["r0", "r1", "r2", "r3"]
        assert client.check_coverage(name, pose(0), CAMERA).verdict
        answer = client.localize(path, CAMERA, name, ["r2"])
        assert isinstance(answer, LocalizationResult)
        assert answer.world_from_camera.translation[0] == 2.0
        client.delete_reference(name, "r0")
        client.delete_scene(name)
        with pytest.raises(NotFound):
            client.get_scene(name)
        with pytest.raises(InvalidArgument) as caught:
            client.localize(b"no photograph", CAMERA, "s")
        assert caught.value.field == "image"
        assert isinstance(caught.value.__cause__, grpc.RpcError)
        with pytest.raises(FileNotFoundError):
            client.localize(tmp_path / "absent.jpg", CAMERA, name)
        with pytest.raises(ValueError, match="Variant must be one of"):
            client.localize(PHOTO, CAMERA, name, variant="worst")


@both
def test_a_change_whose_answer_was_lost_is_made_once(server: RunningServer, connect: Connect) -> None:
    scene = f"lost-{time.monotonic_ns()}"
    references = [NewReference(f"r{i}", PHOTO, CAMERA, pose(i)) for i in range(2)]
    changes: list[Callable[[Client], Any]] = [
        lambda client: client.create_scene(scene, datum=DATUM, down_in_world=-9.81 * DATUM.enu_from_world.matrix()[2]),
        lambda client: client.add_reference(scene, references[0]),
        lambda client: client.add_references(scene, references[1:]),
        lambda client: client.delete_reference(scene, "r0"),
        lambda client: client.delete_scene(scene),
    ]
    seen = []
    for change in changes:
        with losing(server.address) as (address, between), connect(address, FAST) as client:
            seen.append(change(client))
            assert len(between.tries) in (2, 3)
    assert [type(it).__name__ for it in seen] == ["Scene", "Reference", "list", "NoneType", "NoneType"]
    assert (seen[1].reference_id, seen[1].feature_count, [it.reference_id for it in seen[2]]) == ("r0", 1, ["r1"])


@both
def test_an_interrupted_upload_goes_on(server: RunningServer, connect: Connect, scene: str) -> None:
    wanted = [NewReference(f"n{i}", PHOTO, CAMERA, pose(i)) for i in range(5)]
    counts: list[int] = []
    with connect(server.address, ConnectOptions(batch_count=2)) as client:
        client.add_references(scene, wanted[:3])
        stored = client.add_references(scene, wanted, on_progress=counts.append)
        assert ([it.reference_id for it in stored], counts) == ([it.reference_id for it in wanted], [2, 4, 5])
        moved = replace(wanted[3], world_from_camera=pose(0.5))
        with pytest.raises(AlreadyExists, match="reference 'n3' exists already, with another pose"):
            client.add_references(scene, [*wanted[:3], moved])


def test_a_bulk_upload_is_cut_into_messages(server: RunningServer, client: Client, scene: str) -> None:
    photos = [encode(".png", textured(seed=i)) for i in range(7)]
    progress: list[int] = []
    options = ConnectOptions(batch_mib=2.5 * max(map(len, photos)) / 2**20, batch_count=3)
    with Client(server.address, options) as small:
        stored = small.add_references(
            scene,
            (NewReference(f"bulk{i}", photo, CAMERA, pose(i)) for i, photo in enumerate(photos)),
            on_progress=progress.append,
        )
    assert [reference.reference_id for reference in stored] == [f"bulk{i}" for i in range(7)]
    assert progress == [2, 4, 6, 7]
    assert client.get_reference(scene, "bulk6", include_image=True).image == photos[6]


def test_the_client_names_the_bad_reference_of_a_batch(server: RunningServer, scene: str) -> None:
    photos = [PHOTO, PHOTO, PHOTO, b"none"]
    references = [NewReference(f"p{i}", photo, CAMERA, pose(i)) for i, photo in enumerate(photos)]
    error_text = "IMAGE_UNKNOWN_FORMAT: reference 'p3': the image is not"
    two_by_two = ConnectOptions(batch_count=2)
    with Client(server.address, two_by_two) as client, pytest.raises(InvalidArgument, match=error_text):
        client.add_references(scene, references)


def test_closing_a_client_ends_its_pauses() -> None:
    with failing([status("UNAVAILABLE", 30.0)] * 9) as (address, server):
        client = Client(address, FAST)
        failed: list[BaseException] = []

        def call() -> None:
            try:
                client.localize(PHOTO, CAMERA, "s", timeout_s=120.0)
            except Unavailable as error:
                failed.append(error)

        thread = threading.Thread(target=call)
        thread.start()
        while len(server.tries) < 2:
            time.sleep(0.005)
        time.sleep(0.1)
        client.close()
        thread.join(20)
        assert [type(it) for it in failed] == [Unavailable]


async def test_a_cancelled_task_cancels_its_call(server: RunningServer, scene: str) -> None:
    async with aio.Client(server.address) as client:
        with server.method.held():
            task = asyncio.create_task(client.localize(PHOTO, CAMERA, scene))
            while server.engine.queue.job_count == 0:
                await asyncio.sleep(0.005)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            while server.engine.queue.job_count:
                await asyncio.sleep(0.005)


def test_calls_of_one_loop_run_at_the_same_time(server: RunningServer, scene: str) -> None:
    async def run() -> list[LocalizationResult | Rejected]:
        async with aio.Client(server.address) as client:
            with server.method.held():
                tasks = [asyncio.create_task(client.localize(PHOTO, CAMERA, scene)) for _ in range(2)]
                while server.engine.queue.job_count < 2:
                    await asyncio.sleep(0.005)
            return await asyncio.gather(*tasks)

    answers = asyncio.run(asyncio.wait_for(run(), 30))
    assert all(isinstance(answer, LocalizationResult) for answer in answers)


def test_the_asynchronous_client_needs_a_loop() -> None:
    with pytest.raises(RuntimeError, match="no running event loop"):
        aio.Client("localhost:1")


CALL = """
import mapless, sys
camera = mapless.Camera(96, 64, 80.0, 81.0, 47.5, 31.5)
for _ in range(2):
    answer = mapless.localize(sys.argv[1], camera)
    print(answer.world_from_camera.translation)
"""


@pytest.fixture
def photo(tmp_path: Path) -> str:
    (tmp_path / "photo.png").write_bytes(PHOTO)
    return str(tmp_path / "photo.png")


def test_one_line_is_enough(tmp_path: Path, photo: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(tmp_path / "data") as server, Client(server.address) as client:
        monkeypatch.setenv("MAPLESS_ADDRESS", server.address)
        with pytest.raises(NotFound, match="there is no scene"):
            mapless.localize(photo, CAMERA)
        make_scene(client, "hall", 2)
        near = mapless.Priors(position=mapless.PositionPrior(pose(0.0).translation, 50.0))
        assert isinstance(mapless.localize(photo, CAMERA, priors=near), LocalizationResult)
        client.create_scene("other")
        for scene in (None, "hall"):
            answer = mapless.localize(photo, CAMERA, scene)
            assert isinstance(answer, LocalizationResult)
            assert answer.scene == "scenes/hall"
        monkeypatch.setenv("MAPLESS_SCENE", "other")
        assert isinstance(mapless.localize(photo, CAMERA), Rejected)
        shortcut._close()


def test_one_connection_serves_all_calls_of_the_program(
    server: RunningServer, scene: str, photo: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(2):
        mapless.localize(PHOTO, CAMERA, scene, address=server.address)
    (made,) = shortcut._clients.values()
    mapless.localize(PHOTO, CAMERA, scene, address=server.address, options=ConnectOptions(timeout_s=20))
    assert len(shortcut._clients) == 2
    assert made in shortcut._clients.values()
    shortcut._close()
    monkeypatch.setenv("MAPLESS_ADDRESS", server.address)
    monkeypatch.setenv("MAPLESS_SCENE", scene)
    done = subprocess.run([sys.executable, "-c", CALL, photo], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[ 0.  2. -1.]\n" * 2
    assert done.stderr == ""


@both
def test_a_message_is_read_while_another_is_computed(connect: Connect) -> None:
    """Two messages at a time; references are returned in order."""
    begun = threading.Barrier(2, timeout=20)

    class Slow(reference_rpcs.ReferenceServiceServicer):
        def BatchCreateReferences(self, request: Any, context: Any) -> Any:  # noqa: N802
            begun.wait()
            answer = reference_pb.BatchCreateReferencesResponse()
            for it in request.requests:
                it.reference.name = f"{request.scene}/references/{it.reference_id}"
                answer.references.append(it.reference)
            return answer

    server = grpc.server(ThreadPoolExecutor(4))
    reference_rpcs.add_ReferenceServiceServicer_to_server(Slow(), server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    with connect(f"127.0.0.1:{port}", ConnectOptions(batch_count=1)) as client:
        wanted = [NewReference(f"n{i}", PHOTO, CAMERA, pose(i)) for i in range(4)]
        assert [it.reference_id for it in client.add_references("s", wanted)] == ["n0", "n1", "n2", "n3"]
    server.stop(None).wait()
