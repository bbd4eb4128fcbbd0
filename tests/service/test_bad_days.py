"""A disk that is full, read-only, slow, or fails.

What can be answered is answered, what cannot says why, and everything works again without a restart when the fault is
gone.
"""

import json
import shutil
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path

import grpc
import numpy as np
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from sqlalchemy import Connection
from support.commands import run_client
from support.disks import fail, failing_disk, mount, small_disk
from support.images import encode
from support.servers import CAMERA, PHOTO, pose, serving
from support.waiting import wait_until

from mapless import (
    Client,
    ConnectOptions,
    DeadlineExceeded,
    LocalizationResult,
    MaplessError,
    NewReference,
)
from mapless.geometry import Camera
from mapless_server.serve import running
from mapless_server.serve.running import watch_store
from mapless_server.services.handlers import SERVICE_NAMES
from mapless_server.store import StoreError, deletion
from mapless_server.store.reserve import RESERVE_FILE
from mapless_server.store.sqlite import DATABASE_FILE, SqliteDatabase
from mapless_server.store.verification import verify

ONCE = ConnectOptions(max_attempts=1, timeout_s=30)
LARGE = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)


def large_photo(seed: int) -> bytes:
    """Some 230 kB, which lie on many pages."""
    return encode(".png", np.random.default_rng(seed).integers(0, 256, (240, 320, 3)).astype(np.uint8))


def large(i: int) -> NewReference:
    return NewReference(f"r{i}", large_photo(i), LARGE, pose(i))


def error_of(call: Callable[[], object]) -> MaplessError | None:
    try:
        call()
    except MaplessError as error:
        return error
    return None


class HealthClient(Client):
    """One that also knows where its server is."""

    def __init__(self, address: str) -> None:
        super().__init__(address, ONCE)
        self.address = address


def health_of(client: HealthClient) -> tuple[bool, ...]:
    """Health of the server, of LocalizationService, and of ReferenceService."""
    with grpc.insecure_channel(client.address) as channel:
        check = health_pb2_grpc.HealthStub(channel).Check
        answers = [check(health_pb2.HealthCheckRequest(service=name), timeout=30) for name in ("", *SERVICE_NAMES)]
    return tuple(it.status == health_pb2.HealthCheckResponse.SERVING for it in answers)


@pytest.fixture(autouse=True)
def looks_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """At its store, the server; and whether there is room to delete."""
    monkeypatch.setattr(running, "watch_store", partial(watch_store, interval_s=0.02))
    monkeypatch.setattr(deletion, "AGAIN_S", 0.02)


@contextmanager
def served(folder: Path) -> Iterator[HealthClient]:
    with serving(folder) as server:
        client = HealthClient(server.address)
        with client:
            yield client


def fill(client: Client, count: int = 3) -> None:
    client.create_scene("s")
    for i in range(count):
        client.add_reference("s", large(i))


def is_answered(client: Client, *references: str) -> bool:
    return isinstance(client.localize(PHOTO, CAMERA, "s", references), LocalizationResult)


def fill_up(disk: Path) -> None:
    """To the last byte."""
    with (disk / "filler").open("ab", buffering=0) as filler:
        for size in (2**16, 1):
            with suppress(OSError):
                while True:
                    filler.write(bytes(size))


def faults_of(folder: Path) -> tuple[str, ...]:
    with closing(SqliteDatabase.open_as_is(folder / DATABASE_FILE)) as database, database.read() as connection:
        return verify(connection).faults


def test_a_full_disk_costs_changes_only_until_there_is_room(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 4) as disk:
        with served(disk / "data") as client:
            fill(client, 1)
            stored = {"r0"}
            for i in range(1, 60):
                error = error_of(partial(client.add_reference, "s", large(i)))
                if error is not None:
                    break
                stored.add(f"r{i}")
            assert error is not None
            assert (error.code, error.reason, error.retry_after_s) == ("RESOURCE_EXHAUSTED", "STORE_FULL", None)
            assert len(stored) > 3
            assert is_answered(client, "r0")
            assert is_answered(client)
            assert client.get_reference("s", "r0", include_image=True).image == large_photo(0)
            assert health_of(client)[:2] == (True, True)
            assert mount("-o", "remount,size=40m", str(disk)) == 0
            client.add_reference("s", NewReference("late", large_photo(99), LARGE, pose(9)))
            wait_until(lambda: health_of(client) == (True, True, True))
            assert {it.reference_id for it in client.list_references("s")} == stored | {"late"}
        assert faults_of(disk / "data") == ()


