"""A PostgreSQL that is killed under load, or that has no connection left: callers are told to come back, and do."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path

import psycopg
import pytest
from postgres import Cluster, require
from programs import wait_until
from servers import CAMERA, PHOTO, pose, serving

from mapless import AlreadyExists, Client, ConnectOptions, LocalizationResult, NewReference, Unavailable
from mapless_server.store import Store

pytestmark = pytest.mark.slow

ONCE = ConnectOptions(max_attempts=1, timeout_s=30)
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
def test_killed_under_load_it_costs_those_who_try_again_time_alone(
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


def test_without_a_connection_left_callers_are_told_to_come_back(tmp_path: Path, database: Cluster) -> None:
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


def _ours_left(connection: psycopg.Connection[tuple[object, ...]]) -> bool:
    found = "SELECT count(*) FROM pg_stat_activity WHERE application_name = 'mapless-server'"
    return connection.execute(found).fetchone() != (0,)
