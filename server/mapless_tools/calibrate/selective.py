"""Accepting some answers and not others: how well a score tells right ones from wrong ones.

*Risk-coverage* is the standard picture of selective prediction (El-Yaniv and Wiener, JMLR 2010): answers are accepted
from the highest score down; coverage is the share of the right ones accepted so far, risk the share of wrong ones among
those accepted. A score that is no better than chance has the same risk everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import rankdata


@dataclass(frozen=True)
class Operating:
    """What accepting every answer with at least a score comes to.

    Attributes:
        score: the smallest accepted.
        coverage: share of the right answers that are accepted.
        risk: share of wrong ones among the accepted.
        accepted: how many are.
        wrong: how many of these are wrong.
    """

    score: float
    coverage: float
    risk: float
    accepted: int
    wrong: int


def auroc(scores: Sequence[float], right: Sequence[bool]) -> float:
    """Probability that a right answer has a higher score than a wrong one; equal scores count half.

    The area under the receiver's curve, as the Mann-Whitney statistic. NaN where all are right or none is.
    """
    is_right = np.asarray(right, bool)
    rights, wrongs = int(is_right.sum()), int((~is_right).sum())
    if not rights or not wrongs:
        return math.nan
    ranks = rankdata(np.asarray(scores, float))
    return float((ranks[is_right].sum() - rights * (rights + 1) / 2) / (rights * wrongs))


def risk_coverage(scores: Sequence[float], right: Sequence[bool]) -> list[Operating]:
    """An operating point for each different score, the highest first; answers of equal score are accepted together."""
    order = np.argsort(-np.asarray(scores, float), kind="stable")
    sorted_scores, is_right = np.asarray(scores, float)[order], np.asarray(right, bool)[order]
    all_right = max(1, int(is_right.sum()))
    points = []
    for i in range(len(order)):
        if i + 1 < len(order) and sorted_scores[i + 1] == sorted_scores[i]:
            continue
        rights = int(is_right[: i + 1].sum())
        wrong = i + 1 - rights
        points.append(Operating(float(sorted_scores[i]), rights / all_right, wrong / (i + 1), i + 1, wrong))
    return points
