"""The curves of the plan: what is drawn, and from which runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from mapless_tools.evaluate.svg import Axis, Chart, Curve, draw

from .caching import expected_hit_rate
from .city import City
from .figures import GPU_S_PER_QUERY, RANKING_MS, TOKEN_BYTES, TOKEN_MEMORY_BYTES
from .fleet import Fleet, Outcome, Routing, fullest_district, simulate
from .queueing import latencies_s, spread_services, waiting_quantile_s

DISTRICTS = 4
"""Fleets with a database each."""
DEVICES = 144
"""The plan's: 1000 queries/s at 72 ms predicted, half busy, so that the fullest district's are two thirds busy."""
NODE = 8
"""Devices of a machine, which are lost together: two of each district."""
SECONDS, SETTLED_S = 40.0, 20.0
"""How long each run is, and what of it is left out: memories begin nearly full."""
SEED = 7
_SVG_HEAD = '<svg xmlns="http://www.w3.org/2000/svg" style="background:#fff;color:#111" '


def cached_places(city: City, memory_bytes: float = TOKEN_MEMORY_BYTES) -> int:
    """Of how many places the tokens fit into the memory."""
    return int(memory_bytes / (TOKEN_BYTES * city.references_per_place))


def of_memory(city: City) -> Chart:
    """Hit rate against the memory of a device."""
    gigabytes = (5.0, 20.0, 50.0, 100.0)
    shares = np.outer(city.scene_shares(), city.place_shares()).ravel()
    curves = [
        Curve(
            routing.value,
            tuple(
                (
                    size,
                    100
                    * _settled_hits(
                        simulate(
                            city,
                            Fleet(DEVICES, cached_places(city, 1e9 * size), routing, districts=DISTRICTS),
                            SECONDS,
                            SEED,
                        )
                    ),
                )
                for size in gigabytes
            ),
            marked=True,
        )
        for routing in (Routing.SCENE_BOUNDED, Routing.LOAD)
    ]
    for label, devices in (("as one memory (Che)", DEVICES), ("one device, whole city (Che)", 1)):
        rates = [
            (size, 100 * expected_hit_rate(shares, devices * cached_places(city, 1e9 * size))) for size in gigabytes
        ]
        curves.append(Curve(label, tuple(rates), from_paper=True))
    x = Axis("memory for references' tokens in each device, GB", 5, 100, logarithmic=True)
    return Chart(
        f"Queries whose references are in memory, {DEVICES} devices", x, Axis("hit rate, %", 0, 100), tuple(curves)
    )


def of_balance(city: City) -> list[Chart]:
    """Hit rate and latency against the bound of the load, for coarse and fine scenes."""
    balances = (1.25, 1.5, 2.0, 3.0)
    runs = {
        scenes: [
            simulate(
                replace(city, scenes=scenes, places=city.scenes * city.places // scenes),
                Fleet(DEVICES, cached_places(city), balance=balance, districts=DISTRICTS),
                SECONDS,
                SEED,
            )
            for balance in balances
        ]
        for scenes in (city.scenes // 10, city.scenes)
    }
    x = Axis("what a device may have under way, in hundredths of the average", 125, 300)
    hits = _by_scenes(runs, balances, lambda run: 100 * _settled_hits(run))
    late = _by_scenes(runs, balances, lambda run: 1000 * _settled_p99_s(city, run))
    return [
        Chart("The bound of the load: hits", x, Axis("hit rate, %", 0, 100), hits),
        Chart(
            "The bound of the load: p99",
            x,
            Axis("p99 in the fullest district, ms", 100, 50_000, logarithmic=True),
            late,
        ),
    ]


def of_devices(city: City) -> Chart:
    """Latency against the number of devices."""
    counts = (112, 128, 144, 160, 176)
    curves = []
    for name, routing, districts in (
        (Routing.SCENE_BOUNDED.value, Routing.SCENE_BOUNDED, DISTRICTS),
        (Routing.LOAD.value, Routing.LOAD, DISTRICTS),
        ("by scene, undivided city", Routing.SCENE_BOUNDED, 1),
    ):
        fleets = [Fleet(n, cached_places(city), routing, districts=districts) for n in counts]
        p99_s = [_settled_p99_s(city, simulate(city, fleet, SECONDS, SEED), districts) for fleet in fleets]
        curves.append(Curve(name, tuple(zip(counts, (1000 * it for it in p99_s), strict=True)), marked=True))
    rate_per_s = city.queries_per_s * fullest_district(city, DISTRICTS)[1]
    for spread in (0.16, 0.6):
        points = [(n, 1000 * _one_queue(rate_per_s, n // DISTRICTS, spread)) for n in counts]
        curves.append(Curve(f"one queue, sigma {spread:g}", tuple(points), from_paper=True))
    waits = [waiting_quantile_s(n // DISTRICTS, rate_per_s, GPU_S_PER_QUERY, 0.99) for n in counts]
    curves.append(
        Curve(
            "M/M/c: wait and mean",
            tuple((n, 1000 * (wait + GPU_S_PER_QUERY)) for n, wait in zip(counts, waits, strict=True)),
            from_paper=True,
        )
    )
    x = Axis(f"devices in {DISTRICTS} districts, for {city.queries_per_s:g} queries/s", counts[0], counts[-1])
    return Chart(
        "How many devices", x, Axis("p99 in the fullest district, ms", 50, 2000, logarithmic=True), tuple(curves)
    )


def of_a_loss(city: City) -> Chart:
    """Latency and hits in the fullest district while a machine is lost."""
    lost_at_s, window_s, seconds = 30.0, 2.5, 60.0
    curves = []
    for name, routing in (("by scene", Routing.SCENE_BOUNDED), ("by load", Routing.LOAD)):
        fleet = Fleet(DEVICES, cached_places(city), routing, districts=DISTRICTS)
        run = _in_the_fullest(city, simulate(city, fleet, seconds, SEED, NODE, lost_at_s))
        windows = (run.arrivals_s // window_s).astype(int)
        p99 = [np.quantile(run.latencies_s[windows == i], 0.99) for i in range(4, int(seconds / window_s))]
        hits = [run.hits[windows == i].mean() for i in range(4, int(seconds / window_s))]
        at = [window_s * (i + 0.5) - lost_at_s for i in range(4, int(seconds / window_s))]
        curves.append(Curve(f"p99, {name}", tuple(zip(at, (1000 * it for it in p99), strict=True))))
        curves.append(
            Curve(
                f"misses, {name}",
                tuple(zip(at, (1000 * (1 - it) for it in hits), strict=True)),
                from_paper=True,
            )
        )
    x = Axis(f"seconds since {NODE} of {DEVICES} devices were lost", -20, 30)
    return Chart("A machine is lost", x, Axis("fullest district: p99 in ms; misses of 1000", 0, 500), tuple(curves))


def of_ranking() -> Chart:
    """The time to rank a scene's references, as measured, and on from there."""
    (first, _), (last, last_ms) = RANKING_MS[0], RANKING_MS[-1]
    beyond = ((last, last_ms), (10 * last, 10 * last_ms))
    curves = (
        Curve("measured, one thread", RANKING_MS, marked=True),
        Curve("in proportion", beyond, from_paper=True),
    )
    x = Axis("references that are ranked for a query", first, 20 * last, logarithmic=True)
    return Chart("Retrieval", x, Axis("ms", 0.1, 10_000, logarithmic=True), curves)


