"""Databases for tests that hold on each of them, and references that follow from a seed."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import psycopg
import pytest
from sqlalchemy import Connection, Engine

from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless.lenses import Distortion
from mapless_server.method.features.views import Features, View
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, Store, postgresql, rows, sqlite
from mapless_server.store.postgresql import PostgresqlDatabase
from mapless_server.store.sqlite import DATABASE_FILE, SqliteDatabase
from mapless_server.store.store import DEFAULT_CACHE_BYTES
from mapless_server.store.verification import verify
from support import postgres

EXTRACTOR = "sift"
DATABASES = ("sqlite", "postgresql")


@dataclass(frozen=True)
class Folder:
    """A data folder with SQLite.

    Statements have question marks for their parameters; `execute` commits one, which must change something.
    """

    data_dir: Path

    def open(self, cache_bytes: int = DEFAULT_CACHE_BYTES) -> Store:
        return Store.open(self.data_dir, cache_bytes)

    def open_as_is(self) -> SqliteDatabase:
        return SqliteDatabase.open_as_is(self.data_dir / DATABASE_FILE)

    def fetch(self, statement: str, *parameters: object) -> list[tuple[Any, ...]]:
        with closing(self.connect()) as connection:
            return list(connection.execute(statement, parameters).fetchall())

    def execute(self, statement: str, *parameters: object) -> None:
        with closing(self.connect()) as connection, connection:
            assert connection.execute(statement, parameters).rowcount != 0, "nothing was changed"

    def run_script(self, statements: str) -> None:
        """Creates the database, if missing, and executes statements of SQL."""
        self.data_dir.mkdir(exist_ok=True)
        with closing(self.connect()) as connection:
            connection.executescript(statements)

    def inspected(self) -> AbstractContextManager[Connection]:
        """A connection that reflects the schema."""
        return connected(sqlite.create_sqlite_engine(self.data_dir / DATABASE_FILE))

    def connect(self) -> Any:
        """With the store's own library: another one in the same process would neither see nor keep its locks."""
        return sqlite.choose_library().connect(self.data_dir / DATABASE_FILE, timeout=0)


@dataclass(frozen=True)
class Shared:
    """A schema of a PostgreSQL."""

    url: str

    def open(self, cache_bytes: int = DEFAULT_CACHE_BYTES) -> Store:
        return Store.connect(self.url, cache_bytes)

    def open_as_is(self) -> PostgresqlDatabase:
        return PostgresqlDatabase.open(self.url, migrates=False)

    def fetch(self, statement: str, *parameters: object) -> list[tuple[Any, ...]]:
        with psycopg.connect(self.url) as connection:
            return connection.execute(_in_psycopg(statement), parameters).fetchall()

    def execute(self, statement: str, *parameters: object) -> None:
        with psycopg.connect(self.url) as connection:
            assert connection.execute(_in_psycopg(statement), parameters).rowcount != 0, "nothing was changed"

    def run_script(self, statements: str) -> None:
        """Executes statements of SQL."""
        with psycopg.connect(self.url) as connection:
            connection.execute(statements.encode())

    def inspected(self) -> AbstractContextManager[Connection]:
        """A connection that reflects the schema, which it does not of what is sent in binary."""
        return connected(postgresql._create_engine(postgresql.parse_url(self.url), cursors_are_binary=False))


@contextmanager
def connected(engine: Engine) -> Iterator[Connection]:
    """A connection of an engine that is used for nothing else."""
    try:
        with engine.connect() as connection:
            yield connection
    finally:
        engine.dispose()


Place: TypeAlias = Folder | Shared
"""A database that stores are opened on, and that tests can read and change without them."""


@dataclass
class CountingStoreObserver:
    """Keeps what it receives."""

    operations: list[str] = field(default_factory=list)
    failures: int = 0

    def stored(self, operation: str, seconds: float) -> None:
        assert seconds >= 0
        self.operations.append(operation)

    def store_failed(self) -> None:
        self.failures += 1


def place_on(database: str, new_folder: Callable[[], Path]) -> Place:
    """An empty place; skips the test where there is no such database."""
    if database == "sqlite":
        return Folder(new_folder() / "data")
    return Shared(postgres.shared_cluster().fresh_url())


