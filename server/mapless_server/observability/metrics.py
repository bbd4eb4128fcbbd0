"""Every metric of the server: names, labels, buckets, and the events that change them.

Each server has a registry of its own, so that several can run in one process. No label has values that callers choose:
tenants and requests are in the log, and so are scenes, but for those with most photographs (`scraped.SceneAge`). Series
whose labels are known beforehand exist from the start, because a series that appears with its first event hides that
event from `rate`.
"""

import math
import sys
import time
from collections.abc import Callable, Iterable, Mapping

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    GCCollector,
    Histogram,
    PlatformCollector,
    disable_created_metrics,
)
from prometheus_client import ProcessCollector as ProcessMetrics

from mapless.v1 import localization_service_pb2, reference_service_pb2
from mapless_server.method.rejection import RejectionReason
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.scheduling import Ending, Observer, Refusal, StageLoad
from mapless_server.security import ENDLESS_METHODS

from .buckets import (
    BATCH_BUCKETS,
    CALL_BUCKETS,
    DEVIATION_BUCKETS,
    INLIER_BUCKETS,
    LAG_BUCKETS,
    PIXEL_BUCKETS,
    RADIUS_BUCKETS,
    RATIO_BUCKETS,
    SCENE_BUCKETS,
    STAGE_BUCKETS,
    WAIT_BUCKETS,
)
from .scraped import Scraped
from .series import OTHER, Children

STAGES = ("prepare", "coarse", "refine", "join", "describe", "retrieve", "audit", "coverage")
"""Stages of the queue."""

_LOOKED_UP = ("result", ("stored", "absent", "damaged"))
_ALONE = ("", ())

COUNTED: Mapping[str, tuple[str, str, tuple[str, ...]]] = {
    "stored_pairs": ("Pairs of references that queries looked for, by result.", *_LOOKED_UP),
    "stored_pairs_failures": ("Queries that could not look for stored pairs.", *_ALONE),
    "background_pairs": ("Pairs of references matched in the background.", *_ALONE),
    "background_cpu_seconds": (
        "Processor time of the threads that match references and make index files, without those of BLAS and torch.",
        *_ALONE,
    ),
    "background_failures": ("Failures of matching references and of making index files; each is tried again.", *_ALONE),
    "stored_depths": ("Depths of references that queries looked for.", *_LOOKED_UP),
    "depths": ("Depths of references that a network predicted, kept or dropped.", "result", ("kept", "dropped")),
    "depth_seconds": ("Time that this took.", *_ALONE),
    "depth_failures": ("Failures of making depths, or of looking for them; each is tried again.", *_ALONE),
    "calibrations": ("Scenes that were calibrated from their references.", *_ALONE),
    "calibration_cpu_seconds": ("Processor time of that, counted as the background matching's.", *_ALONE),
    "calibration_failures": ("Failures of calibrating a scene from its references; each is tried again.", *_ALONE),
    "adoptions": (
        "Localized photographs that their callers allow to become references, where scenes adopt.",
        "result",
        (
            *("adopted", "uncertain", "unsupported", "little_surveyed", "disagrees", "elsewhere", "nothing_new"),
            *("place_full", "changed", "queue", "failed"),
        ),
    ),
    "retirements": (
        "References that were retired, so that they are not chosen any more.",
        "reason",
        ("contradicted", "survey_outdated", "vouchers_gone", "place_full"),
    ),
    "adopted_expired": ("Adopted references that were deleted because of their age.", *_ALONE),
    "scene_counts_dropped": ("What reports of scenes lack: the store was away, or it could not be counted.", *_ALONE),
    "fatal": ("Faults that end the process.", *_ALONE),
    "captured": ("Calls that were captured.", *_ALONE),
    "capture_dropped": (
        "Calls that were to be captured and were not.",
        "reason",
        ("queue", "size", "disk", "fault"),
    ),
}
"""Counters that other rooms use by name: the counter's text, its label, and the label's values."""

WAITING = {
    "background_waiting": "References that wait to be matched in the background, as last counted.",
    "depth_waiting": "References that wait for a network to predict their depth, as last counted.",
    "contradicting_scenes": "Scenes in use whose references do not agree with their poses.",
    "calibration_waiting": "Scenes that changed since they were calibrated, as last counted.",
}
"""Gauges that other rooms set by name, with their text."""

LOCALIZED = "localized"
"""The outcome of an answer that is a pose."""

_CODES = (
    *("OK", "CANCELLED", "INVALID_ARGUMENT", "DEADLINE_EXCEEDED", "NOT_FOUND", "ALREADY_EXISTS", "PERMISSION_DENIED"),
    *("RESOURCE_EXHAUSTED", "INTERNAL", "UNAVAILABLE", "DATA_LOSS", "UNAUTHENTICATED"),
)
_MAX_ATTEMPTS = 1000
"""Above the number of rungs times that of outcomes."""


