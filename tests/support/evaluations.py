"""Planted results of evaluated queries."""

import math
from typing import Any

from mapless import Accuracy
from mapless_tools.dataset import Dataset
from mapless_tools.evaluate.metrics import QueryResult
from mapless_tools.evaluate.plan import EvaluationOptions
from mapless_tools.evaluate.run import Evaluation


def query_result(
    name: str, translation: float, rotation_deg: float, inliers: tuple[int, int], message: str, **fields: Any
) -> QueryResult:
    """With such errors, and so many inliers of so many matches; one that missed where the first error is infinite."""
    missed = math.isinf(translation)
    common: dict[str, Any] = {"references": ("r0", "r1"), "reference_distance": 1.0, "latency_ms": 100.0}
    common |= {"stage_ms": {"decode": 1.0, "pnp": 3.0}, "backend": "geometric", "features": "sift"}
    return QueryResult(
        name=name,
        translation_error=translation,
        rotation_error_deg=math.inf if missed else rotation_deg,
        accuracy=None if missed else Accuracy(0.01, 0.02, 0.1, 0.2, calibrated=False),
        inlier_count=0 if missed else inliers[0],
        match_count=0 if missed else inliers[1],
        rejection="LOW_OVERLAP" if missed else "",
        message=message if missed else "",
        **(common | fields),
    )


def evaluation(*results: QueryResult, metric: bool = True, references: int | None = None) -> Evaluation:
    """An evaluation of a folder whose references have a trajectory of radius 4."""
    dataset = Dataset("kitchen", (), metric, "survey")
    return Evaluation(dataset, EvaluationOptions(references), 30, 4.0, results)
