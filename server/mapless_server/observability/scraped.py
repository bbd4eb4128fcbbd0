"""Figures that others keep and that are asked for when Prometheus comes, in the thread that answers it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from typing import Protocol

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

log = logging.getLogger(__name__)


class CacheCounts(Protocol):
    """What a cache did since it was made, and what it holds."""

    @property
    def hits(self) -> int:
        """Values found."""

    @property
    def misses(self) -> int:
        """Values asked for and not found."""

    @property
    def evictions(self) -> int:
        """Values forgotten for want of room."""

    @property
    def used_bytes(self) -> int:
        """Size of the values held."""


class TokenCacheCounts(Protocol):
    """The same of a cache with a level on the device and one in the host's memory."""

    @property
    def device_hits(self) -> int:
        """Values found on the device."""

    @property
    def host_hits(self) -> int:
        """Values found in the host's memory."""

    @property
    def misses(self) -> int:
        """Values asked for and found nowhere."""

    @property
    def evictions(self) -> int:
        """Values forgotten altogether for want of room."""

    @property
    def device_bytes(self) -> int:
        """Size of the values on the device."""

    @property
    def host_bytes(self) -> int:
        """Size of the values in the host's memory."""


class Scraped(Collector):
    """Asks whoever is named in its attributes; a metric nobody answers for is described, and has no value."""

    def __init__(self) -> None:
        self.reference_cache: Callable[[], CacheCounts] | None = None
        self.retrieval_index: Callable[[], int] | None = None
        self.token_cache: Callable[[], TokenCacheCounts] | None = None
        self.gpu_memory: Callable[[], Mapping[str, float]] | None = None
        self.certificate_expiry: Callable[[], float | None] | None = None

    def describe(self) -> Iterable[Metric]:
        """Implements Collector: names alone, when it is registered."""
        return Scraped().collect()

    def collect(self) -> Iterable[Metric]:
        """Implements Collector."""
        for family in (
            self._reference_cache,
            self._retrieval_index,
            self._token_cache,
            self._gpu_memory,
            self._certificate,
        ):
            metrics: dict[str, Metric] = {}
            try:
                family(metrics)
            except Exception:  # one who cannot answer must not blind the operator to all the others
                log.exception("figures for %s could not be read", ", ".join(metrics))
            yield from metrics.values()

    def _reference_cache(self, metrics: dict[str, Metric]) -> None:
        hits = _counter(metrics, "mapless_reference_cache_hits", "References found in memory.")
        misses = _counter(metrics, "mapless_reference_cache_misses", "References read from the store.")
        evictions = _counter(metrics, "mapless_reference_cache_evictions", "References forgotten for want of room.")
        size = _gauge(metrics, "mapless_reference_cache_bytes", "Size of the references held in memory.")
        if self.reference_cache is not None:
            counts = self.reference_cache()
            hits.add_metric([], counts.hits)
            misses.add_metric([], counts.misses)
            evictions.add_metric([], counts.evictions)
            size.add_metric([], counts.used_bytes)

    def _retrieval_index(self, metrics: dict[str, Metric]) -> None:
        size = _gauge(metrics, "mapless_retrieval_index_bytes", "Size of the scenes held to choose references by.")
        if self.retrieval_index is not None:
            size.add_metric([], self.retrieval_index())

    def _token_cache(self, metrics: dict[str, Metric]) -> None:
        hits = _counter(metrics, "mapless_token_cache_hits", "Tokens found, by where.", ["tier"])
        misses = _counter(metrics, "mapless_token_cache_misses", "Tokens that had to be computed.")
        evictions = _counter(metrics, "mapless_token_cache_evictions", "Tokens forgotten for want of room.")
        size = _gauge(metrics, "mapless_token_cache_bytes", "Size of the tokens held.", ["tier"])
        if self.token_cache is not None:
            counts = self.token_cache()
            hits.add_metric(["device"], counts.device_hits)
            hits.add_metric(["host"], counts.host_hits)
            misses.add_metric([], counts.misses)
            evictions.add_metric([], counts.evictions)
            size.add_metric(["device"], counts.device_bytes)
            size.add_metric(["host"], counts.host_bytes)

    def _gpu_memory(self, metrics: dict[str, Metric]) -> None:
        memory = _gauge(metrics, "mapless_gpu_memory_bytes", "Memory of the device that this process uses.", ["kind"])
        for kind, size in (self.gpu_memory() if self.gpu_memory is not None else {}).items():
            memory.add_metric([kind], size)

    def _certificate(self, metrics: dict[str, Metric]) -> None:
        name = "mapless_tls_certificate_expiry_timestamp_seconds"
        expiry = _gauge(metrics, name, "When the server's certificate expires.")
        expiry_s = self.certificate_expiry() if self.certificate_expiry is not None else None
        if expiry_s is not None:
            expiry.add_metric([], expiry_s)


def _counter(metrics: dict[str, Metric], name: str, text: str, labels: Iterable[str] = ()) -> CounterMetricFamily:
    family = metrics[name] = CounterMetricFamily(name, text, labels=list(labels))
    return family


def _gauge(metrics: dict[str, Metric], name: str, text: str, labels: Iterable[str] = ()) -> GaugeMetricFamily:
    family = metrics[name] = GaugeMetricFamily(name, text, labels=list(labels))
    return family
