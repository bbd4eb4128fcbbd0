"""Import, start, and many clients at once; each turn has a server of its own."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from time import perf_counter, sleep

import grpc
import numpy as np

from bench.load.driving import free_port
from mapless import Client
from mapless.v1 import reference_service_pb2 as pb
from mapless.v1.reference_service_pb2_grpc import ReferenceServiceStub
from mapless_tools.child import CONNECT, ChildServer
from mapless_tools.dataset import Frame
from mapless_tools.evaluate.run import SCENE, store_references

from .comparison import TURNS, Figure, figures_of_turns
from .query import localized
from .servers import Side, connected, processor_s

CLIENTS = 8
_ASKED_EVERY_S = 0.02
IMPORT = (
    ("import, processor time a reference", "ms"),
    ("import, time a reference", "ms"),
    ("from the first upload to the first answer", "s"),
)
START = (
    ("start to the first list of scenes, time", "s"),
    ("start to ready, time", "s"),
    ("start to ready, processor time", "s"),
    ("memory when ready", "MiB"),
    ("first localization", "ms"),
)
SATURATION = (
    ("answers a second", ""),
    ("processor time an answer", "ms"),
    ("p50", "ms"),
    ("p99 over p50", ""),
    ("memory after", "MiB"),
)


def measure_import(
    sides: Sequence[Side], references: Sequence[Frame], query: Frame, rounds: int, background: bool
) -> list[Figure]:
    """Imports references into empty stores, then localizes one photograph."""
    found: list[list[list[float]]] = [[], []]
    for number, turn in enumerate(TURNS * rounds):
        with sides[turn].server(f"import-{number}", background=background) as server, connected(server) as client:
            begin_s, begin_cpu_s = perf_counter(), processor_s(server.process_id)
            store_references(client, SCENE, references, lambda *_: None)
            spent_s, spent_cpu_s = perf_counter() - begin_s, processor_s(server.process_id) - begin_cpu_s
            localized(client, server, query)
            count = len(references) / 1e3
            found[turn].append([spent_cpu_s / count, spent_s / count, perf_counter() - begin_s])
    return figures_of_turns(IMPORT, found)


def measure_start(
    sides: Sequence[Side], references: Sequence[Frame], query: Frame, rounds: int, features: str
) -> list[Figure]:
    """Starts servers on stores with references, calls them, and localizes one photograph at once."""
    store = f"start-{features}"
    for side in sides:
        with side.server(store, features) as server, connected(server) as client:
            store_references(client, SCENE, references, lambda *_: None)
    found: list[list[list[float]]] = [[], []]
    for turn in TURNS * rounds:
        port, begin_s = free_port(), perf_counter()
        with ThreadPoolExecutor(1) as thread:
            listed = thread.submit(_until_listed, f"127.0.0.1:{port}")
            with sides[turn].server(store, features, port=port) as server, connected(server) as client:
                started = [perf_counter() - begin_s, processor_s(server.process_id), _resident_mib(server)]
                first_ms = 1e3 * localized(client, server, query)[1]
                found[turn].append([listed.result() - begin_s, *started, first_ms])
    return figures_of_turns([(f"{features}: {name}", unit) for name, unit in START], found)


def _until_listed(address: str) -> float:
    """Asks a starting server for its scenes until it answers; returns when it did."""
    while True:
        with grpc.insecure_channel(address) as channel, suppress(grpc.RpcError):
            ReferenceServiceStub(channel).ListScenes(pb.ListScenesRequest(page_size=1), timeout=CONNECT.timeout_s)
            return perf_counter()
        sleep(_ASKED_EVERY_S)


def measure_saturation(
    sides: Sequence[Side], references: Sequence[Frame], queries: Sequence[Frame], rounds: int, seconds: float
) -> list[Figure]:
    """Localizes photographs from `CLIENTS` clients, each again as soon as it has its answer."""
    for side in sides:
        with side.server("saturation") as server, connected(server) as client:
            store_references(client, SCENE, references, lambda *_: None)
    found: list[list[list[float]]] = [[], []]
    for turn in TURNS * rounds:
        with sides[turn].server("saturation") as server, connected(server) as client:
            for query in queries:
                localized(client, server, query)
            found[turn].append(_saturated(server, client, queries, seconds))
    return figures_of_turns(SATURATION, found)


def _saturated(server: ChildServer, client: Client, queries: Sequence[Frame], seconds: float) -> list[float]:
    begin_s, begin_cpu_s = perf_counter(), processor_s(server.process_id)
    with ThreadPoolExecutor(CLIENTS) as threads:
        work = partial(_calls, client, queries, begin_s + seconds)
        latencies_s = np.concatenate(list(threads.map(work, range(CLIENTS))))
    spent_s, spent_cpu_s = perf_counter() - begin_s, processor_s(server.process_id) - begin_cpu_s
    p50_s, p99_s = np.quantile(latencies_s, [0.5, 0.99])
    count = len(latencies_s)
    return [count / spent_s, 1e3 * spent_cpu_s / count, 1e3 * p50_s, p99_s / p50_s, _resident_mib(server)]


def _calls(client: Client, queries: Sequence[Frame], until_s: float, number: int) -> list[float]:
    """Times of one client's calls, seconds; each client begins with another photograph."""
    latencies_s: list[float] = []
    while perf_counter() < until_s or not latencies_s:
        frame = queries[number % len(queries)]
        begin_s = perf_counter()
        client.localize(frame.image_path.read_bytes(), frame.camera, SCENE, mask=frame.mask_path)
        latencies_s.append(perf_counter() - begin_s)
        number += CLIENTS + 1
    return latencies_s


def _resident_mib(server: ChildServer) -> float:
    memory = server.memory()
    return np.nan if memory is None else memory.resident_mib