def charts(city: City) -> Iterator[tuple[str, Chart]]:
    """Every chart with the name of its file."""
    yield "ranking", of_ranking()
    yield "memory", of_memory(city)
    hits, late = of_balance(city)
    yield "balance-hits", hits
    yield "balance-p99", late
    yield "devices", of_devices(city)
    yield "loss", of_a_loss(city)


def svg(chart: Chart) -> str:
    """A file that a browser shows by itself."""
    return draw(chart).replace("<svg ", _SVG_HEAD, 1) + "\n"


def _one_queue(rate_per_s: float, devices: int, spread: float) -> float:
    generator = np.random.default_rng(SEED)
    count = int(rate_per_s * SECONDS)
    gaps_s = generator.exponential(1 / rate_per_s, count)
    taken = latencies_s(devices, gaps_s, spread_services(GPU_S_PER_QUERY, spread, count, generator))
    return float(np.quantile(taken[count // 2 :], 0.99))


def _in_the_fullest(city: City, run: Outcome, districts: int = DISTRICTS) -> Outcome:
    return run.of_district(fullest_district(city, districts)[0], districts)


def _settled_hits(run: Outcome) -> float:
    return float(run.hits[run.arrivals_s >= SETTLED_S].mean())


def _settled_p99_s(city: City, run: Outcome, districts: int = DISTRICTS) -> float:
    its = _in_the_fullest(city, run, districts)
    return float(np.quantile(its.latencies_s[its.arrivals_s >= SETTLED_S], 0.99))


def _by_scenes(
    runs: dict[int, list[Outcome]], balances: Sequence[float], of: Callable[[Outcome], float]
) -> tuple[Curve, ...]:
    return tuple(
        Curve(
            f"{scenes:,} scenes",
            tuple(
                (100 * balance, value)
                for balance, run in zip(balances, each, strict=True)
                if math.isfinite(value := of(run))
            ),
            marked=True,
        )
        for scenes, each in runs.items()
    )