def test_what_fills_the_disk_can_be_deleted(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 72) as disk, served(disk / "data") as client:
        (disk / "filler").write_bytes(bytes(56 * 2**20))
        fill(client, 1)
        for i in range(1, 60):
            if error_of(partial(client.add_reference, "s", large(i))) is not None:
                break
        fill_up(disk)
        for it in [it.reference_id for it in client.list_references("s")][1:]:
            client.delete_reference("s", it)
        client.delete_scene("s")
        client.create_scene("t")
        client.add_reference("t", large(0))
        assert client.get_reference("t", "r0", include_image=True).image == large_photo(0)


def test_a_disk_full_from_the_start_serves_queries(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 8) as disk:
        with served(disk / "stopped") as client:
            fill(client, 2)
            # What lies there while it runs is what a kill leaves behind.
            shutil.copytree(disk / "stopped", disk / "killed")
        fill_up(disk)
        with served(disk / "stopped") as client:
            assert is_answered(client)
        (disk / "stopped" / RESERVE_FILE).unlink()
        fill_up(disk)
        with pytest.raises(StoreError, match=r"the disk is full$"), served(disk / "stopped"):
            pass
        with served(disk / "killed") as client:
            wait_until(lambda: health_of(client) == (True, True, False))
            assert is_answered(client)
            error = error_of(lambda: client.create_scene("t"))
            assert (error and error.code, error and error.reason) == ("RESOURCE_EXHAUSTED", "STORE_FULL")
            (disk / "filler").unlink()
            wait_until(lambda: health_of(client) == (True, True, True))
            client.create_scene("t")


def test_a_disk_read_only_from_the_start_serves_queries(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with small_disk(tmp_path / "disk", 16) as disk:
        with served(disk / "data") as client:
            fill(client)
        assert mount("-o", "remount,ro", str(disk)) == 0
        with served(disk / "data") as client, served(disk / "data") as other:
            for each in (client, other):
                serves_queries_alone(each)
            code, printed, _ = run_client(capsys, "--address", client.address, "health")
        assert (code, json.loads(printed)["ReferenceService"]) == (0, "NOT_SERVING")
        assert mount("-o", "remount,rw", str(disk)) == 0
        with served(disk / "data") as client:
            client.create_scene("t")
            assert health_of(client) == (True, True, True)


def serves_queries_alone(client: HealthClient) -> None:
    assert is_answered(client)
    assert is_answered(client, "r1", "r2")
    assert client.get_reference("s", "r0", include_image=True).image == large_photo(0)
    wait_until(lambda: health_of(client) == (True, True, False))
    for change in (
        lambda: client.create_scene("t"),
        lambda: client.delete_reference("s", "r0"),
        lambda: client.add_reference("s", large(9)),
    ):
        error = error_of(change)
        assert error is not None
        assert (error.code, error.reason) == ("FAILED_PRECONDITION", "STORE_READ_ONLY")


@pytest.mark.nightly
def test_a_disk_that_fails_meanwhile_leaves_what_can_be_served(tmp_path: Path) -> None:
    with failing_disk(tmp_path / "disk", 32) as disk, served(disk / "data") as client:
        fill(client)
        fail(disk)
        error = error_of(lambda: client.create_scene("t"))
        assert error is not None
        assert (error.code, error.reason) == ("UNAVAILABLE", "STORE_UNAVAILABLE")
        assert error.retry_after_s is not None
        wait_until(lambda: health_of(client) == (True, True, False))
        assert is_answered(client, "r1", "r2")
        assert is_answered(client)
        assert client.get_reference("s", "r0", include_image=True).image == large_photo(0)


def test_a_slow_disk_delays_no_answer_from_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    slow, meets, goes_on = (threading.Event() for _ in range(3))
    real_read = SqliteDatabase.read

    @contextmanager
    def read(database: SqliteDatabase) -> Iterator[Connection]:
        if slow.is_set():
            meets.set()
            assert goes_on.wait(30)
        with real_read(database) as connection:
            yield connection

    monkeypatch.setattr(SqliteDatabase, "read", read)
    with served(tmp_path) as client, ThreadPoolExecutor(4) as pool:
        fill(client)
        assert is_answered(client, "r0", "r1")
        slow.set()
        listed = [pool.submit(lambda: list(client.list_references("s"))) for _ in range(2)]
        late = pool.submit(error_of, lambda: client.get_scene("s", timeout_s=0.5))
        assert meets.wait(30)
        assert client.is_serving()
        assert is_answered(client, "r0", "r1")
        assert not any(it.done() for it in listed), "what is in memory waited for the disk"
        assert isinstance(late.result(30), DeadlineExceeded)
        goes_on.set()
        assert [len(it.result(60)) for it in listed] == [3, 3]
