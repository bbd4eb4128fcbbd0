"""The cost of a call: time and memory of a server that does nothing else."""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from mapless import Client
from mapless_server.settings import Settings
from mapless_tools.child import CONNECT, Memory, child_server
from mapless_tools.dataset import Dataset
from mapless_tools.evaluate.metrics import QueryResult
from mapless_tools.evaluate.plan import EvaluationOptions
from mapless_tools.evaluate.run import SCENE, Plan, localize_queries, plan_for, store_references
from mapless_tools.progress import Progress

REFERENCE_COUNT = 30


@dataclass(frozen=True)
class Latency:
    """The cost of calls on a filled store, and the memory after them.

    `cold_ms` are those of the first call of each of several fresh servers, with a different photograph each;
    `first_pass` those of every query for the first time on one server, without the cold one; `warm` the same again.
    """

    cold_ms: tuple[float, ...]
    first_pass: tuple[QueryResult, ...]
    warm: tuple[QueryResult, ...]
    memory: Memory | None


def measure_latency(
    dataset: Dataset, settings: Settings, query_count: int | None, cold_count: int, progress: Progress
) -> Latency:
    """Localizes on 30 stored references with K = 10, one call after the other; first calls on `cold_count` servers.

    The measured servers did not store the references themselves, so their memory does not include what storing needs.
    """
    options = EvaluationOptions(reference_count=REFERENCE_COUNT, query_count=query_count)
    plan = plan_for(dataset, options, settings, progress)
    with tempfile.TemporaryDirectory(prefix="mapless-bench-") as folder:
        data_dir = Path(folder)
        with child_server(data_dir) as server, Client(server.address, CONNECT) as client:
            store_references(client, SCENE, plan.references, progress)
        cold = [_first_call_ms(data_dir, plan, options, i + 1) for i in range(cold_count - 1)]
        with child_server(data_dir) as server, Client(server.address, CONNECT) as client:
            client.is_serving()
            first_pass = localize_queries(client, plan, options, progress)
            warm = localize_queries(client, plan, options, lambda *_: None)
            memory = server.memory()
    return Latency((*cold, first_pass[0].latency_ms), first_pass[1:], warm, memory)


def _first_call_ms(data_dir: Path, plan: Plan, options: EvaluationOptions, query: int) -> float:
    only = replace(plan, queries=(plan.queries[query % len(plan.queries)],))
    with child_server(data_dir) as server, Client(server.address, CONNECT) as client:
        client.is_serving()  # connects, which is no part of a call
        return localize_queries(client, only, options, lambda *_: None)[0].latency_ms
