"""(ours) Acceptance of a pose from one reference, by the score of its inliers."""

import numpy as np

from ..pose.one_reference import Found
from ..pose.pnp import MAX_LOG10_FALSE_ALARMS, format_false_alarms
from .judge import LEVELS

SCORES = (
    39.6, 39.6, 39.6, 39.8, 40.9, 58.2, 66.6, 127.2, 165.8, 185.0,
    272.3, 487.4, 628.0, 838.7, 945.9, 1291.4, 1647.3, 2464.5, 3837.8, 4685.0,
)  # fmt: skip
"""Quantiles, at `LEVELS`, of the scores of right answers (`Found.score`), of 138 pairs of photographs of nine places,
each of which counts alike, with depths triangulated from other photographs, an error of 3 % common to all of them and
of 5 % of each."""


def trust_of_score(score: float) -> float:
    """Share of right answers from one reference whose score is at most as high."""
    return float(np.interp(score, SCORES, LEVELS))


def one_reference_failure(found: Found, trust: float, coverage: float) -> str | None:
    """Says in one sentence why a pose is not accepted; None if it is."""
    inliers = found.support.estimate.inliers
    count = f"{inliers.sum()} of {len(inliers)} matches agree on a pose"
    if -found.score > MAX_LOG10_FALSE_ALARMS:
        return f"{count}, which chance could do ({format_false_alarms(-found.score, MAX_LOG10_FALSE_ALARMS)})"
    if -found.moved_score > MAX_LOG10_FALSE_ALARMS:
        chance = format_false_alarms(-found.moved_score, MAX_LOG10_FALSE_ALARMS)
        return f"{count}, at the same pixels as in the reference, as if fixed to the camera; without them {chance}"
    if trust < 1 - coverage:
        required = f"the {round(1 - coverage, 6):g} that a coverage of {coverage:g} requires"
        return f"its trust of {np.floor(1000 * trust) / 1000:g} is below {required}: {count} with a single reference"
    return None
