"""The worth of rungs, and the agreement of matches of the place and of other places."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from research.contradictions.places import place_reader
from research.doubt.climbing import Climb, climbs

from .page import Question, Row

DATA = (
    "photographs of each folder of shared/data (6) and of other places (2), asked in it with 5 references (kitchen "
    "3, lockers 12, statue 20) that are evenly spread; `auto` with EdgePoint2 L64, SIFT, ALIKED and LightGlue; the "
    "engine makes every attempt, worth it or not. Shares are (n + 1/2) / (all + 1), since few are tried. Processor "
    "time is that of the machine that measured it, beside other work: the code has that of a quiet one (see "
    "rungs)."
)
QUESTIONS = {
    "rungs-worth": Question(
        "rungs-worth",
        "mapless_server.method.promise:WORTH",
        "Which share of the photographs of the place that have no accepted pose does a rung answer, at what cost?",
        DATA,
        "An attempt is made if its share, times the chance that the photograph shows the place, is at least 0.02 "
        "for each second. `stronger` has the share of rungs.md, which rests on more photographs, and includes "
        "what follows it; `rematched` has its time with two references. An accepted pose is checked by stronger "
        "features only if it is of low trust and no other features found one there: of 29 such poses in a hundred "
        "that are wrong (2,528 photographs, see `DoubtOptions`) stronger features are assumed to correct a third, "
        "which is not measured.",
    ),
    "place-agreement": Question(
        "place-agreement",
        "mapless_server.method.promise:PromiseOptions.agreement",
        "How large is the agreement of matches (see `features.rolls.Similarity`) of photographs of the place and "
        "of others, after the photograph as it is and SIFT, where the first attempt left a doubt?",
        DATA,
        "Above all of other places but one: with 3.0 these get no network, and those of the place do; all that "
        "any rung answers have over 4. A photograph below costs what it costs at least, so the chance falls fast, "
        "over 0.15. `rolls.LEAST_AGREEMENT` is a little smaller, since photographs that are rolled by 45 degrees "
        "reach 3.1 with the photograph itself.",
    ),
}
THRESHOLDS = (1.5, 2.0, 2.4, 2.7, 3.0, 4.0, 6.0)
KNOWN_AFTER = ("as it is", "any roll")


def measure(key: str, scenes: Path) -> tuple[Question, Iterator[Row]]:
    """The question of a key, and the rows of its table."""
    found = list(climbs(place_reader(scenes)))
    return QUESTIONS[key], iter(shares(found) if key == "rungs-worth" else agreements(found))


def shares(found: Sequence[Climb]) -> Iterator[Row]:
    """For each rung and kind of features, what it earns of photographs of the place without an accepted pose."""
    tried, right, spent_s = Counter[str](), Counter[str](), defaultdict[str, float](float)
    for climb in (it for it in found if it.is_own):
        for attempt in climb.attempts:
            name = _name(attempt.rung, attempt.features)
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
    """For each threshold, the shares of photographs in doubt with at least this agreement."""
    doubtful = [it for it in found if len(it.attempts) > 1]
    known = [max((a.agreement for a in it.attempts if a.rung in KNOWN_AFTER), default=0.0) for it in doubtful]
    own, right = (np.array([getattr(it, name) for it in doubtful]) for name in ("is_own", "is_right"))
    values = np.array(known)
    for threshold in THRESHOLDS:
        above = values >= threshold
        yield {
            "agreement at least": threshold,
            "of other places": f"{(above & ~own).sum()} of {(~own).sum()}",
            "of the place": f"{(above & own).sum()} of {own.sum()}",
            "of the place, answered right": f"{(above & right).sum()} of {right.sum()}",
        }
