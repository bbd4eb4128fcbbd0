"""PostgreSQL is killed under load, or has no connection or no room left: callers are informed, nothing is lost."""

import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psycopg
import pytest
from support.disks import mount, small_disk
from support.images import encode
from support.postgres import Cluster, require
from support.servers import CAMERA, PHOTO, pose, serving
from support.waiting import wait_until

from mapless import AlreadyExists, Client, ConnectOptions, LocalizationResult, MaplessError, NewReference, Unavailable
from mapless.geometry import Camera
from mapless_server.store import Store

pytestmark = pytest.mark.nightly

ONCE = ConnectOptions(max_attempts=1, timeout_s=30)
SMALL_MIB = 72
PATIENT = ConnectOptions(max_attempts=8, initial_backoff_s=0.2, max_backoff_s=1.0)


@pytest.fixture
def database() -> Iterator[Cluster]:
    require()
    cluster = Cluster()
    try:
        yield cluster
    finally:
        cluster.remove()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGQUIT])
def test_killed_under_load_it_costs_retrying_callers_time_only(
    tmp_path: Path, database: Cluster, how: signal.Signals
) -> None:
    stop, acknowledged = threading.Event(), [list[str]() for _ in range(3)]

    def work(address: str, number: int) -> None:
        with Client(address, PATIENT) as client:
            while not stop.is_set():
                name = f"r-{number}-{len(acknowledged[number])}"
                with suppress(AlreadyExists):  # it was stored, and its answer was lost
                    client.add_reference("s", NewReference(name, PHOTO, CAMERA, pose(0)), timeout_s=60)
                acknowledged[number].append(name)
                assert isinstance(client.localize(PHOTO, CAMERA, "s", [name], timeout_s=60), LocalizationResult)

    def is_further_by(before: list[int]) -> bool:
        return all(len(it) >= n + 2 for it, n in zip(acknowledged, before, strict=True))

    with (
        serving(tmp_path, store=Store.connect(database.fresh_url())) as server,
        Client(server.address, ONCE) as client,
        ExitStack() as stack,
    ):
        client.create_scene("s")
        pool = stack.enter_context(ThreadPoolExecutor(3))
        stack.callback(stop.set)
        workers = [pool.submit(work, server.address, i) for i in range(3)]
        wait_until(lambda: is_further_by([0] * 3) or any(it.done() for it in workers))
        database.stop(how)
        for call in (lambda: client.get_scene("s"), lambda: client.localize(PHOTO, CAMERA, "s")):
            with pytest.raises(Unavailable) as caught:
                call()
            assert caught.value.reason == "STORE_UNAVAILABLE"
            assert caught.value.retry_after_s is not None
        assert client.is_serving()
        before = [len(it) for it in acknowledged]
        database.start()
        wait_until(lambda: is_further_by(before) or any(it.done() for it in workers))
        stop.set()
        for worker in workers:
            assert worker.exception(60) is None
        stored = {it.reference_id for it in client.list_references("s")}
    assert {name for names in acknowledged for name in names} <= stored


def test_without_a_free_connection_calls_may_be_retried(tmp_path: Path, database: Cluster) -> None:
    store = Store.connect(database.fresh_url())
    with serving(tmp_path, store=store) as server, Client(server.address, ONCE) as client, ExitStack() as stack:
        client.create_scene("s")
        greedy: list[psycopg.Connection[tuple[object, ...]]] = []

        def take_all() -> None:
            with suppress(psycopg.OperationalError):
                while True:
                    greedy.append(stack.enter_context(database.connect()))

        take_all()
        assert len(greedy) > 10
        assert client.get_scene("s").reference_count == 0, "the connections that it has are its own"
        end_ours = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name = 'mapless-server'"
        greedy[0].execute(end_ours)
        wait_until(lambda: not _ours_left(greedy[0]))
        take_all()
        with pytest.raises(Unavailable) as caught:
            client.get_scene("s")
        assert caught.value.reason == "STORE_UNAVAILABLE"
        assert caught.value.retry_after_s is not None
        for connection in greedy[:10]:
            connection.close()
        with Client(server.address, PATIENT) as patient:
            assert patient.get_scene("s", timeout_s=60).reference_count == 0


