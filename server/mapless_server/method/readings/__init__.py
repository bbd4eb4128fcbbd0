"""Data that were read otherwise than they were meant: whether photographs fit their poses, and why not if not.

Begin with `judge`: from posed views and the matches of pairs to a verdict, with the median error, the share of bad
pairs, and the likely mistake. `errors` has the measure, `conventions` the mistakes with their corrections,
`explanation` finds the one that makes the pairs fit, `depth` whether the unit is plausible.
"""

from .depth import implausible_depth, median_depth
from .errors import MatchedPair, Pair, PairError, Views, consistent_matches, errors_of, pair_error_px, sampson_px
from .explanation import Explanation, explain
from .verdict import Verdict, judge, suspects_of

__all__ = [
    "Explanation",
    "MatchedPair",
    "Pair",
    "PairError",
    "Verdict",
    "Views",
    "consistent_matches",
    "errors_of",
    "explain",
    "implausible_depth",
    "judge",
    "median_depth",
    "pair_error_px",
    "sampson_px",
    "suspects_of",
]
