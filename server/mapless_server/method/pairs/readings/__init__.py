"""Data that were read otherwise than they were meant: whether photographs fit their poses, and why not if not.

Begin with `judge`: from posed views and the matches of pairs to a verdict, with the median error, the share of bad
pairs, and the likely mistake. `errors` has the measure; `conventions`, `intrinsics` and `rounding` the mistakes with
their corrections; `explanation` finds the one that makes the pairs fit. `repeats` finds poses and photographs that are
given several times, `sessions` photographs in two worlds, `alignment` the similarity between these, `depth` whether the
unit is plausible.
"""

from .alignment import Alignment, align, align_sessions, similarity_text
from .conventions import CONVENTIONS, RARE, STRANGE, USUAL, Convention
from .depth import implausible_depth, median_depth
from .errors import (
    MatchedPair,
    Pair,
    PairError,
    Views,
    consistent,
    consistent_matches,
    distinct_matches,
    errors_of,
    summary,
)
from .explanation import MOST_NAMED, Explanation, explain
from .repeats import is_start, pose_difference, same_poses
from .sessions import sessions_of
from .verdict import WRONG_SHARE, Verdict, judge, suspects_of

__all__ = [
    "CONVENTIONS",
    "MOST_NAMED",
    "RARE",
    "STRANGE",
    "USUAL",
    "WRONG_SHARE",
    "Alignment",
    "Convention",
    "Explanation",
    "MatchedPair",
    "Pair",
    "PairError",
    "Verdict",
    "Views",
    "align",
    "align_sessions",
    "consistent",
    "consistent_matches",
    "distinct_matches",
    "errors_of",
    "explain",
    "implausible_depth",
    "is_start",
    "judge",
    "median_depth",
    "pose_difference",
    "same_poses",
    "sessions_of",
    "similarity_text",
    "summary",
    "suspects_of",
]
