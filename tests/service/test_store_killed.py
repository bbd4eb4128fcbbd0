"""A server or a database that is killed at any moment loses nothing acknowledged, leaves nothing half-written.

Run as a program, this file forks writers: one for each line that it reads. A writer changes a store as fast as it can
and prints a line for each change before it is made (``try``), when it is acknowledged (``done``), and when its result
is unknown because the database went away (``lost``). Writers are forked because Python takes long to start.
"""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from support import postgres
from support.stores import DATABASES, Folder, Place, Shared, faults_of
from support.waiting import wait_until

from bench.search_path import with_search_path
from mapless.geometry import Camera, RigidTransform
from mapless_server import errors
from mapless_server.method.features.views import Features, View
from mapless_server.security import DEFAULT_TENANT, SceneKey
from mapless_server.store import NewReference, Store, StoreError, deletion
from mapless_server.store.verification import verify

SCENE = SceneKey("office")
EXTRACTOR, DESCRIPTOR = "sift", "vlad"
CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
COUNTS = (
    "SELECT (SELECT count(*) FROM image), (SELECT count(*) FROM features), (SELECT count(*) FROM global_descriptor)"
)
WAIT_S = 30.0
DATABASE_IS_KILLED_EVERY = 8
"""Rounds; in the others the server is killed."""
DELETES = "deletes"
"""Prefix of the names of writers that delete scenes."""
REFERENCES_OF_A_SCENE = 6
EARLY_KILL_EVERY = 5
"""Rounds: killed before it has opened the store."""


def make_reference(reference_id: str) -> NewReference:
    """A reference of about 30 kB, all of it determined by its id."""
    generator = np.random.default_rng(list(reference_id.encode()))
    features = Features(
        generator.random((20, 2), np.float32), generator.random((20, 128), np.float32), generator.random(20, np.float32)
    )
    pose = RigidTransform(np.eye(3), generator.normal(size=3))
    view = View(CAMERA, features)
    descriptor = generator.random(64, np.float32)
    return NewReference(
        reference_id, generator.bytes(20_000), CAMERA, pose, {EXTRACTOR: view}, {DESCRIPTOR: descriptor}
    )


def open_when_there(address: str) -> Store:
    """The database may be the one that is being stopped just now."""
    while True:
        with suppress(StoreError):
            return Store.connect(address) if address.startswith("postgresql:") else Store.open(Path(address))
        time.sleep(0.01)


def change_until_killed(address: str, prefix: str) -> None:
    """Adds some references at a time; every fourth change deletes one that is known to be there."""
    with open_when_there(address) as store:
        added: list[str] = []
        for index in range(100_000):
            if index % 4 == 3 and added:
                verb, ids = "delete", [added.pop()]
            else:
                verb, ids = "add", [f"{prefix}-{index}-{item}" for item in range(1 + index % 5)]
            change = " ".join([verb, *ids])
            report(f"try {change}")
            try:
                if verb == "add":
                    store.add_references(SCENE, [make_reference(it) for it in ids])
                    added += ids
                else:
                    store.delete_reference(SCENE, ids[0])
            except errors.Unavailable:
                report(f"lost {change}")
                time.sleep(0.01)
            else:
                report(f"done {change}")


def delete_until_killed(address: str, prefix: str) -> None:
    """Makes scenes of several references, and deletes them one reference at a time."""
    deletion.PORTION_BYTES = 0
    with open_when_there(address) as store:
        for index in range(100_000):
            scene = SceneKey(f"{prefix}-{index}")
            store.create_scene(scene)
            store.add_references(scene, [make_reference(f"r{it}") for it in range(REFERENCES_OF_A_SCENE)])
            report(f"try {scene}")
            store.delete_scene(scene)
            report(f"done {scene}")


def report(line: str) -> None:
    """At once, and as a whole."""
    os.write(1, f"{line}\n".encode())