def faults_of(place: Place) -> tuple[str, ...]:
    """The findings of verification."""
    with closing(place.open_as_is()) as database, database.read() as connection:
        return verify(connection).faults


def make_reference(
    reference_id: str, seed: int = 0, count: int = 20, distortion: Distortion | None = None, dimension: int = 0
) -> NewReference:
    """A reference whose every number follows from the seed and uses all bits; 0 dimensions are no descriptor."""
    random = np.random.default_rng(seed)
    focal_x_px, focal_y_px, principal_x_px, principal_y_px = random.uniform(300, 900, 4).tolist()
    camera = Camera(640, 480, focal_x_px, focal_y_px, principal_x_px, principal_y_px, distortion)
    pose = RigidTransform(rotation_from_vector(random.normal(size=3)), random.normal(size=3) * 1e3)
    image = random.bytes(5000)
    view = View(camera.pinhole(), make_features(random, count))
    descriptors = {"vlad": make_descriptor(random, dimension)} if dimension else {}
    return NewReference(reference_id, image, camera, pose, {EXTRACTOR: view}, descriptors)


def make_features(random: np.random.Generator, count: int) -> Features:
    """So many features."""
    return Features(
        random.uniform(0, 640, (count, 2)).astype(np.float32),
        random.normal(size=(count, 128)).astype(np.float32),
        random.uniform(1, 30, count).astype(np.float32),
    )


def make_descriptor(random: np.random.Generator, dimension: int) -> np.ndarray:
    """A unit vector."""
    vector = random.normal(size=dimension).astype(np.float32)
    return vector / np.linalg.norm(vector)


def view_of(new: NewReference) -> View:
    """The features of the one extractor."""
    return new.views[EXTRACTOR]


def let_pass(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Puts the store's clock forward."""
    now_us = rows.now_us
    monkeypatch.setattr(rows, "now_us", lambda: now_us() + round(seconds * 1e6))


def assert_same_bits(actual: np.ndarray, expected: np.ndarray) -> None:
    """Type, shape and every bit."""
    assert actual.dtype == expected.dtype
    assert actual.shape == expected.shape
    assert actual.tobytes() == expected.tobytes()


def assert_same_view(actual: View, expected: View) -> None:
    """Camera and features."""
    assert actual.camera == expected.camera
    assert_same_bits(actual.features.keypoints, expected.features.keypoints)
    assert_same_bits(actual.features.descriptors, expected.features.descriptors)
    assert_same_bits(actual.features.sizes_px, expected.features.sizes_px)


def _in_psycopg(statement: str) -> Any:
    return statement.replace("%", "%%").replace("?", "%s")


PAGE_BYTES = 4096
_COLUMN = {
    "image": "UPDATE image SET data = zeroblob(64) WHERE reference_key = ?",
    "features": "UPDATE features SET data = zeroblob(64) WHERE reference_key = ?",
    "descriptor": "UPDATE global_descriptor SET data = zeroblob(64) WHERE reference_key = ?",
    "pose": "UPDATE reference SET geometry = zeroblob(64) WHERE key = ?",
}


def damage(store: Store, scene_key: SceneKey, reference_id: str, what: str) -> None:
    """Damages the "image", the "features", the "descriptor" or the "pose" of a reference, by the store's back door."""
    with store.database.write() as connection:
        key = connection.exec_driver_sql(
            "SELECT key FROM reference WHERE scene_id = ? AND reference_id = ?", (scene_key, reference_id)
        ).scalar_one()
        assert connection.exec_driver_sql(_COLUMN[what], (key,)).rowcount > 0


def lose_page_with(file: Path, content: bytes) -> None:
    """Zeroes the page of a database in which some content begins, and with it a link to the next page."""
    at = file.read_bytes().find(content)
    assert at > 0
    with file.open("r+b") as stream:
        stream.seek(at // PAGE_BYTES * PAGE_BYTES)
        stream.write(bytes(PAGE_BYTES))


def read_image(store: Store, scene_key: SceneKey, reference_id: str) -> bytes:
    """The image's bytes of a reference, by its id."""
    return store.read_image_of(store.find_keys(scene_key, [reference_id])[reference_id])
