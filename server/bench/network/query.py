"""Whole queries on photographs of the rendered room: K = 10 stored references, everything in this process.

A query is everything from the encoded photograph to the answer: decoding, features, matching, network, scale,
refinement. Protocol and store, which a call adds, are not included.
"""

import hashlib
import statistics
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch

from mapless_server.engine.query import Tier
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.coarse.network import NetworkReconstructor
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.views import Photograph, PosedView
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.localize import localize
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pipeline import Pipeline
from mapless_server.networks.runner import NetworkRunner
from mapless_server.networks.weights import WeightsError
from mapless_server.serve.features import make_tiers
from mapless_server.settings import load_settings
from mapless_tools.demo import Photograph as Picture
from mapless_tools.demo import depth_map_m, room

from .operations import compiled_graphs
from .planted import PlantedReconstructor, Truth
from .report import Figure
from .subject import REFERENCES

LATENCY_MS, QUERIES_PER_S = 150.0, 12.0
THREADS = 8
"""Queries side by side when it is how many a second that counts; the network takes them one after the other."""


FEATURES, ROUNDS = "aliked", 3
"""SIFT is used if the weights of these features are missing."""


@dataclass(frozen=True, eq=False)
class Room:
    """Photographs of the demo's room by the SHA-256 of their data."""

    references: dict[str, Picture]
    queries: dict[str, Picture]


def photographs(query_count: int) -> Room:
    """Returns all references, and some queries."""
    place = room()
    references, queries = (
        {hashlib.sha256(it.data).hexdigest(): it for it in some} for some in (place.references, place.queries)
    )
    return Room(references, dict(list(queries.items())[:query_count]))


def make_tier(features: str, device: torch.device) -> tuple[Tier, str]:
    """Makes features with their matcher, and a note about them."""

    def made(name: str) -> Tier:
        flags = {"features": name, "backend": "geometric", "device": str(device)}
        return make_tiers(load_settings(flags).settings)[0]

    try:
        return made(features), f"features {features}"
    except (WeightsError, ImportError) as error:
        return made("sift"), f"features sift, since {features} cannot be had: {error}"


class Bench:
    """Everything that a query needs, in memory."""

    def __init__(self, room: Room, tier: Tier) -> None:
        self.room = room
        self.tier = tier
        self._stored = {key: self._store(key, photo, tier.extractor) for key, photo in room.references.items()}

    def _store(self, key: str, photo: Picture, extractor: FeatureExtractor) -> PosedView:
        pixels = decode_image(photo.data, ImageLimits())
        view = replace(
            extractor.extract(pixels, photo.camera), photograph=Photograph(lambda: key, photo.camera, lambda: pixels)
        )
        return PosedView(key, photo.name, view, photo.world_from_camera)

    def nearest(self, photo: Picture) -> list[PosedView]:
        """The ten references whose cameras are nearest."""
        centre = photo.world_from_camera.translation

        def distance(view: PosedView) -> float:
            return float(np.linalg.norm(view.world_from_camera.translation - centre))

        return sorted(self._stored.values(), key=distance)[:REFERENCES]

    def localize(self, key: str, pipeline: Pipeline) -> tuple[Answer, dict[str, float]]:
        """Localizes one photograph; returns the answer, and the seconds of each stage and of all ("total")."""
        photo, stages = self.room.queries[key], {}
        start_s = time.perf_counter()
        pixels = decode_image(photo.data, ImageLimits())
        stages["decode"] = time.perf_counter() - start_s
        view = self.tier.extractor.extract(pixels, photo.camera)
        stages["features"] = time.perf_counter() - start_s - stages["decode"]
        view = replace(view, photograph=Photograph(lambda: key, photo.camera, lambda: pixels))
        answer = localize(view, self.nearest(photo), pipeline, LocalizeOptions())
        return answer, {**stages, **answer.stage_seconds, "total": time.perf_counter() - start_s}


def measure_queries(runner: NetworkRunner, bench: Bench, note: str) -> Iterator[Figure]:
    """Measures latency, stages and throughput on a planted reconstruction, and with the random network's own output."""
    features = bench.tier.extractor.name.split("-")[0]
    part = f"{runner.name} query, {features}, K = {REFERENCES}"
    network = NetworkReconstructor(runner)
    truths = {
        key: Truth(photo.camera, photo.world_from_camera, depth_map_m(photo.name))
        for key, photo in (bench.room.references | bench.room.queries).items()
    }
    planted = Pipeline(PlantedReconstructor(network, truths), bench.tier.pipeline.matcher)
    _runs(bench, planted, 1)  # fills caches
    graphs = compiled_graphs()
    runs, again = (_runs(bench, planted, ROUNDS) for _ in range(2))
    outcomes = f"{_outcomes([*runs, *again])}; {note}"
    yield Figure(part, "p50", _p50_ms(runs), "ms", _p50_ms(again), target=LATENCY_MS, note=outcomes)
    localized = [isinstance(answer.outcome, Localization) for answer, _ in (*runs, *again)]
    yield Figure(part, "localized", 100 * statistics.mean(localized), "%")
    yield from _stages(part, [*runs, *again])
    yield _throughput(part, bench, planted)
    alone = _runs(bench, Pipeline(network, bench.tier.pipeline.matcher), 1)
    yield Figure(part, "p50, the random network's own answer", _p50_ms(alone), "ms", note=_outcomes(alone))
    yield Figure(part, "compiled after the warm-up", compiled_graphs() - graphs, "graphs", target=0)


Runs = Sequence[tuple[Answer, dict[str, float]]]


def _runs(bench: Bench, pipeline: Pipeline, rounds: int) -> Runs:
    return [bench.localize(key, pipeline) for _ in range(rounds) for key in bench.room.queries]


def _stages(part: str, runs: Runs) -> Iterator[Figure]:
    stages: dict[str, list[float]] = defaultdict(list)
    for _, seconds in runs:
        for stage, value in seconds.items():
            stages[stage].append(value)
    for stage, values in stages.items():
        if stage != "total":
            yield Figure(part, f"of it {stage}, median", 1e3 * statistics.median(values), "ms")


def _p50_ms(runs: Runs) -> float:
    return 1e3 * statistics.median(seconds["total"] for _, seconds in runs)


def _outcomes(runs: Runs) -> str:
    outcomes = [answer.outcome for answer, _ in runs]
    names = ["localized" if isinstance(it, Localization) else it.reason.name for it in outcomes]
    return ", ".join(f"{names.count(name)} {name}" for name in sorted(set(names)))


def _throughput(part: str, bench: Bench, pipeline: Pipeline) -> Figure:
    keys = [*bench.room.queries] * (2 * ROUNDS)
    rates = []
    with ThreadPoolExecutor(THREADS) as pool:
        for _ in range(2):
            start_s = time.perf_counter()
            for _ in pool.map(lambda key: bench.localize(key, pipeline), keys):
                pass
            rates.append(len(keys) / (time.perf_counter() - start_s))
    name = f"sustained, {THREADS} threads"
    return Figure(part, name, rates[0], "queries/s", rates[1], target=QUERIES_PER_S, target_is_least=True)