def fork_writers(address: str) -> None:
    import psycopg  # noqa: F401 # so that no writer has to import it

    with TemporaryDirectory() as folder, Store.open(Path(folder)) as store:
        store.create_scene(SCENE)
        store.add_references(SCENE, [make_reference("first")])
    for line in sys.stdin:
        writer = os.fork()
        if writer == 0:
            write = delete_until_killed if line.startswith(DELETES) else change_until_killed
            write(address, line.strip())
        report(f"started {writer}")
        _, status = os.waitpid(writer, 0)
        report(f"ended {os.waitstatus_to_exitcode(status)}")


class WriterFactory:
    """A process that forks one writer at a time."""

    def __init__(self, address: str) -> None:
        paths = [str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]
        environment = os.environ | with_search_path({"PYTHONPATH": os.pathsep.join(paths)})
        self._process = subprocess.Popen(
            [sys.executable, __file__, address],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
            start_new_session=True,
        )

    def start(self, prefix: str) -> int:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{prefix}\n")
        self._process.stdin.flush()
        self.lines: list[str] = []
        return int(self._read_until("started "))

    def wait_for_work(self) -> None:
        self.lines.append(f"try {self._read_until('try ')}")

    def kill(self, writer: int) -> list[str]:
        """The lines that it printed."""
        os.kill(writer, signal.SIGKILL)
        assert self._read_until("ended ") == "-9", "the writer ended by itself"
        return self.lines

    def end(self) -> None:
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.communicate()

    def _read_until(self, start: str) -> str:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith(start):
                return line.removeprefix(start).strip()
            self.lines.append(line.strip())
        raise AssertionError(f"the factory ended: {self.lines[-3:]}")


class Ledger:
    """The changes that must be stored, those that may be, and those that were checked already."""

    def __init__(self) -> None:
        self.stored: set[str] = set()
        self.acknowledged = 0
        self.generation: int | None = None

    def note(self, lines: list[str]) -> list[str]:
        """Records what was acknowledged; the changes whose result is unknown."""
        unknown: list[str] = []
        for line in lines:
            outcome, change = line.split(" ", 1)
            if outcome == "try":
                unknown.append(change)
            elif outcome == "done":
                unknown.remove(change)
                self.acknowledged += 1
                self._apply(change)
        return unknown

    def settle(self, unknown: list[str], found: set[str]) -> None:
        """Each of these happened as a whole or not at all."""
        for change in unknown:
            verb, *ids = change.split()
            there = [it in found for it in ids]
            assert all(there) or not any(there), f"half of it is there: {change}"
            if there[0] == (verb == "add"):
                self._apply(change)

    def check(self, place: Place, store: Store, unknown: list[str]) -> None:
        """Nothing is missing, nothing is there that was not added, and what is new is complete."""
        changes = store.list_changes(SCENE, self.generation, DESCRIPTOR)
        scene = store.get_scene(SCENE)
        found = {row[0] for row in place.fetch("SELECT reference_id FROM reference")}
        self.settle(unknown, found)
        assert found == self.stored
        assert scene.reference_count == len(found)
        assert scene.generation >= 1 + self.acknowledged
        assert place.fetch(COUNTS) == [(len(found),) * 3]
        snapshot = store.load_references(SCENE, [it.reference_id for it in changes.added], EXTRACTOR)
        assert not snapshot.undescribed
        for loaded, indexed in zip(snapshot.references, changes.added, strict=True):
            made = make_reference(loaded.record.reference_id)
            features, expected = loaded.view.features, made.views[EXTRACTOR].features
            assert store.read_image_of(loaded.record.key) == made.image
            assert features.descriptors.tobytes() == expected.descriptors.tobytes()
            assert loaded.record.world_from_camera.translation.tobytes() == made.world_from_camera.translation.tobytes()
            assert indexed.descriptor is not None
            assert np.array_equal(indexed.descriptor, made.descriptors[DESCRIPTOR].astype(np.float16))
        self.generation = changes.generation

    def _apply(self, change: str) -> None:
        verb, *ids = change.split()
        self.stored = self.stored | set(ids) if verb == "add" else self.stored - set(ids)


