"""Runs all parts in order. A failed part is reported in the table and the rest goes on, since device time is scarce."""

import gc
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import torch

from mapless_server.networks.runner import CompiledShape, NetworkRunner
from mapless_server.observability.provenance import cpu_model

from .forward import measure_forward, measure_memory, measure_peak, reason_of
from .operations import H200, Peak
from .report import Figure, as_json, markdown, table
from .subject import GRID, REFERENCES, count_all, make_network

OUTPUT = Path("bench-output")
HOST_PARTS = ("operations",)
CUDA_PARTS = (
    *(f"{kind}-pi3" for kind in ("memory", "forward", "query")),
    *(f"{kind}-mapanything" for kind in ("memory", "forward", "query")),
    *(f"{kind}-pi3x" for kind in ("forward", "query", "memory")),
)
PARTS = (*HOST_PARTS, *CUDA_PARTS)
REPEATS, QUICK_REPEATS = 20, 3


def bench_network(quick: bool = False, only: Sequence[str] | None = None, output: Path = OUTPUT) -> list[Figure]:
    """Measures and prints a table; writes `network.json` and `network.md` after each part.

    With `quick`, few repetitions and nothing compiled, to check that it runs. `only` names `PARTS`; None for all that
    this machine can run.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if device.type == "cpu":
        print("There is no CUDA device: no figure below is a GPU's, and what needs one is not measured.", flush=True)
        torch.set_num_threads(1)  # so that figures do not depend on the load of the other cores
    bench = _Bench(device, quick)
    output.mkdir(parents=True, exist_ok=True)
    for part in only or (CUDA_PARTS if device.type == "cuda" else HOST_PARTS):
        bench.run(part)
        bench.write(output)
    print("\n".join(["", bench.title, "", *table(bench.figures), "", f"With notes: {output / 'network.md'}"]))
    return bench.figures


class _Bench:
    """The parts of the benchmark, and their figures so far."""

    def __init__(self, device: torch.device, quick: bool) -> None:
        self.device = device
        self.quick = quick
        self.figures: list[Figure] = []
        self._repeats = QUICK_REPEATS if quick else REPEATS
        cuda = device.type == "cuda"
        name = torch.cuda.get_device_name(device) if cuda else f"{cpu_model()}, one thread"
        quickly = ", quick run: not comparable" if quick else ""
        self.title = f"{name}, torch {torch.__version__}{quickly}"
        self.peak = self._measured_peak() if cuda else H200

    def _measured_peak(self) -> Peak:
        peak = measure_peak(self.device)
        self.figures.append(Figure("ceiling", "bfloat16 matrix product, 8192^3", peak.flops / 1e12, "TFLOP/s"))
        return peak

    def run(self, part: str) -> None:
        start_s = time.perf_counter()
        print(f"{part}: ", end="", flush=True)
        figures = [*self._tried(self._part(part), part)]
        self.figures += figures
        missing = sum(figure.value is None for figure in figures)
        failed = f", {missing} not measured" if missing else ""
        print(f"{len(figures) - missing} figures{failed}, {time.perf_counter() - start_s:.0f} s", flush=True)
        torch._dynamo.reset()
        gc.collect()
        if self.device.type == "cuda":
            torch.cuda.empty_cache()

    def _part(self, part: str) -> Iterator[Figure]:
        if part not in HOST_PARTS and self.device.type != "cuda":
            raise RuntimeError("there is no CUDA device")
        kind, _, name = part.partition("-")
        parts: dict[str, Callable[[], Iterator[Figure]]] = {
            "operations": lambda: count_all(self.peak),
            "memory": lambda: measure_memory(lambda: self._runner(name, "cpu"), self.device),
            "forward": lambda: measure_forward(name, self.peak, self.device, self._repeats, not self.quick),
            "query": lambda: self._query(name),
        }
        yield from parts[kind]()

    def _runner(self, name: str, weights_on: torch.device | str) -> NetworkRunner:
        """The network as the server runs it, compiled for a query with ten references."""
        network, compiler = make_network(name, device=weights_on), None if self.quick else "inductor"
        runner = NetworkRunner(network, name, "random weights", self.device, compile_backend=compiler)
        runner.warm_up([CompiledShape(GRID, REFERENCES + 1)])
        return runner

    def _query(self, name: str) -> Iterator[Figure]:
        from . import query  # its imports are more than torch and NumPy

        tier, note = query.make_tier(query.FEATURES, self.device)
        bench = query.Bench(query.photographs(2 if self.quick else 8), tier)
        runner = self._runner(name, self.device)
        yield from self._tried(query.measure_queries(runner, bench, note), f"query-{name}")
        runner.close()

    def _tried(self, figures: Iterator[Figure], part: str) -> Iterator[Figure]:
        try:
            yield from figures
        except Exception as error:  # what comes after can still be measured
            yield Figure(part, "failed", None, "", note=reason_of(error))

    def write(self, output: Path) -> None:
        content = as_json(self.title, self.figures)
        (output / "network.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        (output / "network.md").write_text("\n".join(markdown(self.title, self.figures)) + "\n", encoding="utf-8")
