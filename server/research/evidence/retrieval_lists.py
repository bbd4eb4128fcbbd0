"""Lists of a large scene: how many rows a search has to compare to find what an exact search finds."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.retrieval.measure import by_rows, make
from bench.retrieval.scene import fill
from bench.retrieval.vectors import planted
from mapless_server.store import Store

from .page import Measurement, Row

REFERENCES, QUERIES = 100_000, 200
COMPARED = (1_000, 2_000, 5_000, 10_000, 20_000, 50_000)
SEED = 1


def _lists() -> Iterator[Row]:
    vectors = planted(REFERENCES, SEED)
    vectors = replace(vectors, queries=vectors.queries[:: max(1, len(vectors.queries) // QUERIES)])
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        with Store.open(folder) as store:
            best = fill(store, vectors)
        make(folder, vectors.queries.shape[1])
        for count, found, processor_ms in by_rows(folder, vectors.queries, best, COMPARED):
            share = f"{100 * count / REFERENCES:g} %"
            times = f"{processor_ms:.1f} ms"
            yield {"rows compared": count, "share": share, "found of the ten": f"{found:.4f}", "processor time": times}


MEASUREMENTS = {"retrieval-lists": Measurement(lambda scenes: _lists(), needs_scenes=False)}
