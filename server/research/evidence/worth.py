"""The worth of rungs, and the agreement of matches of the place and of other places."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

from mapless_server.method.promise import PROMISE, WORTH
from research.contradictions.places import place_reader
from research.doubt.climbing import Climb, climbs

from .page import Question, Row

DATA = (
    "photographs of each folder of shared/data (6) and of other places (2), asked in it with 5 references (kitchen "
    "3, lockers 12, statue 20) that are evenly spread; `auto` with EdgePoint2 L64, SIFT, ALIKED and LightGlue; the "
    "engine makes every attempt, worth it or not. Shares are (n + 1/2) / (all + 1), since few are tried. Processor "
    "time is that of the thread, beside another process."
)
QUESTIONS = {
    "rungs-worth": Question(
        "rungs-worth",
        "mapless_server.method.promise:WORTH",
        "Which share of the photographs of the place that have no accepted pose, but agree with two references, does "
        "a rung answer, at what cost?",
        DATA,
        "An attempt is made if its share, times the chance that two references show the same (see place-agreement), is "
        "at least 0.02 for each second. `stronger` includes what follows it, time and answers: of 4 photographs here "
        "that get a network 2 are answered right, of 9 of the list of doubtful ones 4. Costs are those of a quiet "
        "machine with stored pairs of references, which `wide` and `rematched` did not have here; shares at any roll "
        "are those of an earlier measurement with more photographs "
        "(0 of 9 and 1 of 40). An accepted pose is checked by stronger features only if it is of low trust and no "
        "other features found one there: of 29 such poses in a hundred that are wrong (2,528 photographs, see "
        "`DoubtOptions`) stronger features are assumed to correct a third, which is not measured.",
    ),
    "place-agreement": Question(
        "place-agreement",
        "mapless_server.method.promise:PromiseOptions.agreement",
        "How large an agreement of matches (see `features.rolls.Similarity`) do two references reach, of photographs "
        "of the place and of others, after the photograph as it is and SIFT, where the first attempt left a doubt?",
        DATA,
        "A pose needs two references, so the second largest agreement counts. 3.0 is above all photographs of other "
        "places and below those that a network answers right (3.4 and more; the three right ones below 3.0 were "
        "answered without one). Chosen by the other places alone, half way between the two, it differs where one of "
        "the two nearest is left out: the last row. The logistic's spread is 0.25, so that at 2.4 the cheap rungs are "
        "still tried, but no stronger features: of the list of doubtful photographs `wide` answers one there for 0.07 "
        "s. `rolls.LEAST_AGREEMENT` is for a single reference: in an earlier run of this program, with the largest "
        "agreement instead of the second, photographs of other places reached 4.4.",
    ),
}
THRESHOLDS = (1.5, 2.0, 2.4, 2.7, 3.0, 4.0, 6.0)
KNOWN_AFTER = ("as it is", "any roll")


def measure(key: str, scenes: Path) -> tuple[Question, Iterator[Row]]:
    """The question of a key, and the rows of its table."""
    found = list(climbs(place_reader(scenes)))
    return QUESTIONS[key], iter(shares(found) if key == "rungs-worth" else agreements(found))


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
