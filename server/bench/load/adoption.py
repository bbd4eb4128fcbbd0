"""The cost of adoption for a query: at its answer, and where it comes while another photograph is considered."""

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

from mapless import AdoptionPolicy, Client, LocalizationResult, Rejected
from mapless_server.bounds import check_bounds
from mapless_tools.child import CONNECT, child_server
from mapless_tools.demo import Photograph, Place
from mapless_tools.output_files import markdown_table
from mapless_tools.progress import Progress, tracked

from .driving import free_port
from .report import Check
from .watch import read_metrics

MAX_COST_MS = 3.0
OFF, FORBIDDEN, ALLOWED = "no policy", "policy, not allowed", "policy, allowed"
QUIET, CONSIDERING = "nothing is considered", "another is being considered"
PLAIN, ADOPTING = "plain", "adopting"
_RUNNING = "mapless_inflight"
_LOOK_S, _LONGEST_S = 0.01, 60.0


@dataclass(frozen=True)
class AdoptionCostOptions:
    """Options of the comparison: rounds of all photographs, in which all ways take turns.

    A photograph comes at a random time within `spread_s` after the consideration of another one has begun.
    """

    rounds: int = 6
    spread_s: float = 0.3

    def __post_init__(self) -> None:
        check_bounds(self, "rounds", at_least=1)
        check_bounds(self, "spread_s", at_least=0)


@dataclass(frozen=True)
class Times:
    """Times of answered calls of one way, milliseconds: the client's, in the queue, and the server's processor."""

    total_ms: list[float]
    queue_ms: list[float]
    processor_ms: list[float]

    def row(self, name: str) -> list[str]:
        """A row of the table."""
        totals = [f"{np.percentile(self.total_ms, it):.1f}" for it in (50, 99)]
        queue = [f"{np.percentile(self.queue_ms, it):.2f}" for it in (50, 99)]
        return [name, str(len(self.total_ms)), *totals, *queue, f"{median(self.processor_ms):.1f}"]


def measure_adoption(place: Place, options: AdoptionCostOptions, progress: Progress) -> dict[str, Times]:
    """Asks a server of its own about a place's photographs, by turns."""
    port = free_port()
    flags = {"--metrics-port": str(port), "--metrics-host": "127.0.0.1"}
    with (
        tempfile.TemporaryDirectory(prefix="mapless-load-") as data_dir,
        child_server(Path(data_dir), flags) as server,
        Client(server.address, CONNECT) as client,
    ):
        asked, random = _Asked(client, f"127.0.0.1:{port}"), np.random.default_rng(0)
        asked.store(place)
        for photograph in place.queries:  # so that no way pays for what is computed once
            asked.answer(photograph, PLAIN)
            asked.answer(photograph, ADOPTING)
        ways = [(OFF, PLAIN, True), (FORBIDDEN, ADOPTING, False), (ALLOWED, ADOPTING, True)]
        for k in tracked("adoption, rounds", range(options.rounds), options.rounds, progress):
            for i, photograph in enumerate(place.queries):
                first = (i + k) % len(ways)
                for name, scene, allow in ways[first:] + ways[:first]:
                    asked.timed(name, photograph, scene, allow)
                asked.settle()
                asked.timed(QUIET, photograph, PLAIN, False)
                if asked.begins(place.queries[i - 1]):
                    time.sleep(random.uniform(0, options.spread_s))
                    asked.timed(CONSIDERING, photograph, PLAIN, False)
                    asked.settle()
        return asked.times


class _Asked:
    """A client of the server, and the times of its calls."""

    def __init__(self, client: Client, metrics: str) -> None:
        self._client, self._metrics = client, metrics
        self.times = {it: Times([], [], []) for it in (OFF, FORBIDDEN, ALLOWED, QUIET, CONSIDERING)}

    def store(self, place: Place) -> None:
        """Two scenes with the place's references, of which one adopts."""
        for scene, policy in ((PLAIN, None), (ADOPTING, AdoptionPolicy(min_trust=1e-6, max_radius_m=10.0))):
            self._client.create_scene(scene, adoption=policy)
            self._client.add_references(scene, [it.reference() for it in place.references])

    def answer(self, photograph: Photograph, scene: str, allow: bool = False) -> LocalizationResult | Rejected:
        """The answer to a photograph."""
        return self._client.localize(photograph.data, photograph.camera, scene, allow_adoption=allow, timeout_s=300)

    def timed(self, way: str, photograph: Photograph, scene: str, allow: bool) -> None:
        """Counts the times of an answer."""
        begin_s = time.perf_counter()
        answer, times = self.answer(photograph, scene, allow), self.times[way]
        times.total_ms.append(1000 * (time.perf_counter() - begin_s))
        assert answer.diagnostics is not None
        times.queue_ms.append(1000 * answer.diagnostics.queue_s)
        times.processor_ms.append(1000 * answer.diagnostics.processor_s)

    def begins(self, photograph: Photograph) -> bool:
        """Has a photograph considered; returns when that has begun, or whether it does not."""
        before = self._considered
        self.answer(photograph, ADOPTING, True)
        end_s = time.monotonic() + _LONGEST_S
        while time.monotonic() < end_s and self._considered == before:
            if self._total(_RUNNING):
                return True
            time.sleep(_LOOK_S)
        return False

    def settle(self) -> None:
        """Waits until nothing is computed, and nothing will be considered."""
        quiet_s = time.monotonic()
        while time.monotonic() - quiet_s < 2.0:
            if self._total(_RUNNING):
                quiet_s = time.monotonic()
            time.sleep(_LOOK_S)

    @property
    def _considered(self) -> float:
        return self._total("mapless_adoptions_total")

    def _total(self, name: str) -> float:
        scrape = read_metrics(self._metrics)
        return 0.0 if scrape is None else scrape.totals.get(name, 0.0)


def adoption_checks(times: Mapping[str, Times]) -> list[Check]:
    """The bars: processor time at the answer, and time in the queue beside a consideration."""
    spent = median(a - b for a, b in zip(times[ALLOWED].processor_ms, times[OFF].processor_ms, strict=True))
    taken = median(a - b for a, b in zip(times[ALLOWED].total_ms, times[OFF].total_ms, strict=True))
    waited = [float(np.percentile(times[it].queue_ms, 99)) for it in (CONSIDERING, QUIET)]
    bar = f"at most {MAX_COST_MS:g} ms"
    return [
        Check(
            "processor time that a permission to adopt adds to a query", f"{spent:.2f} ms", bar, spent <= MAX_COST_MS
        ),
        Check("time that it adds", f"{taken:.2f} ms", bar, taken <= MAX_COST_MS),
        Check(
            "further wait in the queue beside a consideration, p99",
            f"{waited[0] - waited[1]:.2f} ms",
            bar,
            waited[0] - waited[1] <= MAX_COST_MS,
        ),
    ]


def adoption_lines(times: Mapping[str, Times]) -> list[str]:
    """A table with a row for each way."""
    head = "query | calls | p50, ms | p99, ms | in the queue p50 | p99 | processor, ms"
    rows: Sequence[list[str]] = [it.row(name) for name, it in times.items()]
    return [*markdown_table(head, rows), ""]
