"""Accepting and rejecting, measured: `python -m mapless_tools.calibrate.acceptance FOLDER_OF_SCENES`.

Two questions, asked of the method's own modules in this process, without a server. On the metric scenes: how many
right answers are accepted, and how many of the accepted are wrong? And with references of another place: is anything
accepted? The references of a query are always those that share the most features with it, as the server chooses them;
with few of them, and with references far apart, wrong poses are found.

Whoever has another rule than the method's gives another `Judge` to the tables.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from mapless_server.method.answer import Answer, Localization, LocalizeOptions
from mapless_server.method.rejection import RejectionReason
from mapless_server.method.trust.evidence import evidence_of
from mapless_server.method.trust.judge import trust_of

from .pairs import METRIC, OTHERS, Measured, answered, cross_pairs, read_places, right_pairs
from .selective import at_coverage, auroc

COVERAGE = 0.95
"""Of the right answers, by default."""
REFUSED = -1.0
"""Score of a pose that no trust can save."""


@dataclass(frozen=True)
class Verdict:
    """What a rule says of an answer: whether it is accepted, and a score by which answers can be ordered."""

    accepted: bool
    score: float


Judge = Callable[[Answer], Verdict]


def own_verdict(answer: Answer) -> Verdict:
    """The method's own: accepted is what it answers, and trust is the score.

    A pose that was rejected for too little trust has it computed again; one that was rejected before its trust was
    asked for, or because there is a second one, comes after all others.
    """
    outcome, support, options = answer.outcome, answer.support, LocalizeOptions()
    if isinstance(outcome, Localization):
        return Verdict(True, REFUSED if outcome.trust is None else outcome.trust)
    estimate = None if support is None else support.estimate
    if outcome.reason is not RejectionReason.GATE or support is None or estimate is None or estimate.covariance is None:
        return Verdict(False, REFUSED)
    return Verdict(False, trust_of(evidence_of(support, options.pnp.inlier_px), options.judge))


def metric_table(measured: Sequence[Measured], judge: Judge = own_verdict, coverage: float = COVERAGE) -> Iterator[str]:
    """Right and wrong answers by scene and K, and all together; `coverage` is for the last column alone."""
    yield (
        "| scene, references | K | queries | pose found | right | of these accepted | accepted | of these wrong | "
        f"AUROC | wrong at {100 * coverage:g} % of the right |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|"
    settings = dict.fromkeys((it.pair.title, it.pair.k) for it in measured)
    for title, k in settings:
        of_setting = [it for it in measured if (it.pair.title, it.pair.k) == (title, k)]
        yield _row(f"{title} | {k}", of_setting, judge, coverage)
    if measured:
        yield _row("**all** | ", measured, judge, coverage)


def cross_table(measured: Sequence[Measured], judge: Judge = own_verdict, threshold: float | None = None) -> list[str]:
    """Answers of another place that are accepted; or whose score reaches a threshold."""
    verdicts = [judge(it.answer) for it in measured]
    accepted = [it for it, verdict in zip(measured, verdicts, strict=True) if verdict.accepted]
    lines = [f"{len(measured)} pairs of a query and references of another scene: {len(accepted)} accepted"]
    found = [verdict.score for it, verdict in zip(measured, verdicts, strict=True) if it.off is not None]
    if found:
        lines.append(f"{len(found)} have a pose; their highest score is {max(found):.4g}")
    if threshold is not None:
        passed = sum(score >= threshold for score in found)
        lines.append(f"{passed} reach {threshold:.4g}, where that share of the right answers is accepted")
    return lines + [f"accepted: {it.pair.title}: {it.answer.outcome}" for it in accepted]


def threshold_of(measured: Sequence[Measured], judge: Judge = own_verdict, coverage: float = COVERAGE) -> float | None:
    """The score at which a share of the right answers is accepted; None without any."""
    found = [it for it in measured if it.off is not None]
    point = at_coverage([judge(it.answer).score for it in found], [it.right for it in found], coverage)
    return None if point is None else point.score


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes' folders")
    parser.add_argument("--only", choices=("metric", "cross"), action="append", help="parts; both if not given")
    parser.add_argument("--scenes", help="only these folders, by commas")
    parser.add_argument("--coverage", type=float, default=COVERAGE, help="share of right answers to accept")
    parser.add_argument("--cross-queries", type=int, default=14, help="queries of each scene tried in all others")
    arguments = parser.parse_args()
    parts, coverage = arguments.only or ["metric", "cross"], arguments.coverage
    known = list(dict.fromkeys([*(name for name, _ in METRIC), *OTHERS]))
    names = [name for name in known if arguments.scenes is None or name in arguments.scenes.split(",")]
    places = read_places(arguments.data, names)
    options = LocalizeOptions(coverage=coverage)
    metric: list[Measured] = []
    if "metric" in parts:
        for name, count in METRIC:
            if name in places:
                metric += _shown(answered(right_pairs(places[name], count), options))
        print("\n".join(metric_table(metric, coverage=coverage)), flush=True)
    if "cross" in parts:
        cross = _shown(answered(cross_pairs(list(places.values()), arguments.cross_queries), options))
        print("\n" + "\n".join(cross_table(cross, threshold=threshold_of(metric, coverage=coverage))), flush=True)


def _row(head: str, measured: Sequence[Measured], judge: Judge, coverage: float) -> str:
    verdicts = [judge(it.answer) for it in measured]
    found = [(it, verdict) for it, verdict in zip(measured, verdicts, strict=True) if it.off is not None]
    right = sum(it.right for it, _ in found)
    accepted = [it for it, verdict in found if verdict.accepted]
    kept, wrong = sum(it.right for it in accepted), sum(not it.right for it in accepted)
    scores, rights = [verdict.score for _, verdict in found], [it.right for it, _ in found]
    point, area = at_coverage(scores, rights, coverage), auroc(scores, rights)
    return (
        f"| {head} | {len(measured)} | {len(found)} | {right} | {_share(kept, right)} | {len(accepted)} | "
        f"{_share(wrong, len(accepted))} | {'-' if math.isnan(area) else f'{area:.3f}'} | "
        f"{'-' if point is None else _share(point.wrong, point.accepted)} |"
    )


def _share(part: int, whole: int) -> str:
    return f"{part} ({100 * part / whole:.1f} %)" if whole else "-"


def _shown(measured: Iterable[Measured]) -> list[Measured]:
    """All, and a sign of life for each setting."""
    done: list[Measured] = []
    for it in measured:
        if not done or done[-1].pair.title != it.pair.title:
            print(f"{it.pair.title} ...", file=sys.stderr, flush=True)
        done.append(it)
    return done


if __name__ == "__main__":
    main()
