"""The factors of claimed radii: `python -m research.radii FOLDER_OF_SCENES [--weights FOLDER] [--samples FILE]`.

The model of `method.uncertainty` has two factors on standard deviations and one on the tail, which no theory gives.
They come from scenes with known poses, every scene counting alike however many photographs it has:

    position, rotation    the 68 % radius times the factor holds 68 % of the answers,
    tail                  and the 95 % radius times both holds `TAIL_SHARE` of them, position or rotation, whichever
                          needs more: an unseen scene may be worse than these.

They are tested by leaving out one scene at a time: fitted on the others, how many of its answers are within the radii.
Answers that are wrong do not count: telling these is what trust is for (`research.trust`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import bdtrik

from mapless.geometry import Array
from mapless_server.method.answer import Localization
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pipeline import StageOptions
from mapless_server.method.pose_problem import AdjustOptions
from mapless_server.method.uncertainty.dispersion import UncertaintyOptions
from mapless_server.method.uncertainty.radii import error_radii

from .places import ALL, KS, answered, natural_pairs, read_places, samples_of_command, weights_alike

TAIL_SHARE = 0.97
"""With 95 %, half of the unseen scenes would have fewer within."""
UNFITTED = StageOptions(
    adjust=AdjustOptions(uncertainty=replace(UncertaintyOptions(), position_factor=1.0, rotation_factor=1.0))
)
"""Radii as the model gives them, without fitted factors."""


@dataclass(frozen=True)
class Answered:
    """An answer's errors by the radii that the model claims without factors.

    A small scene has fewer than k references.
    """

    scene: str
    features: str
    k: int
    position_68: float
    position_95: float
    rotation_68: float
    rotation_95: float


@dataclass(frozen=True)
class Fit:
    """The three constants."""

    position: float
    rotation: float
    tail: float

    def held(self, it: Answered) -> tuple[bool, bool, bool, bool]:
        """Whether the truth is within the radii: position at 68 and 95 %, rotation at 68 and 95 %."""
        return (
            it.position_68 <= self.position,
            it.position_95 <= self.position * self.tail,
            it.rotation_68 <= self.rotation,
            it.rotation_95 <= self.rotation * self.tail,
        )


def collect(data: Path, features: str, extractor: FeatureExtractor) -> Iterator[Answered]:
    """Localizes everything in a folder of the scenes' folders; half an hour."""
    for place in read_places(data, ALL, extractor).values():
        for it in answered(natural_pairs(place, features), LocalizeOptions(coverage=1.0), features, UNFITTED):
            outcome = it.answer.outcome
            if isinstance(outcome, Localization) and outcome.covariance is not None and it.off is not None and it.right:
                position, rotation = outcome.covariance[:3, :3], np.degrees(np.degrees(outcome.covariance[3:, 3:]))
                ratios = (
                    error / radius
                    for error, covariance in zip(it.off, (position, rotation), strict=True)
                    for radius in error_radii(covariance, [0.68, 0.95]).tolist()
                )
                yield Answered(place.name, features, min(k for k in KS if k >= it.pair.k), *ratios)


def fit(answers: Sequence[Answered]) -> Fit:
    """The constants that fit these answers, every scene counting alike."""
    weights = weights_alike([it.scene for it in answers])
    position = _quantile([it.position_68 for it in answers], weights, 0.68)
    rotation = _quantile([it.rotation_68 for it in answers], weights, 0.68)
    tails = (
        _quantile([it.position_95 / position for it in answers], weights, TAIL_SHARE),
        _quantile([it.rotation_95 / rotation for it in answers], weights, TAIL_SHARE),
    )
    return Fit(position, rotation, max(1.0, *tails))


def left_out(answers: Sequence[Answered]) -> Iterator[str]:
    """Lines of a table: each scene with the constants that the others give, and the range of a correct 68 %."""
    yield "| scene left out | features | K | answers | position 68 % | 95 % | rotation 68 % | 95 % | a correct 68 % |"
    yield "|---|---|---|---|---|---|---|---|---|"
    kinds = tuple(dict.fromkeys(it.features for it in answers))
    rows = [*(((kind,), KS) for kind in kinds), *((kinds, (k,)) for k in KS), (kinds, KS)]
    for scene in dict.fromkeys(it.scene for it in answers):
        constants = fit([it for it in answers if it.scene != scene])
        for features, ks in rows:
            own = [it for it in answers if it.scene == scene and it.features in features and it.k in ks]
            if own:
                shares = np.mean([constants.held(it) for it in own], axis=0)
                low, high = (100 * np.ceil(bdtrik(p, len(own), 0.68)) / len(own) for p in (0.025, 0.975))
                cells = " | ".join(f"{100 * share:.0f} %" for share in shares)
                label = features[0] if len(features) == 1 else "all"
                label = f"{label} | {', '.join(map(str, ks))}"
                yield f"| {scene} | {label} | {len(own)} | {cells} | {low:.0f} to {high:.0f} % |"


def _quantile(values: Sequence[float], weights: Array, probability: float) -> float:
    order = np.argsort(values)
    reached = np.searchsorted(np.cumsum(weights[order]), probability - 1e-12)
    return float(np.asarray(values)[order[min(int(reached), len(order) - 1)]])


def main() -> None:
    """Measures, fits and prints."""
    answers = samples_of_command(__doc__, collect, lambda it: Answered(**it))
    constants = fit(answers)
    print(f"position_factor = {constants.position:.2f}, rotation_factor = {constants.rotation:.2f}")
    print(f"TAIL_95 = {constants.tail:.2f}\n")
    print("\n".join(left_out(answers)))


if __name__ == "__main__":
    main()
