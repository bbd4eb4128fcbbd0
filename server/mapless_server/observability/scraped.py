"""Values of other objects, read when Prometheus scrapes, in the thread that answers it."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

if TYPE_CHECKING:
    from mapless_server.method.coarse.token_cache import TokenCacheCounters
    from mapless_server.store import LruCache

log = logging.getLogger(__name__)


class SceneAge(NamedTuple):
    """How a scene ages; of the last seven days, all servers together.

    Attributes:
        name: its key, "scene" or "tenant/scene".
        photographs: photographs that were answered.
        localized_share: share of them that were localized.
        localized_share_before: the same of the seven days before; None without any.
        survey_left: least share of the survey that is left at a place; None where that is not known.
        outdated_places: places that need a new survey.
        adopted_references: adopted references that are in use.
        retired_references: references that are retired.
    """

    name: str
    photographs: int
    localized_share: float
    localized_share_before: float | None
    survey_left: float | None
    outdated_places: int
    adopted_references: int
    retired_references: int


_OF_SCENES = {
    "photographs": "Photographs of a scene that were answered in the last seven days, by all servers of the store.",
    "localized_share": "Share of these that were localized.",
    "localized_share_before": "The same of the seven days before.",
    "survey_left": "Least share of the survey that is left at a place of the scene, where it adopts.",
    "outdated_places": "Places of the scene that need a new survey.",
    "adopted_references": "Adopted references of the scene that are in use.",
    "retired_references": "References of the scene that are retired.",
}
"""Gauges of the scenes with most photographs, in the order of `SceneAge`."""


class Scraped(Collector):
    """Calls the functions that are set; the metrics of a function that is not set, or fails, have no value.

    Attributes:
        reference_cache: returns the cache of references' features.
        retrieval_index: returns the size of the scenes in memory, bytes.
        index_files: returns the sizes of the index files in use, bytes.
        token_cache: returns the counters of the cache of references' tokens.
        gpu_memory: returns bytes by kind: allocated, reserved, peak.
        certificate_expiry: returns when the certificate expires, Unix seconds.
        connections: returns the number of open connections.
        most_connections: returns how many there may be.
        scenes: how the scenes with most photographs age.
    """

    def __init__(self) -> None:
        self.reference_cache: Callable[[], LruCache[Any]] | None = None
        self.retrieval_index: Callable[[], int] | None = None
        self.index_files: Callable[[], Sequence[int]] | None = None
        self.token_cache: Callable[[], TokenCacheCounters] | None = None
        self.gpu_memory: Callable[[], Mapping[str, float]] | None = None
        self.certificate_expiry: Callable[[], float] | None = None
        self.connections: Callable[[], int] | None = None
        self.most_connections: Callable[[], int] | None = None
        self.scenes: Sequence[SceneAge] = ()

    def describe(self) -> Iterable[Metric]:
        """Implements Collector: only the names, when it is registered."""
        return Scraped().collect()

    def collect(self) -> Iterable[Metric]:
        """Implements Collector."""
        of_caches = self._reference_cache, self._retrieval_index, self._index_files, self._token_cache
        for add_to in (*of_caches, self._gpu_memory, self._certificate, self._connections, self._scenes):
            metrics: dict[str, Metric] = {}
            try:
                add_to(metrics)
            except Exception:  # the other metrics are still of use
                log.exception("the metrics %s could not be read", ", ".join(metrics))
            yield from metrics.values()

    def _reference_cache(self, metrics: dict[str, Metric]) -> None:
        hits = _counter(metrics, "mapless_reference_cache_hits", "References found in memory.")
        misses = _counter(metrics, "mapless_reference_cache_misses", "References read from the store.")
        evictions = _counter(metrics, "mapless_reference_cache_evictions", "References removed from memory for others.")
        size = _gauge(metrics, "mapless_reference_cache_bytes", "Size of the references held in memory.")
        if self.reference_cache is not None:
            cache = self.reference_cache()
            hits.add_metric([], cache.hits)
            misses.add_metric([], cache.misses)
            evictions.add_metric([], cache.evictions)
            size.add_metric([], cache.used)

    def _retrieval_index(self, metrics: dict[str, Metric]) -> None:
        size = _gauge(metrics, "mapless_retrieval_index_bytes", "Size of the scenes held to choose references by.")
        if self.retrieval_index is not None:
            size.add_metric([], self.retrieval_index())

    def _index_files(self, metrics: dict[str, Metric]) -> None:
        count = _gauge(
            metrics, "mapless_retrieval_index_files", "Large scenes in use that are searched by an index file."
        )
        size = _gauge(metrics, "mapless_retrieval_index_file_bytes", "Size of these files on the disk.")
        if self.index_files is not None:
            sizes = self.index_files()
            count.add_metric([], len(sizes))
            size.add_metric([], sum(sizes))

    def _token_cache(self, metrics: dict[str, Metric]) -> None:
        hits = _counter(metrics, "mapless_token_cache_hits", "Tokens found, by where.", ["tier"])
        misses = _counter(metrics, "mapless_token_cache_misses", "Tokens that had to be computed.")
        evictions = _counter(metrics, "mapless_token_cache_evictions", "Tokens removed for others.")
        size = _gauge(metrics, "mapless_token_cache_bytes", "Size of the tokens held.", ["tier"])
        if self.token_cache is not None:
            counters = self.token_cache()
            hits.add_metric(["device"], counters.device_hits)
            hits.add_metric(["host"], counters.host_hits)
            misses.add_metric([], counters.misses)
            evictions.add_metric([], counters.evictions)
            size.add_metric(["device"], counters.device_bytes)
            size.add_metric(["host"], counters.host_bytes)

    def _gpu_memory(self, metrics: dict[str, Metric]) -> None:
        memory = _gauge(metrics, "mapless_gpu_memory_bytes", "Memory of the device that this process uses.", ["kind"])
        for kind, size in (self.gpu_memory() if self.gpu_memory is not None else {}).items():
            memory.add_metric([kind], size)

    def _certificate(self, metrics: dict[str, Metric]) -> None:
        name = "mapless_tls_certificate_expiry_timestamp_seconds"
        expiry = _gauge(metrics, name, "When the server's certificate expires.")
        if self.certificate_expiry is not None:
            expiry.add_metric([], self.certificate_expiry())

    def _connections(self, metrics: dict[str, Metric]) -> None:
        text = "Open connections to the port of calls, also those without a token."
        count = _gauge(metrics, "mapless_open_connections", text)
        most = _gauge(metrics, "mapless_max_connections", "How many there may be; further ones are refused.")
        if self.connections is not None:
            count.add_metric([], self.connections())
        if self.most_connections is not None:
            most.add_metric([], self.most_connections())

    def _scenes(self, metrics: dict[str, Metric]) -> None:
        gauges = [_gauge(metrics, f"mapless_scene_{name}", text, ["scene"]) for name, text in _OF_SCENES.items()]
        for scene in self.scenes:
            for gauge, value in zip(gauges, scene[1:], strict=True):
                if value is not None:
                    gauge.add_metric([scene.name], value)


def _counter(metrics: dict[str, Metric], name: str, text: str, labels: Iterable[str] = ()) -> CounterMetricFamily:
    family = metrics[name] = CounterMetricFamily(name, text, labels=list(labels))
    return family


def _gauge(metrics: dict[str, Metric], name: str, text: str, labels: Iterable[str] = ()) -> GaugeMetricFamily:
    family = metrics[name] = GaugeMetricFamily(name, text, labels=list(labels))
    return family


def gpu_memory() -> dict[str, float]:
    """Memory of the CUDA device in use, bytes by kind; empty without one. Does not import torch."""
    cuda = getattr(sys.modules.get("torch"), "cuda", None)  # not there yet while another thread imports torch
    if cuda is None or not cuda.is_initialized():
        return {}
    return {
        "allocated": cuda.memory_allocated(),
        "reserved": cuda.memory_reserved(),
        "peak": cuda.max_memory_allocated(),
    }
