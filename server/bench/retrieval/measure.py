"""Cost of a server of a large scene: each part in a process of its own, so that memory is its own."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.views import View
from mapless_server.method.options import StageContext
from mapless_server.scenes.index_files import IndexFiles
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.library import ReferenceLibrary
from mapless_server.scenes.retrieval.lists import likely_rows
from mapless_server.scenes.retrieval.narrowing import Narrowing, Sphere
from mapless_server.scenes.retrieval.quantizing import Vector
from mapless_server.scenes.retrieval.ranking import Selection, rank_references
from mapless_server.store import Store

from .scene import BEST, DESCRIPTOR, SCENE, SIDE_M, number_of, reference
from .vectors import Floats

INDEXES = "indexes"
COLD_QUERIES = 20
COMPARED = (5_000, 10_000, 20_000, 50_000)
CHANGES = 20
RADIUS_M = 15.0


@dataclass(frozen=True)
class Made:
    """Cost of making the file."""

    cpu_s: float
    wall_s: float
    peak_mib: float
    file_bytes: int


@dataclass(frozen=True)
class Served:
    """Cost of using the file.

    Attributes:
        start_ms, start_read_mib: from a store and a folder to the first entries, and the bytes read for it.
        start_memory_mib: memory after that, beyond what the process had.
        cold_ms: median time of the first queries, after the operating system has forgotten the file.
        p50_ms, p99_ms, p50_cpu_ms: of all later ones; the last is processor time, which other programs do not change.
        near_p50_ms: median with a prior that leaves a radius of 15 m.
        recall: share of the ten that an exact search finds first.
        recall_by_rows: the same, if so many rows at least were compared, and no more lists than that takes.
        bytes_per_reference: memory after all queries, beyond what the process had.
        found_ms: median time from the return of the call that adds a reference until it has been found by a query.
        not_found, still_found: how many new references were not found first, and how many deleted ones were found.
    """

    start_ms: float
    start_read_mib: float
    start_memory_mib: float
    cold_ms: float
    p50_ms: float
    p99_ms: float
    p50_cpu_ms: float
    near_p50_ms: float
    recall: float
    recall_by_rows: dict[int, float]
    bytes_per_reference: float
    found_ms: float
    not_found: int
    still_found: int


class _Descriptor:
    """Vectors are given, so it describes nothing."""

    def __init__(self, dimension: int) -> None:
        self.name, self.dimension = DESCRIPTOR, dimension
        self.extractor: str | None = None

    def describe(self, view: View) -> Vector:
        raise NotImplementedError


@contextmanager
def _indexes(folder: Path, dimension: int) -> Iterator[tuple[Store, SceneIndexes, IndexFiles]]:
    descriptor = _Descriptor(dimension)
    with Store.open(folder) as store:
        files = IndexFiles(store, descriptor, folder / INDEXES)
        # Every reference has its descriptor, so that no features are found.
        no_extractor = cast(FeatureExtractor, None)
        indexes = SceneIndexes(store, ReferenceLibrary(store), descriptor, no_extractor, 2**31, files)
        yield store, indexes, files
        indexes.close()


def make(folder: Path, dimension: int) -> Made:
    """Makes the file of the scene in a data folder."""
    with _indexes(folder, dimension) as (_, _, files):
        wall_begin_s, cpu_begin_s = time.monotonic(), time.process_time()
        files.write(SCENE)
        wall_s, cpu_s = time.monotonic() - wall_begin_s, time.process_time() - cpu_begin_s
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return Made(cpu_s, wall_s, peak_mib, _file_in(folder).stat().st_size)


def serve(folder: Path, queries: Floats, best: NDArray[np.intp], query_count: int) -> Served:
    """Opens the scene in a data folder, queries it so many times, and changes it."""
    _forget(_file_in(folder))
    context = StageContext()
    with _indexes(folder, queries.shape[1]) as (store, indexes, _):
        memory, read, begin_s = _memory_bytes(), _read_bytes(), time.perf_counter()
        count = len(indexes.entries(SCENE, context))
        start_ms = (time.perf_counter() - begin_s) * 1000
        start_read_mib, start_memory_mib = (_read_bytes() - read) / 2**20, (_memory_bytes() - memory) / 2**20

        def ask(vector: Vector, narrowing: Narrowing) -> tuple[list[int], float, float]:
            """Numbers of the references found, the time it took and the processor time, ms."""
            begin_s, cpu_begin_s = time.perf_counter(), time.thread_time()
            found = rank_references(indexes.entries(SCENE, context), vector, Selection(BEST, narrowing))
            took_s, cpu_s = time.perf_counter() - begin_s, time.thread_time() - cpu_begin_s
            return [number_of(it.reference_id) for it in found], took_s * 1000, cpu_s * 1000

        anywhere = Narrowing()
        cold = [ask(query, anywhere)[1] for query in queries[:COLD_QUERIES]]
        times = np.array([ask(queries[i % len(queries)], anywhere)[1:] for i in range(query_count)])
        recall, *recalls = (_recall(indexes, queries, best, it) for it in (None, *COMPARED))
        random = np.random.default_rng(0)
        positions = np.column_stack([random.uniform(0, SIDE_M, (100, 2)), np.zeros(100)])
        near = [Narrowing(position=Sphere(it, RADIUS_M)) for it in positions]
        near_times = [ask(queries[i % len(queries)], it)[1] for i, it in enumerate(near)]
        bytes_per_reference = (_memory_bytes() - memory) / count
        found_ms, not_found, still_found = [], 0, 0
        for i in range(CHANGES):
            direction = random.standard_normal(queries.shape[1])
            vector = np.asarray(direction / np.linalg.norm(direction), np.float32)
            store.add_references(SCENE, [reference(count + i, vector)])
            found, took_ms, _ = ask(vector, anywhere)
            found_ms.append(took_ms)
            not_found += found[0] != count + i
            store.delete_reference(SCENE, f"r{count + i:08d}")
            still_found += count + i in ask(vector, anywhere)[0]
    return Served(
        start_ms=start_ms,
        start_read_mib=start_read_mib,
        start_memory_mib=start_memory_mib,
        cold_ms=float(np.median(cold)),
        p50_ms=float(np.percentile(times[:, 0], 50)),
        p99_ms=float(np.percentile(times[:, 0], 99)),
        p50_cpu_ms=float(np.percentile(times[:, 1], 50)),
        near_p50_ms=float(np.median(near_times)),
        recall=recall,
        recall_by_rows=dict(zip(COMPARED, recalls, strict=True)),
        bytes_per_reference=bytes_per_reference,
        found_ms=float(np.median(found_ms)),
        not_found=not_found,
        still_found=still_found,
    )


def by_rows(
    folder: Path, queries: Floats, best: NDArray[np.intp], compared: Sequence[int]
) -> Iterator[tuple[int, float, float]]:
    """Searches that compare so many rows at least: the number, `Served.recall`, and the processor time of one, ms."""
    with _indexes(folder, queries.shape[1]) as (_, indexes, _):
        indexes.entries(SCENE, StageContext())
        for count in compared:
            begin_s = time.process_time()
            recall = _recall(indexes, queries, best, count)
            yield count, recall, 1000 * (time.process_time() - begin_s) / len(queries)


def _recall(indexes: SceneIndexes, queries: Floats, best: NDArray[np.intp], compared: int | None) -> float:
    """Share of the references in `best` (Q, 10) among the ten first of the search, or of so many rows."""
    entries, right = indexes.entries(SCENE, StageContext()), 0
    every = entries.rows()
    for query, expected in zip(queries, best, strict=True):
        if compared is None or entries.file is None:
            similar = entries.similar(query, every, BEST)
            rows, similarity = similar.rows, similar.similarity
        else:
            rows, _ = likely_rows(every, query, entries.file, compared)
            similarity = entries.similarities(query, rows)
        first = rows[np.argsort(-similarity, kind="stable")[:BEST]]
        right += len({number_of(entries.reference(int(row))[0]) for row in first} & {*expected.tolist()})
    return right / best.size


def _file_in(folder: Path) -> Path:
    (path,) = (folder / INDEXES).glob("*.index")
    return path


def _forget(path: Path) -> None:
    """Has the operating system forget a file, as after a start of the machine."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _memory_bytes() -> int:
    """Resident memory of this process, with what it has mapped of files."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def _read_bytes() -> int:
    """Bytes that this process has read from files, cached by the operating system or not."""
    return int(Path("/proc/self/io").read_text().split()[1])