@contextmanager
def place_of_its_own(database: str, folder: Path) -> Iterator[tuple[Place, postgres.Cluster | None]]:
    """With the database process to be killed, where there is one."""
    if database == "sqlite":
        yield Folder(folder), None
        return
    postgres.require()
    cluster = postgres.Cluster()
    try:
        yield Shared(cluster.fresh_url()), cluster
    finally:
        cluster.remove()


def kill_database(cluster: postgres.Cluster, moments: random.Random) -> None:
    """One of its processes, upon which it ends all others and recovers; or all of it."""
    if moments.random() < 0.5:
        cluster.stop()
        cluster.start()
        return
    with cluster.connect() as connection:
        found = connection.execute("SELECT pid FROM pg_stat_activity WHERE application_name = 'mapless-server'")
        backends = [int(str(row[0])) for row in found]
    for backend in backends[:1]:
        os.kill(backend, signal.SIGKILL)


def wait_for_disconnection(cluster: postgres.Cluster) -> None:
    """PostgreSQL finishes what a killed server has sent it, so that it may still happen for a moment."""
    give_up = time.monotonic() + WAIT_S
    while time.monotonic() < give_up:
        if cluster.lets_in():
            with cluster.connect() as connection:
                count = connection.execute(
                    "SELECT count(*) FROM pg_stat_activity WHERE application_name = 'mapless-server'"
                ).fetchone()
            if count == (0,):
                return
        time.sleep(0.01)
    raise AssertionError("the killed server's connections do not end")


@pytest.mark.parametrize("rounds", [DATABASE_IS_KILLED_EVERY, pytest.param(200, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("database", DATABASES)
def test_killed_at_random_moments(database: str, rounds: int, tmp_path: Path) -> None:
    moments = random.Random(20)
    ledger = Ledger()
    with place_of_its_own(database, tmp_path) as (place, cluster):
        with place.open() as store:
            store.create_scene(SCENE)
        factory = WriterFactory(place.url if isinstance(place, Shared) else str(tmp_path))
        try:
            for number in range(rounds):
                writer = factory.start(f"round{number}")
                if number % EARLY_KILL_EVERY:
                    factory.wait_for_work()
                time.sleep(moments.uniform(0.005, 0.15))
                if cluster is not None and number % DATABASE_IS_KILLED_EVERY == DATABASE_IS_KILLED_EVERY - 1:
                    kill_database(cluster, moments)
                    time.sleep(moments.uniform(0.1, 0.3))  # the server goes on by itself
                unknown = ledger.note(factory.kill(writer))
                if cluster is not None:
                    wait_for_disconnection(cluster)
                with place.open() as store:
                    ledger.check(place, store, unknown)
        finally:
            factory.end()
        assert ledger.acknowledged >= rounds
        assert faults_of(place) == ()


def check_scenes(place: Place) -> None:
    """Each is there with all it had, or gone; and what is left of those is gone soon after the store is opened."""
    with place.open() as store:
        scenes = store.list_scenes(DEFAULT_TENANT, 100)
        assert all(it.reference_count in (0, REFERENCES_OF_A_SCENE) for it in scenes)
        whole = sum(it.reference_count for it in scenes)
        wait_until(lambda: place.fetch("SELECT count(*) FROM reference") == [(whole,)])
        assert place.fetch(COUNTS) == [(whole,) * 3]
        for scene in scenes:
            assert len(store.list_references(SceneKey(scene.scene_id), 100)) == scene.reference_count
        with store.database.read() as connection:
            assert verify(connection).faults == ()


@pytest.mark.parametrize("database", DATABASES)
def test_killed_while_scenes_are_deleted(database: str, tmp_path: Path) -> None:
    moments = random.Random(21)
    with place_of_its_own(database, tmp_path) as (place, cluster):
        place.open().close()
        factory = WriterFactory(place.url if isinstance(place, Shared) else str(tmp_path))
        try:
            for number in range(3):
                writer = factory.start(f"{DELETES}{number}")
                factory.wait_for_work()
                time.sleep(moments.uniform(0.0, 0.1))
                factory.kill(writer)
                if cluster is not None:
                    wait_for_disconnection(cluster)
                check_scenes(place)
        finally:
            factory.end()


if __name__ == "__main__":
    fork_writers(sys.argv[1])
