"""While the store is away, "/ready?store" of the metrics port is 503; "/ready", "/live" and health stay as they are."""

import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from support.postgres import Cluster, require
from support.servers import RunningServer, serving
from support.waiting import wait_until

from mapless import Client
from mapless_server.observability import store_probe
from mapless_server.store import Store
from mapless_server.store.sqlite import DATABASE_FILE


def status(server: RunningServer, path: str) -> int:
    try:
        with urllib.request.urlopen(f"http://{server.metrics_address}{path}", timeout=30) as response:
            return int(response.status)
    except urllib.error.HTTPError as error:
        with error:
            return error.code


@contextmanager
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, store: Store | None = None) -> Iterator[RunningServer]:
    monkeypatch.setattr(store_probe.StoreProbe.__init__, "__defaults__", (3.0, 0.1))
    options: dict[str, Any] = {"metrics": True, "metrics_host": "127.0.0.1", "metrics_port": 0}
    with serving(tmp_path / "data", store=store, **options) as server, Client(server.address) as client:
        client.create_scene("s")
        wait_until(lambda: status(server, "/ready?store") == 200)
        yield server
        assert client.is_serving()
        assert [status(server, path) for path in ("/ready", "/live")] == [200, 200]


def test_the_store_away_fails_the_probe_that_asks_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    require()
    database = Cluster()
    try:
        with served(tmp_path, monkeypatch, Store.connect(database.fresh_url())) as server:
            database.stop()
            wait_until(lambda: status(server, "/ready?store") == 503)
            assert [status(server, path) for path in ("/ready", "/live", "/metrics")] == [200, 200, 200]
            database.start()
            wait_until(lambda: status(server, "/ready?store") == 200)
    finally:
        database.remove()


def test_a_lost_file_of_the_store_fails_the_probe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with served(tmp_path, monkeypatch) as server:
        file = tmp_path / "data" / DATABASE_FILE
        file.rename(tmp_path / "elsewhere")
        wait_until(lambda: status(server, "/ready?store") == 503)
        (tmp_path / "elsewhere").rename(file)
        wait_until(lambda: status(server, "/ready?store") == 200)


LOCK = """
import sqlite3, sys
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
connection.execute("BEGIN IMMEDIATE")
print("locked", flush=True)
sys.stdin.read()
"""


def test_a_store_that_others_lock_fails_the_probe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with served(tmp_path, monkeypatch) as server:
        # Another process, since within one SQLite's locks do not hold between two libraries.
        command = [sys.executable, "-c", LOCK, str(tmp_path / "data" / DATABASE_FILE)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
            assert other.stdout is not None
            assert other.stdout.readline() == "locked\n"
            wait_until(lambda: status(server, "/ready?store") == 503)
            other.communicate(timeout=30)
        wait_until(lambda: status(server, "/ready?store") == 200)
