"""A disk that is full, read-only, slow or damaged; two servers on one file; a scene that is deleted while it is asked.

What can be answered is answered, what cannot says why, and everything works again without a restart when the fault is
gone.
"""

import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from sqlalchemy import Connection
from support.commands import run_client
from support.disks import fail, failing_disk, mount, small_disk
from support.images import encode
from support.servers import CAMERA, PHOTO, StandInMethod, pose, serving
from support.stores import lose_page_with
from support.waiting import wait_until

from mapless import (
    Client,
    ConnectOptions,
    DataLoss,
    DeadlineExceeded,
    LocalizationResult,
    MaplessError,
    NewReference,
    NotFound,
    Rejected,
    Unavailable,
)
from mapless.geometry import Camera
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.judge.answer import Answer
from mapless_server.serve import running
from mapless_server.serve.running import watch_store
from mapless_server.services.handlers import SERVICE_NAMES
from mapless_server.store import Store, StoreError, deletion
from mapless_server.store.folder_lock import LOCK_FILE
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
    """Of the server, of LocalizationService, and of ReferenceService."""
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


class TestDisk:
    def test_a_full_disk_costs_changes_only_until_there_is_room(self, tmp_path: Path) -> None:
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

    def test_a_scene_is_deleted_in_the_room_of_one_reference(self, tmp_path: Path) -> None:
        def leave(room_bytes: int) -> None:
            free = os.statvfs(disk)
            (disk / "filler").write_bytes(bytes(free.f_bavail * free.f_frsize - room_bytes))

        def count_left() -> int:
            with closing(SqliteDatabase.open_as_is(disk / "data" / DATABASE_FILE)) as database, database.read() as left:
                return int(left.exec_driver_sql("SELECT count(*) FROM reference").scalar_one())

        with small_disk(tmp_path / "disk", 32) as disk:
            with served(disk / "data") as client:
                for scene in ("s", "t"):
                    client.create_scene(scene)
                    client.add_references(scene, [large(i) for i in range(20)])
            with served(disk / "data") as client:
                leave(600_000)
                client.delete_scene("s")
                assert count_left() == 20
                (disk / "filler").unlink()
            with served(disk / "data") as client:
                (disk / "data" / RESERVE_FILE).unlink()
                leave(150_000)
                error = error_of(lambda: client.delete_scene("t"))
                assert (error and error.code, error and error.reason) == ("RESOURCE_EXHAUSTED", "STORE_FULL")
                with pytest.raises(NotFound):
                    client.get_scene("t")
                assert count_left() > 0
                (disk / "filler").unlink()
                wait_until(lambda: count_left() == 0)
            assert large_photo(7)[1000:1016] not in (disk / "data" / DATABASE_FILE).read_bytes()

    def test_what_fills_the_disk_can_be_deleted(self, tmp_path: Path) -> None:
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

    def test_a_disk_full_from_the_start_serves_queries(self, tmp_path: Path) -> None:
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

    def test_a_disk_read_only_from_the_start_serves_queries(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        with small_disk(tmp_path / "disk", 16) as disk:
            with served(disk / "data") as client:
                fill(client)
            assert mount("-o", "remount,ro", str(disk)) == 0
            with served(disk / "data") as client, served(disk / "data") as other:
                for each in (client, other):
                    self.serves_queries_alone(each)
                code, printed, _ = run_client(capsys, "--address", client.address, "health")
            assert (code, json.loads(printed)["ReferenceService"]) == (0, "NOT_SERVING")
            assert mount("-o", "remount,rw", str(disk)) == 0
            with served(disk / "data") as client:
                client.create_scene("t")
                assert health_of(client) == (True, True, True)

    def serves_queries_alone(self, client: HealthClient) -> None:
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

    def test_a_read_only_store_not_closed_in_order_is_refused(self, tmp_path: Path) -> None:
        with small_disk(tmp_path / "disk", 16) as disk:
            with served(disk / "data") as client:
                fill(client, 1)
            (disk / "data" / f"{DATABASE_FILE}-wal").write_bytes(b"what was acknowledged last")
            assert mount("-o", "remount,ro", str(disk)) == 0
            with pytest.raises(StoreError, match="not closed in order"), served(disk / "data"):
                pass

    @pytest.mark.nightly
    def test_a_disk_that_fails_meanwhile_leaves_what_can_be_served(self, tmp_path: Path) -> None:
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

    def test_a_slow_disk_delays_no_answer_from_memory(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


class TestDamagedPages:
    def damage(self, folder: Path) -> None:
        """In the middle of the photograph of r1."""
        lose_page_with(folder / DATABASE_FILE, large_photo(1)[100_000:100_016])

    def test_a_bad_sector_costs_the_reference_stored_there(self, tmp_path: Path) -> None:
        with served(tmp_path) as client:
            fill(client)
        self.damage(tmp_path)
        assert any("'r1': image" in fault for fault in faults_of(tmp_path))
        assert not any("'r0'" in fault or "'r2'" in fault for fault in faults_of(tmp_path))
        with served(tmp_path) as client:
            with pytest.raises(DataLoss, match="'r1' is damaged") as caught:
                client.get_reference("s", "r1", include_image=True)
            assert caught.value.code == "DATA_LOSS"
            for other in ("r0", "r2"):
                assert len(client.get_reference("s", other, include_image=True).image or b"") > 100_000
                assert is_answered(client, other, "r1")
            assert is_answered(client)
            client.delete_reference("s", "r1")
            client.add_reference("s", large(1))
            assert client.get_reference("s", "r1", include_image=True).image == large_photo(1)
            assert client.get_scene("s").reference_count == 3
            assert is_answered(client)
        assert not any("reference" in fault for fault in faults_of(tmp_path))

    def test_bad_sectors_of_the_schema_stop_the_start_with_advice(self, tmp_path: Path) -> None:
        with served(tmp_path) as client:
            fill(client, 1)
        with (tmp_path / DATABASE_FILE).open("r+b") as file:
            file.seek(100)
            file.write(bytes(range(256)) * 15)
        with pytest.raises(StoreError, match=r"malformed; restore a backup into a new folder$"), served(tmp_path):
            pass


class TestTwoServers:
    """On one SQLite file, whatever it is called."""

    def opened_by_another(self, *folders: Path) -> list[str]:
        """The error of a process that opens the store in each folder."""
        code = """if True:
            import sys
            from pathlib import Path
            from mapless_server.store import Store, StoreError
            for folder in sys.argv[1:]:
                try:
                    Store.open(Path(folder))
                except StoreError as error:
                    print(error)
        """
        command = [sys.executable, "-c", code, *map(str, folders)]
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout.splitlines()

    def test_a_second_server_is_refused_until_the_first_has_gone(self, tmp_path: Path) -> None:
        data = tmp_path / "data"
        link, soft, hard = (tmp_path / name for name in ("link", "soft", "hard"))
        link.symlink_to(data)
        relative = Path(os.path.relpath(data))
        with served(data):
            for folder in (soft, hard):
                folder.mkdir()
            (soft / DATABASE_FILE).symlink_to(data / DATABASE_FILE)
            os.link(data / DATABASE_FILE, hard / DATABASE_FILE)
            *by_folder, by_soft, by_hard = self.opened_by_another(data, link, relative, soft, hard)
            assert all(f"in use by another server (process {os.getpid()})" in error for error in by_folder)
            assert all("in use by another server, under another name" in error for error in (by_soft, by_hard))
            # The lock of the folder is deleted: that of the file is still there.
            (data / LOCK_FILE).unlink()
            (error,) = self.opened_by_another(data)
            assert "in use by another server" in error
        Store.open(data).close()


class TestScenesThatGo:
    @pytest.mark.nightly
    def test_a_scene_made_anew_during_calls_gives_no_mixed_answer(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The n-th scene of this name has all its references, whose names are always the same, at x = n."""
        life, lives, stop = [0], 12, threading.Event()
        together: set[frozenset[float]] = set()
        real_call = StandInMethod.__call__

        def call(method: StandInMethod, query: View, references: Sequence[PosedView], *more: Any) -> Answer:
            together.add(frozenset(float(it.world_from_camera.translation[0]) for it in references))
            return real_call(method, query, references, *more)

        monkeypatch.setattr(StandInMethod, "__call__", call)

        def make(client: Client) -> None:
            client.create_scene("s")
            added = [NewReference(f"r{i}", PHOTO, CAMERA, pose(float(life[0]))) for i in range(3)]
            client.add_references("s", added)

        def ask(address: str, asked: tuple[str, ...]) -> Iterator[str]:
            with Client(address, ONCE) as client:
                while not stop.is_set():
                    began = life[0]
                    try:
                        answer = client.localize(PHOTO, CAMERA, "s", asked)
                    except (NotFound, Unavailable) as error:
                        yield error.code
                        continue
                    if isinstance(answer, Rejected):  # between its creation and its references
                        yield str(answer.reason)
                        continue
                    assert began <= answer.world_from_camera.translation[0] <= life[0]
                    yield "OK"

        with serving(tmp_path, workers=2) as server, Client(server.address, ONCE) as client, ExitStack() as stack:
            make(client)
            pool = stack.enter_context(ThreadPoolExecutor(6))
            stack.callback(stop.set)
            kinds = [("r2", "r0"), ()] * 3
            asking = [pool.submit(list, ask(server.address, kind)) for kind in kinds]
            for number in range(1, lives):
                time.sleep(0.05)
                client.delete_scene("s")
                life[0] = number
                make(client)
            answers = server.method.call_count
            wait_until(lambda: server.method.call_count > answers + len(kinds))
            stop.set()
            seen = {code for it in asking for code in it.result(60)}
        assert "OK" in seen
        assert seen <= {"OK", "NOT_FOUND", "UNAVAILABLE", "NO_USABLE_REFERENCES"}
        assert all(len(it) == 1 for it in together), "references of several lives in one answer"
        assert len(together) > 1