def test_without_room_for_its_tables_changes_alone_are_refused(tmp_path: Path) -> None:
    """With room again everything works, without any restart."""
    with _filled(tmp_path, lambda disk: Cluster(tables_on=disk)) as (client, database, stored, refusal):
        assert (refusal.code, refusal.reason, refusal.retry_after_s) == ("RESOURCE_EXHAUSTED", "STORE_FULL", None)
        assert isinstance(client.localize(PHOTO, CAMERA, "s", ["r0"]), LocalizationResult)
        assert client.get_reference("s", "r0", include_image=True).image == _large(0).image
        assert client.is_serving()
        database.make_room()
        stored.add(client.add_reference("s", _large(len(stored))).reference_id)
        assert {it.reference_id for it in client.list_references("s")} == stored


def test_a_full_log_disk_loses_nothing_acknowledged(tmp_path: Path) -> None:
    with _filled(tmp_path, lambda disk: Cluster(log_on=disk)) as (client, database, stored, refusal):
        assert refusal.reason in {"STORE_FULL", "STORE_UNAVAILABLE"}
        with pytest.raises(Unavailable) as caught:
            client.localize(PHOTO, CAMERA, "s", ["r0"])
        assert caught.value.reason == "STORE_UNAVAILABLE"
        assert caught.value.retry_after_s is not None
        assert client.is_serving()
        database.make_room()
        database.cluster.stop()
        database.cluster.start()
        with Client(database.address, PATIENT) as patient:
            stored.add(patient.add_reference("s", _large(len(stored)), timeout_s=60).reference_id)
            assert {it.reference_id for it in patient.list_references("s")} == stored


@dataclass(frozen=True)
class _Cramped:
    """A PostgreSQL on a small disk, and the address of the server that uses it."""

    cluster: Cluster
    disk: Path
    address: str

    def make_room(self) -> None:
        assert mount("-o", f"remount,size={3 * SMALL_MIB}m", str(self.disk)) == 0


@contextmanager
def _filled(data_dir: Path, on: Callable[[Path], Cluster]) -> Iterator[tuple[Client, _Cramped, set[str], MaplessError]]:
    """A server whose database has no room left: what was stored until then, and how the next one was refused."""
    require()
    with _disk(SMALL_MIB) as disk, ExitStack() as stack:
        cluster = on(disk)
        stack.callback(cluster.remove)
        store = Store.connect(cluster.fresh_url())
        server = stack.enter_context(serving(data_dir, store=store))
        client = stack.enter_context(Client(server.address, ONCE))
        client.create_scene("s")
        stored = {client.add_reference("s", _large(0)).reference_id}
        with pytest.raises(MaplessError) as caught:
            _add_many(client, stored)
        yield client, _Cramped(cluster, disk, server.address), stored, caught.value


def _add_many(client: Client, stored: set[str]) -> None:
    while len(stored) < 1000:
        stored.add(client.add_reference("s", _large(len(stored))).reference_id)


@contextmanager
def _disk(size_mib: int) -> Iterator[Path]:
    """One that PostgreSQL's user can reach, which the folders of tests are not."""
    with tempfile.TemporaryDirectory(prefix="mapless-disk-") as folder:
        Path(folder).chmod(0o755)
        with small_disk(Path(folder) / "disk", size_mib) as disk:
            yield disk


def _large(i: int) -> NewReference:
    """Some 230 kB."""
    photo = encode(".png", np.random.default_rng(i).integers(0, 256, (240, 320, 3)).astype(np.uint8))
    return NewReference(f"r{i}", photo, Camera(320, 240, 300.0, 300.0, 159.5, 119.5), pose(i))


def _ours_left(connection: psycopg.Connection[tuple[object, ...]]) -> bool:
    found = "SELECT count(*) FROM pg_stat_activity WHERE application_name = 'mapless-server'"
    return connection.execute(found).fetchone() != (0,)
