"""Results of a calibration: how often claims hold before and after, the value of trust, and rejections."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import betaincinv

from mapless_server.services.messages.radii import Conditions, Factors

from .claims import Claim, Sample, TooFewQueries, fit_factors, left_one_out
from .queries import Outcome

DIAGRAM = tuple(p / 100 for p in range(5, 100))
"""Claimed probabilities of the reliability diagram."""


@dataclass(frozen=True)
class RightRule:
    """Defines a right answer: both errors are at most these."""

    position_m: float = 0.10
    rotation_deg: float = 5.0

    def __post_init__(self) -> None:
        if not 0 < self.position_m < math.inf:
            raise ValueError(f"right_cm must be above 0, is {100 * self.position_m:g}")
        if not 0 < self.rotation_deg <= 180:
            raise ValueError(f"right_deg must be above 0 and at most 180, is {self.rotation_deg:g}")

    def __call__(self, outcome: Outcome) -> bool:
        """Whether an answer is right; False without a pose."""
        return outcome.error_m <= self.position_m and outcome.error_deg <= self.rotation_deg


@dataclass(frozen=True)
class Share:
    """A share of a number, with the 95 % confidence interval of the true share (Clopper and Pearson 1934)."""

    part: int
    whole: int
    low: float
    high: float

    @property
    def value(self) -> float:
        """The share; NaN if the number is 0."""
        return self.part / self.whole if self.whole else math.nan

    @classmethod
    def of(cls, part: int, whole: int, confidence: float = 0.95) -> "Share":
        """Makes a share with its interval, from both one-sided tests at (1 - confidence) / 2."""
        tail = (1 - confidence) / 2
        low = float(betaincinv(part, whole - part + 1, tail)) if part else 0.0
        high = float(betaincinv(part + 1, whole - part, 1 - tail)) if part < whole else 1.0
        return cls(part, whole, low, high)


@dataclass(frozen=True)
class Held:
    """How often the truth is within a claimed radius, without a factor and with that of all others, if there is one."""

    claim: str
    probability: float
    before: Share
    factor: float | None
    after: Share | None


@dataclass(frozen=True)
class Operating:
    """Accepting every answer with this score: share of right answers accepted, and of wrong ones among the accepted."""

    score: float
    coverage: float
    risk: float
    accepted: int
    wrong: int


@dataclass(frozen=True, eq=False)
class Findings:
    """All results of a calibration.

    The sample has the claims of answers that were computed under the same conditions as the majority; the number of
    `others` is left out. If it is too small, as `refusal` says, there are no factors, and no `after`, in which each
    claim has the factors from all others. `trusted` is risk against coverage by trust, empty if answers have none;
    `auroc` the probability that a right answer has more trust than a wrong one, NaN if there is none of either.
    """

    outcomes: tuple[Outcome, ...]
    conditions: Conditions | None
    sample: Sample
    others: int
    factors: Factors | None
    refusal: str
    after: Sample | None
    held: tuple[Held, ...]
    rejections: Mapping[str, int]
    right: Share
    trusted: tuple[Operating, ...]
    auroc: float


def find(outcomes: Sequence[Outcome], right: RightRule) -> Findings:
    """Computes all results from the answers to all photographs."""
    answered = [it for it in outcomes if it.pose is not None]
    counts = Counter(it.conditions for it in answered if it.position is not None)
    conditions = counts.most_common(1)[0][0] if counts else None
    measured = [it for it in answered if it.position is not None and it.conditions == conditions]
    sample = Sample(
        tuple(it.position for it in measured if it.position), tuple(it.rotation for it in measured if it.rotation)
    )
    refusal, factors, after = "", None, None
    try:
        factors = fit_factors(sample)
        after = left_one_out(sample)
    except TooFewQueries as error:
        refusal = str(error)
    is_right = [right(it) for it in answered]
    has_trust = bool(answered) and all(it.trust is not None for it in answered)
    trust = [it.trust or 0.0 for it in answered]
    return Findings(
        outcomes=tuple(outcomes),
        conditions=conditions,
        sample=sample,
        others=len(answered) - len(measured),
        factors=factors,
        refusal=refusal,
        after=after,
        held=tuple(_held(sample, factors, after)),
        rejections=dict(Counter(it.rejection for it in outcomes if it.rejection).most_common()),
        right=Share.of(sum(is_right), len(answered)),
        trusted=tuple(risk_coverage(trust, is_right)) if has_trust else (),
        auroc=auroc(trust, is_right) if has_trust else math.nan,
    )


def reliability(claims: Sequence[Claim]) -> list[tuple[float, float]]:
    """The reliability diagram: claimed probability, and the share of claims (at least one) that hold at it."""
    return [(p, float(np.mean([claim.held(p) for claim in claims]))) for p in DIAGRAM]


def auroc(scores: Sequence[float], right: Sequence[bool]) -> float:
    """Probability that a right answer scores higher than a wrong one (Mann-Whitney); NaN if there is none of either."""
    is_right = np.asarray(right, bool)
    rights, wrongs = int(is_right.sum()), int((~is_right).sum())
    if not rights or not wrongs:
        return math.nan
    from scipy.stats import rankdata  # takes half a second to import

    ranks = rankdata(np.asarray(scores, float))
    return float((ranks[is_right].sum() - rights * (rights + 1) / 2) / (rights * wrongs))


def risk_coverage(scores: Sequence[float], right: Sequence[bool]) -> list[Operating]:
    """An operating point for each different score, the highest first; answers of equal score are accepted together."""
    values, is_right = np.asarray(scores, float), np.asarray(right, bool)
    all_right, points = max(1, int(is_right.sum())), []
    for score in np.unique(values)[::-1].tolist():
        accepted = values >= score
        count, rights = int(accepted.sum()), int(is_right[accepted].sum())
        points.append(Operating(score, rights / all_right, (count - rights) / count, count, count - rights))
    return points


def _held(sample: Sample, factors: Factors | None, after: Sample | None) -> list[Held]:
    rows = []
    for kind in ("position", "rotation"):
        for percent in (68, 95):
            factor = getattr(factors, f"{kind}_{percent}") if factors else None
            calibrated = _share(getattr(after, kind), percent) if after else None
            rows.append(Held(kind, percent / 100, _share(getattr(sample, kind), percent), factor, calibrated))
    return rows


def _share(claims: Sequence[Claim], percent: int) -> Share:
    radii = [claim.radius_68 if percent == 68 else claim.radius_95 for claim in claims]
    held = [claim.error <= radius for claim, radius in zip(claims, radii, strict=True)]
    return Share.of(int(np.sum(held)), len(claims))
