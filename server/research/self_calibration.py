"""Self-calibration tested: from the references alone, on photographs between them.

    PYTHONPATH=client:server python -m research.self_calibration FOLDER_OF_SCENES [--weights FOLDER] [--samples FILE]

Of each scene some evenly spread photographs are references, and photographs between them queries. Each reference is
localized against the others, the model of `scenes.calibration.fit` fitted, and applied to the answers to the queries:
how many are within their radii, and how many right ones are accepted, generic and self-calibrated. The model's few
constants are tried on a grid, and chosen for each place by what the others say, so that none is tested on itself.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.trust.judge import trust_in_scene
from mapless_server.method.uncertainty import radii as uncertainty
from mapless_server.method.uncertainty.radii import Accuracy
from mapless_server.scenes.calibration.calibrator import left_out
from mapless_server.scenes.calibration.fit import FitOptions, LeftOut, fit
from mapless_server.services.messages.answers import Factors, scaled_accuracy
from mapless_server.store import SelfCalibration
from mapless_tools.evaluate.plan import evenly_spread

from .places import KITCHEN, QUERIES, Pair, Place, answered, read_places, samples_of_command

SETTINGS: dict[str, tuple[int | None, ...]] = {
    KITCHEN: (30, 10, 5),
    "euroc-v101-drone": (20, 10, 5),
    "tum-fr3-office": (None, 6),
    "fountain-P11": (None,),
    "herz-jesus-P8": (None,),
    "kitti-drive-a": (None, 8),
    "office-lockers": (20, 10),
    "statue-of-liberty-internet": (20, 10),
    "meeting-room": (10, 5),
    "studio-flat": (10, 5),
    "fox-portrait": (10, 5),
}
"""Folders and numbers of references; None: all but the photograph that is asked, in scenes small enough for that."""

K, SAMPLE = 10, 40
COVERAGE = 0.95
Constants = tuple[float, FitOptions]
GRID: tuple[Constants, ...] = tuple(
    (growth, FitOptions(factor_log=factor, noise_share=noise))
    for growth, factor, noise in product((0.0, 0.1, 0.2, 0.3), (0.4, 0.8), (0.05, 0.3, 0.6))
)
"""Exponents of the gap, and the priors of factor and noise."""


@dataclass(frozen=True)
class Sample:
    """An answer to a photograph of a scene, a reference that was left out or a query; as the calibration sees it.

    It is right by the scene's own scale (`Measured.right`); wrong answers are judged by trust, not by radii.
    """

    scene: str
    features: str
    is_reference: bool
    is_right: bool
    result: LeftOut | None


def collect(data: Path, features: str, extractor: FeatureExtractor) -> Iterator[Sample]:
    """Localizes references and queries of all scenes; half an hour."""
    for name, counts in SETTINGS.items():
        place = read_places(data, [name], extractor)[name]
        indices = sorted(place.views)
        for setting, references, queries in (it for count in counts for it in _settings(indices, count)):
            scene = f"{name}:{setting}"
            for is_reference, asked in ((True, evenly_spread(references, SAMPLE)), (False, queries)):
                pairs = [_pair(place, scene, i, references, features) for i in asked]
                for i, it in zip(asked, answered(pairs, LocalizeOptions(coverage=1.0), features), strict=True):
                    yield Sample(scene, features, is_reference, it.right, left_out(place.posed([i])[0], it.answer))


def _settings(indices: Sequence[int], count: int | None) -> Iterator[tuple[str, list[int], list[int]]]:
    """Names, references and queries; a query is no reference of those that calibrate for it."""
    if count is None:
        yield from ((f"without {query}", [i for i in indices if i != query], [query]) for query in indices)
    else:
        references = evenly_spread(indices, count)
        yield str(count), references, evenly_spread([i for i in indices[1:-1] if i not in references], QUERIES)


def _pair(place: Place, title: str, index: int, references: Sequence[int], features: str) -> Pair:
    others = [i for i in references if i != index]
    chosen = place.posed(place.most_matching(place.views[index], others, min(K, len(others)), features))
    return Pair(title, K, place.views[index], chosen, place.poses[index], metric=place.metric)


@dataclass(frozen=True, eq=False)
class Tested:
    """What one way of calibrating a scene is worth: errors by radii of 68 and 95 %, of right answers, and acceptance.

    The ratios (N, 4) are of position and rotation at 68 %, then both at 95 %; (N,) are accepted at `COVERAGE`.
    """

    scene: str
    features: str
    ratios: Array
    accepted: NDArray[np.bool_]

    @property
    def place(self) -> str:
        """The folder."""
        return self.scene.partition(":")[0]

    @property
    def loss(self) -> float:
        """Mean pinball loss of the logarithms of ratios: lowest if the shares within are as stated, for each answer."""
        off = np.log(np.clip(self.ratios, 0.02, 50))
        share = np.repeat([0.68, 0.95], 2)
        return float(np.maximum(share * off, (share - 1) * off).mean())


def test(samples: Sequence[Sample], growth: float, options: FitOptions | None) -> list[Tested]:
    """Each scene and kind of features, calibrated with these options; None for generic radii."""
    uncertainty.GROWTH = growth
    found = []
    for scene, features in dict.fromkeys((it.scene, it.features) for it in samples):
        own = [it for it in samples if (it.scene, it.features) == (scene, features)]
        calibration = SelfCalibration("", 0, 0)
        if options is not None:
            left = [it.result for it in own if it.is_reference and it.result is not None]
            calibration = fit(left, "", 0, options)
        right = [it.result for it in own if not it.is_reference and it.is_right and it.result is not None]
        if right:
            ratios = np.array([_ratios(it, calibration) for it in right])
            trust = [trust_in_scene(it.trust, calibration.trust_quantiles) for it in right]
            found.append(Tested(scene, features, ratios, np.array(trust) >= 1 - COVERAGE))
    return found


def _ratios(it: LeftOut, calibration: SelfCalibration) -> tuple[float, ...]:
    radii = it.claimed
    if calibration.answer_count:
        radii = scaled_accuracy(radii, Factors.of_references(calibration, radii, it.gap))
    return (
        it.error_m / radii.position_68_m,
        it.error_deg / radii.rotation_68_deg,
        it.error_m / radii.position_95_m,
        it.error_deg / radii.rotation_95_deg,
    )


def choose(tried: Mapping[Constants, Sequence[Tested]], left_out: str = "") -> Constants:
    """The constants with the lowest loss, every other place counting alike."""
    return min(tried, key=lambda it: loss([tested for tested in tried[it] if tested.place != left_out]))


def loss(tested: Sequence[Tested]) -> float:
    """Mean loss, every place counting alike."""
    places: dict[str, list[float]] = {}
    for it in tested:
        places.setdefault(it.place, []).append(it.loss)
    return float(np.mean([np.mean(it) for it in places.values()]))


def left_out_places(generic: Sequence[Tested], tried: Mapping[Constants, Sequence[Tested]]) -> Iterator[str]:
    """Lines of a table: each place with the constants that the others choose, beside the generic radii."""
    yield "| scene | features | answers | generic: position, rotation 68 %, 95 %, accepted | self | chosen |"
    yield "|---|---|---|---|---|---|"
    for place, features in dict.fromkeys((it.place, it.features) for it in generic):
        growth, options = chosen = choose(tried, place)
        both = [[it for it in own if (it.place, it.features) == (place, features)] for own in (generic, tried[chosen])]
        cells = f"{sum(len(it.ratios) for it in both[0])} | {' | '.join(map(_cells, both))}"
        yield f"| {place} | {features} | {cells} | {growth:g}, {options.factor_log:g}, {options.noise_share:g} |"


def _cells(tested: Sequence[Tested]) -> str:
    inside = np.concatenate([it.ratios <= 1 for it in tested]).mean(axis=0)
    accepted = np.concatenate([it.accepted for it in tested]).mean()
    return ", ".join(f"{100 * share:.0f}" for share in (*inside, accepted))


def _read(content: dict[str, Any]) -> Sample:
    result = content["result"]
    if result is not None:
        result = LeftOut(**{**result, "claimed": Accuracy(**result["claimed"])})
    return Sample(**{**content, "result": result})


def main() -> None:
    """Localizes, chooses and prints."""
    samples = samples_of_command(__doc__, collect, _read)
    tried = {it: test(samples, *it) for it in GRID}
    growth, options = choose(tried)
    print(f"growth = {growth:g}, factor_log = {options.factor_log:g}, noise_share = {options.noise_share:g}\n")
    print("\n".join(left_out_places(test(samples, 0.0, None), tried)))


if __name__ == "__main__":
    main()
