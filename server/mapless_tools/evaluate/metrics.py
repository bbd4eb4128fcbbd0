"""Errors, recall and latency of an evaluation. A query that was not localized has infinite errors."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapless import Accuracy, Attempt, IntrinsicsCheck
from mapless.geometry import Array, RigidTransform, rotation_angle_deg

RECALL_BARS = {"1cm_1deg": (0.01, 1.0), "5cm_5deg": (0.05, 5.0), "25cm_2deg": (0.25, 2.0)}
"""Names of the field's usual bars: metres and degrees, both inclusive."""


@dataclass(frozen=True)
class EarlierAnswer:
    """An accepted answer that the server had before it made a better one: the attempt's rung, and the errors."""

    rung: str
    translation_error: float
    rotation_error_deg: float


@dataclass(frozen=True)
class QueryResult:
    """The result of one query; a rejected one has infinite errors, counts of 0, and no pose.

    Lengths are in the dataset's unit; `reference_distance` is the median distance from the true camera centre to
    those of its references. The accuracy has the claimed radii, positions in the dataset's unit; None without a
    pose, or for a pose without radii, as is trust. Intrinsics checks are those of the answer, or of the rejection.
    The latency is measured by the client, `stage_ms`, `processor_ms` and those of attempts in the server. The best
    reference has the most inliers. The pose is the answered world_from_camera: x y z and the quaternion x y z w.
    Earlier answers are those that were accepted before the last, in order.
    """

    name: str
    references: tuple[str, ...]
    translation_error: float
    rotation_error_deg: float
    reference_distance: float
    inlier_count: int
    match_count: int
    rejection: str
    message: str
    latency_ms: float
    stage_ms: Mapping[str, float]
    backend: str
    features: str
    best_reference: str = ""
    pose: tuple[float, ...] | None = None
    accuracy: Accuracy | None = None
    trust: float | None = None
    intrinsics_checks: tuple[IntrinsicsCheck, ...] = ()
    processor_ms: float = 0.0
    attempts: tuple[Attempt, ...] = ()
    earlier: tuple[EarlierAnswer, ...] = ()

    @property
    def localized(self) -> bool:
        """Whether there is a pose."""
        return not self.rejection


@dataclass(frozen=True)
class Summary:
    """All queries together. Medians, p90 and recall are over all queries, infinite if too many were rejected.

    Translations are in the dataset's unit; `median_relative` is over the distance to the query's references.
    `claim_held` and `claim_95_held` are the shares of claimed radii of positions that held, None if nothing was
    claimed. p50 and p95 are without the first call, which has empty caches, if there are more; the processor times are
    means over all, over localized and over rejected queries, None without any. Several `features` have answers if
    stronger ones are tried.
    """

    query_count: int
    localized_count: int
    median_translation: float
    median_rotation_deg: float
    p90_translation: float
    median_relative: float
    recall: Mapping[str, float]
    claim_held: float | None
    claim_95_held: float | None
    latency_p50_ms: float
    latency_p95_ms: float
    latency_first_ms: float
    processor_ms: float
    processor_localized_ms: float | None
    processor_rejected_ms: float | None
    stage_share: Mapping[str, float]
    rejections: Mapping[str, int]
    features: Mapping[str, int]


def pose_error(true: RigidTransform, answered: RigidTransform) -> tuple[float, float]:
    """Distance of two cameras' centres, in their unit, and the angle between their orientations, degrees."""
    return (
        float(np.linalg.norm(true.translation - answered.translation)),
        rotation_angle_deg(true.rotation.T @ answered.rotation),
    )


def summarize(results: Sequence[QueryResult]) -> Summary:
    """The summary of at least one result."""
    translations = [r.translation_error for r in results]
    rotations = [r.rotation_error_deg for r in results]
    claims = [(r.translation_error, r.accuracy) for r in results if r.accuracy is not None]
    latencies = [r.latency_ms for r in results]
    steady = latencies[1:] or latencies
    relative = [r.translation_error / r.reference_distance if r.reference_distance > 0 else math.inf for r in results]
    return Summary(
        query_count=len(results),
        localized_count=sum(r.localized for r in results),
        median_translation=quantile(translations, 0.5),
        median_rotation_deg=quantile(rotations, 0.5),
        p90_translation=quantile(translations, 0.9),
        median_relative=quantile(relative, 0.5),
        recall={
            name: sum(t <= metres and d <= degrees for t, d in zip(translations, rotations, strict=True)) / len(results)
            for name, (metres, degrees) in RECALL_BARS.items()
        },
        claim_held=_mean([error <= claimed.position_68_m for error, claimed in claims]),
        claim_95_held=_mean([error <= claimed.position_95_m for error, claimed in claims]),
        latency_p50_ms=quantile(steady, 0.5),
        latency_p95_ms=quantile(steady, 0.95),
        latency_first_ms=latencies[0],
        processor_ms=sum(r.processor_ms for r in results) / len(results),
        processor_localized_ms=_mean([r.processor_ms for r in results if r.localized]),
        processor_rejected_ms=_mean([r.processor_ms for r in results if not r.localized]),
        stage_share=stage_share(results),
        rejections=dict(Counter(r.rejection for r in results if not r.localized).most_common()),
        features=dict(Counter(r.features for r in results).most_common()),
    )


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def quantile(values: Sequence[float], share: float) -> float:
    """Quantile by linear interpolation; infinite if an infinite value contributes (NumPy's is NaN then)."""
    ordered = sorted(values)
    position = share * (len(ordered) - 1)
    lower, upper = ordered[math.floor(position)], ordered[math.ceil(position)]
    return upper if math.isinf(upper) else lower + (upper - lower) * (position - math.floor(position))


def stage_share(results: Sequence[QueryResult]) -> dict[str, float]:
    """Each stage's share in the time of all stages of all queries, in the order they run."""
    totals: dict[str, float] = {}
    for result in results:
        for stage, milliseconds in result.stage_ms.items():
            totals[stage] = totals.get(stage, 0.0) + milliseconds
    whole = sum(totals.values())
    return {stage: total / whole for stage, total in totals.items()} if whole > 0 else {}


def trajectory_radius(centres: Array) -> float:
    """Root mean square distance of camera centres (N, 3) from their centroid: the paper's r."""
    return float(np.sqrt(((centres - centres.mean(axis=0)) ** 2).sum(axis=1).mean()))
