"""Accepting and rejecting, measured: `python -m research.acceptance FOLDER_OF_SCENES`.

On the metric scenes: how many right answers are accepted, and how many of the accepted are wrong? And with references
of another place: is anything accepted? The references of a query are those that share the most features with it, as the
server chooses them; with few of them, and with references far apart, wrong poses are found.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from mapless_server.method.answer import Answer, Localization
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pipeline import StageOptions
from mapless_server.method.rejection import RejectionReason
from mapless_server.method.trust.judge import evidence_of, trust_of
from mapless_tools.calibrate.findings import Operating, auroc, risk_coverage

from .places import METRIC, OTHERS, Measured, answered, cross_pairs, read_places, right_pairs

COVERAGE = 0.95
"""Of the right answers, by default."""
REJECTED = -1.0
"""Score of a pose that no trust can save."""


def score_of(answer: Answer) -> float:
    """The trust of an answer.

    A pose that was rejected for too little trust has it computed again; one that was rejected before its trust was
    asked for, or because there is a second one, comes after all others.
    """
    outcome, support, options = answer.outcome, answer.support, StageOptions()
    if isinstance(outcome, Localization):
        return REJECTED if outcome.trust is None else outcome.trust
    estimate = None if support is None else support.estimate
    if outcome.reason is not RejectionReason.GATE or support is None or estimate is None or estimate.covariance is None:
        return REJECTED
    return trust_of(evidence_of(support, options.pnp.inlier_px), options.judge)


def metric_table(measured: Sequence[Measured], coverage: float) -> Iterator[str]:
    """Right and wrong answers by scene and K, and all together; `coverage` is for the last column alone."""
    yield (
        "| scene, references | K | queries | pose found | right | of these accepted | accepted | of these wrong | "
        f"AUROC | wrong at {100 * coverage:g} % of the right |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for title, k in dict.fromkeys((it.pair.title, it.pair.k) for it in measured):
        yield _row(f"{title} | {k}", [it for it in measured if (it.pair.title, it.pair.k) == (title, k)], coverage)
    yield _row("**all** | ", measured, coverage)


def cross_table(measured: Sequence[Measured]) -> Iterator[str]:
    """Answers of another place that are accepted."""
    accepted = [it for it in measured if isinstance(it.answer.outcome, Localization)]
    yield f"{len(measured)} pairs of a query and references of another scene: {len(accepted)} accepted"
    scores = [score_of(it.answer) for it in measured if it.off is not None]
    if scores:
        yield f"{len(scores)} have a pose; their highest trust is {max(scores):.4g}"
    yield from (f"accepted: {it.pair.title}: {it.answer.outcome}" for it in accepted)


def at_coverage(scores: Sequence[float], right: Sequence[bool], coverage: float) -> Operating | None:
    """The strictest operating point that accepts at least this share of the right answers; None without any."""
    if not any(right):
        return None
    return next(point for point in risk_coverage(scores, right) if point.coverage >= coverage)


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes' folders")
    parser.add_argument("--only", choices=("metric", "cross"), action="append", help="parts; both if not given")
    parser.add_argument("--coverage", type=float, default=COVERAGE, help="share of right answers to accept")
    parser.add_argument("--cross-queries", type=int, default=14, help="queries of each scene tried in all others")
    arguments = parser.parse_args()
    parts = arguments.only or ["metric", "cross"]
    places = read_places(arguments.data, dict.fromkeys([*(name for name, _ in METRIC), *OTHERS]))
    options = LocalizeOptions(coverage=arguments.coverage)
    if "metric" in parts:
        pairs = (pair for name, count in METRIC for pair in right_pairs(places[name], count))
        print("\n".join(metric_table(list(answered(pairs, options)), arguments.coverage)), flush=True)
    if "cross" in parts:
        cross = answered(cross_pairs(list(places.values()), arguments.cross_queries), options)
        print("\n" + "\n".join(cross_table(list(cross))), flush=True)


def _row(head: str, measured: Sequence[Measured], coverage: float) -> str:
    found = [it for it in measured if it.off is not None]
    accepted = [it for it in found if isinstance(it.answer.outcome, Localization)]
    right = sum(it.right for it in found)
    kept = sum(it.right for it in accepted)
    scores, rights = [score_of(it.answer) for it in found], [it.right for it in found]
    point, area = at_coverage(scores, rights, coverage), auroc(scores, rights)
    return (
        f"| {head} | {len(measured)} | {len(found)} | {right} | {_share(kept, right)} | {len(accepted)} | "
        f"{_share(len(accepted) - kept, len(accepted))} | {'-' if math.isnan(area) else f'{area:.3f}'} | "
        f"{'-' if point is None else _share(point.wrong, point.accepted)} |"
    )


def _share(part: int, whole: int) -> str:
    return f"{part} ({100 * part / whole:.1f} %)" if whole else "-"


if __name__ == "__main__":
    main()
