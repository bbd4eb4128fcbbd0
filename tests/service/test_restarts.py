"""Servers that end and come back: no call fails whose deadline is later, and what was stored is stored once."""

import itertools
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from support.clients import Connect, awaiting
from support.programs import gated
from support.servers import CAMERA, PHOTO, make_scene, pose, serving

from bench.load.driving import free_port
from mapless import Client, ConnectOptions, LocalizationResult, MaplessError, NewReference, Unavailable

PATIENT = ConnectOptions(timeout_s=100.0)


def localizes(client: Client, number: int) -> None:
    assert isinstance(client.localize(PHOTO, CAMERA, "s"), LocalizationResult)


def localizes_progressively(client: Client, number: int) -> None:
    assert [*client.localize_progressively(PHOTO, CAMERA, "s")][-1].is_final


def stores(client: Client, number: int) -> None:
    client.add_reference("s", NewReference(f"n{number}", PHOTO, CAMERA, pose(number)))
    client.delete_reference("s", f"n{number}")


def stores_many(client: Client, number: int) -> None:
    client.create_scene(f"s{number}")
    client.add_references(f"s{number}", [NewReference(f"r{i}", PHOTO, CAMERA, pose(i)) for i in range(3)])
    assert len([*client.list_references(f"s{number}")]) == 3
    client.delete_scene(f"s{number}")


@contextmanager
def calling(
    address: str, options: ConnectOptions, *calls: Callable[[Client, int], None], connect: Connect = Client
) -> Iterator[list[float]]:
    """Each of the calls, again and again in a thread of its own, until the block ends; none may fail.

    Yields the times that they took, seconds.
    """
    stop, failed, took_s = threading.Event(), list[MaplessError](), list[float]()

    def repeat(call: Callable[[Client, int], None]) -> None:
        with connect(address, options) as client:
            for number in itertools.count():
                start_s = time.monotonic()
                try:
                    call(client, number)
                except MaplessError as error:
                    failed.append(error)
                took_s.append(time.monotonic() - start_s)
                if stop.wait(0.05) or failed:
                    return

    threads = [threading.Thread(target=repeat, args=(call,)) for call in calls]
    for thread in threads:
        thread.start()
    try:
        yield took_s
    finally:
        stop.set()
        for thread in threads:
            thread.join(150)
    assert not failed


@pytest.mark.parametrize(
    ("how", "connect"), [pytest.param(signal.SIGTERM, awaiting, marks=pytest.mark.nightly), (signal.SIGKILL, Client)]
)
def test_no_call_fails_while_the_only_server_is_away(tmp_path: Path, how: signal.Signals, connect: Connect) -> None:
    port = free_port()
    with ExitStack() as stack:
        with gated(tmp_path, port=port, drain_grace_s=1) as first:
            first.open_gate()
            with Client(first.address, PATIENT) as client:
                make_scene(client, "s", 2)
            calls = (localizes, localizes_progressively, stores, stores_many)
            took_s = stack.enter_context(calling(first.address, PATIENT, *calls, connect=connect))
            time.sleep(0.5)
            first.process.send_signal(how)
            first.process.wait(30)
        time.sleep(1.0)
        with gated(tmp_path, port=port) as second, Client(second.address, PATIENT) as client:
            count = len(took_s)
            while len(took_s) < count + 8:
                time.sleep(0.01)
            stack.close()
            assert [it.reference_id for it in client.list_references("s")] == ["r0", "r1"]
            assert [it.scene_id for it in client.list_scenes()] == ["s"]


def test_calls_use_the_server_that_is_there(tmp_path: Path) -> None:
    """Two servers restart one after the other; a call takes hardly longer than otherwise."""
    folders = [tmp_path / name for name in ("a", "b")]
    ports = [free_port(), free_port()]
    for folder in folders:
        with serving(folder) as server, Client(server.address) as client:
            make_scene(client, "s", 2)
    address = ",".join(f"localhost:{port}" for port in ports)
    with ExitStack() as stack:
        running = [stack.enter_context(ExitStack()) for _ in folders]
        for it, folder, port in zip(running, folders, ports, strict=True):
            it.enter_context(serving(folder, port=port))
        with calling(address, ConnectOptions(timeout_s=20.0), localizes, localizes_progressively) as took_s:
            for it, folder, port in zip(running, folders, ports, strict=True):
                time.sleep(0.3)
                it.close()
                time.sleep(1.0)
                it.enter_context(serving(folder, port=port))
            time.sleep(0.3)
        assert sorted(took_s)[len(took_s) // 2] < 1.0


def test_a_command_says_soon_that_no_server_is_there() -> None:
    start_s = time.monotonic()
    options = ConnectOptions(connect_timeout_s=1.0)
    with Client(f"localhost:{free_port()}", options) as client, pytest.raises(Unavailable, match="no server listens"):
        client.get_scene("s")
    assert time.monotonic() - start_s < 5
