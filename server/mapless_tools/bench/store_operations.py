"""Measures the store's operations on one large scene of synthetic references, one after the other in one thread.

Run it as `python -m mapless_tools.bench.store_operations`.
"""

import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import typer
from rich.progress import track

from mapless.geometry import Camera, RigidTransform
from mapless_server.method.views import Features, View
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, Store

SCENE = SceneKey("scale")
EXTRACTOR = "synthetic"
DESCRIPTOR = "synthetic-512"
BATCH = 100
CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)


class Maker:
    """Makes references that differ in all that is stored."""

    def __init__(self, feature_count: int, dimension: int, image_bytes: int) -> None:
        self._random = np.random.default_rng(0)
        self._feature_count, self._dimension, self._image_bytes = feature_count, dimension, image_bytes

    def make(self, number: int) -> NewReference:
        """The reference of this number."""
        random, count = self._random, self._feature_count
        features = Features(
            random.random((count, 2), np.float32), random.random((count, 128), np.float32), np.ones(count, np.float32)
        )
        descriptor = random.random(self._dimension, np.float32) - 0.5
        return NewReference(
            f"{number:08}",
            random.bytes(self._image_bytes),
            CAMERA,
            RigidTransform(np.eye(3), random.normal(size=3)),
            {EXTRACTOR: View(CAMERA, features)},
            {DESCRIPTOR: descriptor / np.linalg.norm(descriptor)},
        )


def main(
    references: Annotated[int, typer.Option(help="References of the scene.")] = 100_000,
    repetitions: Annotated[int, typer.Option(help="Times that each operation is measured.")] = 300,
    features: Annotated[int, typer.Option(help="Features of a reference.")] = 8,
    dimension: Annotated[int, typer.Option(help="Dimension of the global descriptors.")] = 512,
    image_bytes: Annotated[int, typer.Option(help="Size of an image.")] = 1000,
    database_url: Annotated[str | None, typer.Option(help="An empty PostgreSQL database; default: SQLite.")] = None,
    folder: Annotated[Path | None, typer.Option(help="For SQLite's file; default: a temporary one.")] = None,
) -> None:
    """Fill a scene, then measure what callers do with it."""
    make = Maker(features, dimension, image_bytes).make
    with _store(database_url, folder) as store:
        store.create_scene(SCENE)
        start_s = time.perf_counter()
        for first in track(range(0, references, BATCH), "adding"):
            store.add_references(SCENE, [make(number) for number in range(first, min(first + BATCH, references))])
        seconds = time.perf_counter() - start_s
        print(f"{'add, ' + str(BATCH) + ' at a time':<34} {references / seconds:8.0f} references/s")
        _measure_all(store, make, references, repetitions)
        print(f"{'on disk':<34} {_size_bytes(store) / 2**20:8.0f} MiB")


def _measure_all(store: Store, make: Callable[[int], NewReference], references: int, repetitions: int) -> None:
    random = np.random.default_rng(1)
    names = [[f"{number:08}" for number in random.integers(0, references, 10)] for _ in range(repetitions)]
    added = [make(references + index) for index in range(repetitions)]

    before_mib, start_s = _resident_mib(), time.perf_counter()
    whole = store.list_changes(SCENE, None, DESCRIPTOR)
    seconds = time.perf_counter() - start_s
    gc.collect()
    held_mib = _resident_mib() - before_mib
    print(f"{'first read of the whole scene':<34} {seconds * 1e3:8.0f} ms, {held_mib:.0f} MiB for {len(whole.added)}")
    generation = whole.generation
    del whole

    def add_and_list(index: int) -> None:
        nonlocal generation
        changes = store.list_changes(SCENE, generation, DESCRIPTOR)
        assert [it.reference_id for it in changes.added] == [added[index].reference_id]
        generation = changes.generation

    _measure("add one", repetitions, lambda index: store.add_references(SCENE, [added[index]]), add_and_list)
    _measure("list a page of 100", repetitions, lambda index: store.list_references(SCENE, 100, names[index][0]))
    _measure("load 10 by name, cold", repetitions, lambda index: store.load_references(SCENE, names[index], EXTRACTOR))
    _measure("load 10 by name, warm", repetitions, lambda index: store.load_references(SCENE, names[-1], EXTRACTOR))
    _measure("get one", repetitions, lambda index: store.get_reference(SCENE, names[index][0]))
    _measure("get the scene", repetitions, lambda index: store.get_scene(SCENE))
    _measure("changes: none", repetitions, lambda index: store.list_changes(SCENE, generation, DESCRIPTOR))
    _measure("delete one", repetitions, lambda index: store.delete_reference(SCENE, added[index].reference_id))


def _measure(
    what: str, repetitions: int, operation: Callable[[int], object], then: Callable[[int], object] | None = None
) -> None:
    seconds, seconds_then = [], []
    for index in range(repetitions):
        start_s = time.perf_counter()
        operation(index)
        seconds.append(time.perf_counter() - start_s)
        if then is not None:
            start_s = time.perf_counter()
            then(index)
            seconds_then.append(time.perf_counter() - start_s)
    _print(what, seconds)
    if seconds_then:
        _print("changes since one was added", seconds_then)


def _print(what: str, seconds: list[float]) -> None:
    p50, p99 = np.percentile(seconds, [50, 99]) * 1e3
    print(f"{what:<34} {p50:8.2f} ms p50 {p99:8.2f} ms p99 {max(seconds) * 1e3:8.2f} ms max")


@contextmanager
def _store(database_url: str | None, folder: Path | None) -> Iterator[Store]:
    if database_url is not None:
        with Store.connect(database_url) as store:
            yield store
    else:
        with TemporaryDirectory(dir=folder) as data_dir, Store.open(Path(data_dir)) as store:
            yield store


def _size_bytes(store: Store) -> int:
    with store.database.read() as connection:
        if connection.dialect.name == "postgresql":
            statement = "SELECT pg_database_size(current_database())"
        else:
            statement = "SELECT page_count * page_size FROM pragma_page_count(), pragma_page_size()"
        return int(connection.exec_driver_sql(statement).scalar_one())


def _resident_mib() -> float:
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0]) / 1024


if __name__ == "__main__":
    typer.run(main)
