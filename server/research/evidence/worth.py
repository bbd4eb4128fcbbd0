"""The worth of rungs, and the agreement of matches of the place and of other places."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence

from mapless_server.method.promise import PROMISE, WORTH
from research.places import Scenes

from .climbing import Climb, climbs
from .page import Measurement, Row

THRESHOLDS = (1.5, 2.0, 2.4, 2.7, 3.0, 4.0, 6.0)
KNOWN_AFTER = ("as it is", "any roll")


def shares(found: Sequence[Climb]) -> Iterator[Row]:
    """For each rung and kind of features, what it earns of photographs of the place without an accepted pose.

    A rung whose worth depends on agreement counts where there was some before.
    """
    tried, right, spent_s = Counter[str](), Counter[str](), defaultdict[str, float](float)
    for climb in (it for it in found if it.is_own):
        agreement = 0.0
        for attempt in climb.attempts:
            name, known, agreement = _name(attempt.rung, attempt.features), agreement, attempt.agreement
            if name in WORTH and known < PROMISE.agreement:
                continue
            tried[name] += 1
            spent_s[name] += attempt.processor_s
            right[name] += attempt.is_chosen and climb.is_right
            if attempt.outcome == "localized":
                break
    for name, count in sorted(tried.items()):
        yield {
            "rung": name,
            "tried without an accepted pose": count,
            "answered right": right[name],
            "share": f"{(right[name] + 0.5) / (count + 1):.3f}",
            "processor s, mean": f"{spent_s[name] / count:.2f}",
        }


def _name(rung: str, features: str) -> str:
    return f"{rung} at any roll" if features.startswith("sift") and rung in ("wide", "lines") else rung


def agreements(found: Sequence[Climb]) -> Iterator[Row]:
    """For each threshold, the shares of photographs in doubt with at least this agreement.

    Last, the shares with the threshold that the photographs of all other places would choose.
    """
    doubtful = [(it, _known(it)) for it in found if len(it.attempts) > 1]
    for threshold in THRESHOLDS:
        yield _row(f"{threshold:g}", [(it, agreement >= threshold) for it, agreement in doubtful])
    chosen = [
        (it, agreement >= _between([(other, a) for other, a in doubtful if other.folder != it.folder]))
        for it, agreement in doubtful
    ]
    yield _row("by the other places", chosen)


def _known(climb: Climb) -> float:
    return max((it.agreement for it in climb.attempts if it.rung in KNOWN_AFTER), default=0.0)


def _between(known: Sequence[tuple[Climb, float]]) -> float:
    """Half way from the largest agreement of another place to the smallest that a network then answered right."""
    right = [agreement for it, agreement in known if it.is_own and it.is_right and _is_by_network(it)]
    return (max(agreement for it, agreement in known if not it.is_own) + min(right)) / 2


def _is_by_network(climb: Climb) -> bool:
    return not any(it.outcome == "localized" and not it.features.startswith("aliked") for it in climb.attempts)


def _row(name: str, chosen: Sequence[tuple[Climb, bool]]) -> Row:
    def share(some: Sequence[bool]) -> str:
        return f"{sum(some)} of {len(some)}"

    return {
        "agreement at least": name,
        "of other places": share([above for it, above in chosen if not it.is_own]),
        "of the place": share([above for it, above in chosen if it.is_own]),
        "answered right": share([above for it, above in chosen if it.is_own and it.is_right]),
        "answered right by a network": share(
            [above for it, above in chosen if it.is_own and it.is_right and _is_by_network(it)]
        ),
    }


MEASUREMENTS = {
    "rungs-worth": Measurement(lambda scenes: shares(list(climbs(Scenes(scenes))))),
    "place-agreement": Measurement(lambda scenes: agreements(list(climbs(Scenes(scenes))))),
}