class Metrics(Observer, BackgroundObserver):
    """The metrics of one server. Implements also `rpc.guard.CallObserver`; never raises.

    Attributes:
        registry: registry of all metrics.
        scraped: the metrics that are read from other objects at every scrape.
        is_serving: the last value of `set_serving`; False before.
        not_serving_because: what the server does while it does not serve; empty where that is not known.
        beaten_s: time of the last `beat`, by `time.monotonic`; None before.
    """

    def __init__(self) -> None:
        disable_created_metrics()  # which would double the number of series
        self.registry = CollectorRegistry()
        ProcessMetrics(registry=self.registry)
        PlatformCollector(registry=self.registry)
        GCCollector(registry=self.registry)
        self.is_serving = False
        self.not_serving_because = ""
        self.beaten_s: float | None = None
        self.scraped = Scraped()
        self.registry.register(self.scraped)
        self._make_call_metrics()
        self._make_queue_metrics()
        self._make_answer_metrics()
        self._make_server_metrics()

    # Calls

    def call_started(self, method: str) -> None:
        """A call arrived; `method` is "/package.Service/Method"."""
        self._started(*self._methods.get(method, (OTHER, OTHER))).inc()

    def call_handled(self, method: str, code: str, seconds: float, trace_id: str = "") -> None:
        """A call ended with a gRPC status; the trace's id becomes the exemplar."""
        service_and_name = self._methods.get(method, (OTHER, OTHER))
        self._handled(*service_and_name, code).inc()
        if method in ENDLESS_METHODS:
            return  # it lasts as long as its caller watches, which is no latency
        exemplar = {"trace_id": trace_id} if trace_id else None
        self._handling(*service_and_name).observe(seconds, exemplar)

    # The queue

    def admitted(self, cost_s: float) -> None:
        """Implements Observer."""
        self._admitted.inc()
        self._admitted_cost.inc(max(0.0, cost_s))

    def refused(self, reason: Refusal) -> None:
        """Implements Observer."""
        self._refused(reason.value).inc()

    def watch_queue(self, load: Callable[[str], StageLoad]) -> None:
        """Registers a function that returns the load of a stage of the queue, called at every scrape."""

        def read(stage: str, part: int) -> Callable[[], float]:
            return lambda: load(stage)[part]

        for stage in STAGES:
            for part, gauge in enumerate((self._depth, self._cost, self._inflight)):  # as in `StageLoad`
                gauge.labels(stage).set_function(read(stage, part))

    def waited(self, stage: str, seconds: float) -> None:
        """Implements Observer."""
        self._waited(stage).observe(seconds)

    def computed(self, stage: str, bucket: str, jobs: int, seconds: float) -> None:
        """Implements Observer."""
        self._batch_size(stage).observe(jobs)
        self._batch_seconds(stage).observe(seconds)
        self._batches(stage, bucket).inc()
        self._busy(stage).inc(max(0.0, seconds))

    def ended(self, stage: str, ending: Ending) -> None:
        """Implements Observer."""
        self._ended(stage, ending.value).inc()

    def beat(self) -> None:
        """The event loop and the scheduler are alive."""
        self.beaten_s = time.monotonic()
        self._heartbeat.set(time.time())

    # Answers

    def stages(self, stage_seconds: Mapping[str, float]) -> None:
        """Records the durations of an answer's stages.

        Those of a further search, with stronger features or of the photograph turned, are named "extractor/stage".
        """
        for name, seconds in stage_seconds.items():
            extractor, _, stage = name.rpartition("/")
            self._stage_seconds(stage, "1" if extractor else "0").observe(seconds)

    def tracked(self, suffices: bool) -> None:
        """A query has a pose prior that may say which references are near; whether these sufficed."""
        self._tracking("tracked" if suffices else "searched").inc()

    def searched(self, scene_count: int) -> None:
        """A photograph was looked for in so many scenes, several."""
        self._scenes.observe(scene_count)

    def attempted(self, rung: str, outcome: str) -> None:
        """An attempt at an answered query's pose ended."""
        self._attempts(rung, outcome).inc()

    def answered_early(self, seconds: float) -> None:
        """A call got its first answer, which a better one may follow, this long after it arrived."""
        self._early_answer.observe(seconds)

    def answered(
        self,
        outcome: str,
        *,
        inlier_count: int | None = None,
        match_count: int | None = None,
        reprojection_error_px: float | None = None,
        scale_deviation: float | None = None,
        accuracy_radius_m: float | None = None,
    ) -> None:
        """A query was answered.

        Args:
            outcome: LOCALIZED or the value of a RejectionReason.
            inlier_count: 2D-3D matches that agree with the pose; None if they were not counted.
            match_count: 2D-3D matches from which the pose was estimated.
            reprojection_error_px: median of the inliers.
            scale_deviation: relative deviation of the scaled trajectory.
            accuracy_radius_m: the reported 68 % radius.
        """
        self._answers(outcome if outcome in self._outcomes else OTHER).inc()
        _observe(self._inliers, inlier_count)
        if match_count and inlier_count is not None:
            _observe(self._inlier_ratio, inlier_count / match_count)
        _observe(self._reprojection_error, reprojection_error_px)
        _observe(self._scale_deviation, scale_deviation)
        _observe(self._accuracy_radius, accuracy_radius_m)

    # The server

    def loop_lagged(self, seconds: float) -> None:
        """The event loop ran a timer this much late."""
        self._lag.observe(seconds)

    def stored(self, operation: str, seconds: float) -> None:
        """An operation of the store ended."""
        self._store_seconds(operation).observe(seconds)

    def store_failed(self) -> None:
        """An operation of the store failed by a fault that is not the caller's."""
        self._store_errors.inc()

    def count(self, name: str, amount: float = 1.0, result: str = "") -> None:
        """Adds to one of the counters of `COUNTED`."""
        counter = self._counted[name]
        (counter.labels(result) if result else counter).inc(max(0.0, amount))

    def waiting(self, name: str, count: int) -> None:
        """Sets one of the gauges of `WAITING`."""
        self._waiting[name].set(count)

    def ran_out_of_memory(self) -> None:
        """The device had no memory left for a batch."""
        self._oom.inc()

    def watch_captures(self, read: Callable[[], int]) -> None:
        """Registers a function that returns the size of captured calls on the disk, bytes, called at every scrape."""
        self._capture_enabled.set(1)
        self._capture_bytes.set_function(read)

    def set_serving(self, is_serving: bool) -> None:
        """Sets the health of the server as a whole."""
        self.is_serving = is_serving
        self._serving.set(is_serving)

    def warmed_up(self, seconds: float) -> None:
        """The warm-up ended and took this long."""
        self._warm_up.set(seconds)

    def built(self, version: str, backend: str, features: str, weights_sha256: str) -> None:
        """Sets version, backend, features and weights of the server; called once."""
        self._build.labels(version, backend, features, weights_sha256).set(1)

    def _make_call_metrics(self) -> None:
        labels = ["grpc_service", "grpc_method"]
        services = [
            service
            for file in (localization_service_pb2, reference_service_pb2)
            for service in file.DESCRIPTOR.services_by_name.values()
        ]
        self._methods: dict[str, tuple[str, str]] = {
            f"/{service.full_name}/{method.name}": (service.full_name, method.name)
            for service in services
            for method in service.methods
        }
        known = list(self._methods.values())
        finite = [labelled for method, labelled in self._methods.items() if method not in ENDLESS_METHODS]
        codes = [(*method, code) for method in known for code in _CODES]
        self._started = Children(self._counter("grpc_server_started", "Calls that arrived.", labels), known)
        handled = self._counter("grpc_server_handled", "Calls that ended, by status.", [*labels, "grpc_code"])
        self._handled = Children(handled, codes)
        text = "Time from arrival to answer; of endless streams none."
        handling = self._histogram("grpc_server_handling_seconds", text, CALL_BUCKETS, labels)
        self._handling = Children(handling, finite)

    def _make_queue_metrics(self) -> None:
        stage = ["stage"]
        stages = [(name,) for name in STAGES]
        counter, gauge, histogram = self._counter, self._gauge, self._histogram
        self._admitted = counter("mapless_admitted", "Jobs admitted to the queue.")
        self._admitted_cost = counter("mapless_admitted_cost_seconds", "Computing time predicted for admitted jobs.")
        refused = counter("mapless_admission_rejected", "Jobs not admitted, by reason.", ["reason"])
        self._refused = Children(refused, [(reason.value,) for reason in Refusal])
        waited = histogram("mapless_queue_wait_seconds", "Time that jobs waited for a stage.", WAIT_BUCKETS, stage)
        self._waited = Children(waited, stages)
        self._depth = gauge("mapless_queue_depth", "Jobs that wait.", stage)
        self._cost = gauge("mapless_queue_cost_seconds", "Computing time predicted for jobs that wait.", stage)
        self._inflight = gauge("mapless_inflight", "Jobs that are computed.", stage)
        self.watch_queue(lambda _: StageLoad(0, 0.0, 0))
        ended = counter("mapless_jobs_terminated", "Admitted jobs that ended.", ["stage", "outcome"])
        self._ended = Children(ended, [(name, ending.value) for name in STAGES for ending in Ending])
        self._batch_size = Children(histogram("mapless_batch_size", "Jobs in a batch.", BATCH_BUCKETS, stage), stages)
        seconds = histogram("mapless_batch_seconds", "Computing time of a batch.", STAGE_BUCKETS, stage)
        self._batch_seconds = Children(seconds, stages)
        self._batches = Children(counter("mapless_batches", "Batches, by shape.", ["stage", "bucket"]))
        busy = counter("mapless_busy_seconds", "Time in which the device or a worker computed.", stage)
        self._busy = Children(busy, stages)
        self._heartbeat = gauge("mapless_scheduler_heartbeat_timestamp_seconds", "When the scheduler was last alive.")

    def _make_answer_metrics(self) -> None:
        histogram = self._histogram
        self._outcomes = {LOCALIZED, *(reason.value for reason in RejectionReason)}
        answers = self._counter("mapless_answers", "Answers, by outcome.", ["outcome"])
        self._answers = Children(answers, [(outcome,) for outcome in sorted(self._outcomes)])
        attempts = self._counter("mapless_attempts", "Attempts at the poses of answered queries.", ["rung", "outcome"])
        self._attempts = Children(attempts, unknown=_MAX_ATTEMPTS)
        self._stage_seconds = Children(
            histogram("mapless_stage_seconds", "Time of a stage of the method.", STAGE_BUCKETS, ["stage", "tier"])
        )
        text = "Queries with a pose prior that may say which references are near: tracked, or searched in full."
        tracking = self._counter("mapless_tracking", text, ["outcome"])
        self._tracking = Children(tracking, [("tracked",), ("searched",)])
        text = "Time from arrival to a first answer that a better one may follow."
        self._early_answer = histogram("mapless_early_answer_seconds", text, CALL_BUCKETS)
        self._scenes = histogram("mapless_searched_scenes", "Scenes of a query among several.", SCENE_BUCKETS)
        self._inliers = histogram("mapless_inliers", "2D-3D matches that agree with a pose.", INLIER_BUCKETS)
        self._inlier_ratio = histogram("mapless_inlier_ratio", "Inliers of all 2D-3D matches.", RATIO_BUCKETS)
        text = "Median reprojection error of the inliers."
        self._reprojection_error = histogram("mapless_reprojection_error_px", text, PIXEL_BUCKETS)
        text = "Relative deviation of the scaled trajectory."
        self._scale_deviation = histogram("mapless_scale_deviation", text, DEVIATION_BUCKETS)
        text = "Reported radius that holds 68 % of positions, metres."
        self._accuracy_radius = histogram("mapless_accuracy_radius_metres", text, RADIUS_BUCKETS)

    def _make_server_metrics(self) -> None:
        counter, gauge, histogram = self._counter, self._gauge, self._histogram
        self._lag = histogram("mapless_event_loop_lag_seconds", "How late timers of the loop ran.", LAG_BUCKETS)
        stored = histogram("mapless_store_op_seconds", "Time of the store's operations.", STAGE_BUCKETS, ["op"])
        self._store_seconds = Children(stored)
        self._store_errors = counter("mapless_store_errors", "Operations of the store that failed by a fault of ours.")
        self._counted = {
            name: counter(f"mapless_{name}", text, [label] if label else ())
            for name, (text, label, _) in COUNTED.items()
        }
        for name, (_, _, values) in COUNTED.items():
            for value in values:
                self._counted[name].labels(value)
        self._waiting = {name: gauge(f"mapless_{name}", text) for name, text in WAITING.items()}
        self._oom = counter("mapless_gpu_oom", "Batches that the device had no memory for.")
        self._capture_enabled = gauge("mapless_capture_enabled", "1 if calls are captured, with photographs, else 0.")
        self._capture_bytes = gauge("mapless_capture_bytes", "What captured calls take on the disk.")
        self._serving = gauge("mapless_health_serving", "1 if health reports SERVING, else 0.")
        self._warm_up = gauge("mapless_warmup_seconds", "Time of the warm-up; 0 if there was none.")
        blocks = gauge("mapless_python_allocated_blocks", "Pieces of memory that Python's objects hold.")
        blocks.set_function(sys.getallocatedblocks)
        self._build = gauge("mapless_build_info", "1; what runs.", ["version", "backend", "features", "weights_sha256"])

    def _counter(self, name: str, text: str, labels: Iterable[str] = ()) -> Counter:
        return Counter(name, text, labels, registry=self.registry)  # the library adds _total

    def _gauge(self, name: str, text: str, labels: Iterable[str] = ()) -> Gauge:
        return Gauge(name, text, labels, registry=self.registry)

    def _histogram(self, name: str, text: str, buckets: Iterable[float], labels: Iterable[str] = ()) -> Histogram:
        return Histogram(name, text, labels, registry=self.registry, buckets=tuple(buckets))


def _observe(histogram: Histogram, value: float | None) -> None:
    if value is not None and math.isfinite(value):  # one NaN would make the histogram's sum NaN for good
        histogram.observe(value)
