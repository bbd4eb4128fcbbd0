"""Wrong intrinsics: `python -m research.intrinsics FOLDER_OF_SCENES [--weights FOLDER] [--samples FILE]`.

What a photograph says of its intrinsics, where these are right and where they are wrong by a planted error: its errors
by the standard deviations of the given and the estimated value together, the rejections that name a parameter, and the
answers whose position lies within its 95 % radius.

The threshold of `ContradictionOptions` is the smallest in steps of a quarter at which under `FALSE_ALARMS` of the
right photographs of every scene are contradicted. It is tested by leaving out one scene at a time. Scenes whose given
intrinsics are wrong themselves take no part: `statue-of-liberty-internet` has one focal length for all cameras.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mapless.geometry import Camera, Fisheye
from mapless_server.method.answer import Localization
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.intrinsics import ContradictionOptions, corrected
from mapless_server.method.rejection import IntrinsicsParameter
from mapless_server.method.uncertainty.radii import accuracy_from_covariance
from mapless_server.method.views import Features, View, undistort_pixels

from .places import METRIC, Measured, Pair, Place, answered, read_place, right_pairs, samples_of_command, spread

PLANTED = (*METRIC, ("euroc-v101-drone", None))
"""Folders with errors planted, and how many frames are references; None leaves one out."""
RIGHT = (
    *PLANTED,
    *((name, None) for name in ("fox-portrait", "reichstag-internet", "office-lockers", "meeting-room", "studio-flat")),
    ("office-lockers", 10),
    ("meeting-room", 5),
    ("studio-flat", 5),
)
K, QUERIES, WRONG_QUERIES, FALSE_ALARMS = 10, 40, 5, 0.01
FOCAL, X, Y, K1 = IntrinsicsParameter


def _off(log_focal: float = 0.0, x: float = 0.0, y: float = 0.0, k1: float = 0.0) -> Callable[[Camera], Camera]:
    """Errors; those of the principal point are in pixels of an image of 640 px."""

    def changed(camera: Camera) -> Camera:
        scale = camera.width_px / 640
        wrong = corrected(camera, (log_focal, scale * x, scale * y, k1))
        return wrong if k1 else replace(wrong, distortion=camera.distortion)

    return changed


ERRORS: dict[str, tuple[IntrinsicsParameter, Callable[[Camera], Camera]]] = {
    "focal +3 %": (FOCAL, _off(np.log(1.03))),
    "k1 +0.3": (K1, _off(k1=0.3)),
    "k1 -0.3": (K1, _off(k1=-0.3)),
    "cx +60": (X, _off(x=60)),
    "empty fisheye": (K1, lambda camera: replace(camera, distortion=Fisheye())),
    "focal -3 %": (FOCAL, _off(np.log(0.97))),
    "focal +1 %": (FOCAL, _off(np.log(1.01))),
    "focal -5 %": (FOCAL, _off(np.log(0.95))),
    "focal +10 %": (FOCAL, _off(np.log(1.1))),
    "focal x +3 %": (FOCAL, lambda camera: replace(camera, focal_x_px=1.03 * camera.focal_x_px)),
    "cx -20": (X, _off(x=-20)),
    "cy +20": (Y, _off(y=20)),
    "cy -40": (Y, _off(y=-40)),
    "k1 +0.1": (K1, _off(k1=0.1)),
    "k1 -0.1": (K1, _off(k1=-0.1)),
}
"""The five of the first test by strangers, and ten others; the parameter that a rejection should name."""


@dataclass(frozen=True)
class Sample:
    """A photograph's answer, with one of the planted `ERRORS`, or empty for intrinsics as given.

    It may be right (see `Measured`) without being accepted. `inside` says whether position and angle are within their
    95 % radii, `named` which parameters the rejection names. `sigmas` are of each parameter, its error by the
    estimate's standard deviation, and by both together; of those that the photograph determines, else zero.
    """

    place: str
    features: str
    error: str
    right: bool
    answered: bool
    inside: tuple[bool, bool]
    named: tuple[str, ...]
    sigmas: tuple[tuple[float, float], ...]

    @property
    def scene(self) -> str:
        """The folder."""
        return self.place.partition(",")[0]


def collect(data: Path, features: str, extractor: FeatureExtractor) -> Iterator[Sample]:
    """Localizes all; an hour."""
    for name, count in dict.fromkeys((*RIGHT, *PLANTED)):
        yield from collect_place(read_place(data / name, extractor), count, features, (name, count) in PLANTED)


def collect_place(place: Place, count: int | None, features: str, planted: bool) -> Iterator[Sample]:
    """Of one place."""
    pairs = list(right_pairs(place, count, (K,), features=features))
    every = [pairs[i] for i in spread(range(len(pairs)), QUERIES)]
    for it in answered(every, features=features):
        yield _sample(it, features, "")
    few = [pairs[i] for i in spread(range(len(pairs)), WRONG_QUERIES)] if planted else []
    for error, (_, wrong) in ERRORS.items():
        for it in answered([_given(pair, wrong) for pair in few], features=features):
            yield _sample(it, features, error)


def _given(pair: Pair, wrong: Callable[[Camera], Camera]) -> Pair:
    """The same photograph with other intrinsics; keypoints that have no place in them are missing."""
    view = pair.query
    lens = replace(view.camera, distortion=view.distortion)
    camera, features = wrong(lens), view.features
    pixels = undistort_pixels(lens.project(lens.rays(features.keypoints.astype(np.float64))), camera)
    seen = np.isfinite(pixels).all(axis=1)
    kept = Features(pixels[seen].astype(np.float32), features.descriptors[seen], features.sizes_px[seen])
    return replace(pair, query=View(camera.pinhole(), kept, None, camera.distortion))


def _sample(it: Measured, features: str, error: str) -> Sample:
    outcome, support = it.answer.outcome, it.answer.support
    inside = False, False
    if isinstance(outcome, Localization) and outcome.covariance is not None and it.off is not None:
        radii = accuracy_from_covariance(outcome.covariance)
        inside = bool(it.off[0] <= radii.position_95_m), bool(it.off[1] <= radii.rotation_95_deg)
    named = (
        () if isinstance(outcome, Localization) else [check for check in outcome.intrinsics_checks if check.conflict]
    )
    evidence = support.estimate.intrinsics if support and support.estimate else None
    sigmas = np.zeros((4, 2))
    if evidence is not None:
        shown = replace(ContradictionOptions(), sigmas=1e-9)
        is_determined = shown.contradicted(
            evidence.value, evidence.sigma, evidence.prior_sigma, evidence.given.width_px
        )
        together = np.stack([evidence.sigma, np.hypot(evidence.sigma, evidence.prior_sigma)], axis=1)
        sigmas = np.where(is_determined[:, None], np.abs(evidence.value)[:, None] / together, 0.0)
    return Sample(
        it.pair.title,
        features,
        error,
        it.right,
        isinstance(outcome, Localization),
        inside,
        tuple(check.parameter.value for check in named),
        tuple((alone, both) for alone, both in sigmas.tolist()),
    )


def threshold(samples: Sequence[Sample]) -> float:
    """The smallest at which few enough right photographs of every scene are contradicted."""
    steps = np.arange(2, 20, 0.25)
    largest: dict[str, list[float]] = {}
    for it in samples:
        if not it.error and it.right:
            largest.setdefault(it.scene, []).append(max(both for _, both in it.sigmas))
    alarms = np.array([[np.mean(np.array(it) > step) for it in largest.values()] for step in steps])
    return float(steps[np.argmax((alarms < FALSE_ALARMS).all(axis=1))])


def right_lines(samples: Sequence[Sample]) -> Iterator[str]:
    """Lines of a table: right photographs of each scene and kind of features."""
    yield "| scene | features | right | by sigma: 50, 68, 95, 99 % | by both: largest | threshold of others | named |"
    yield "|---|---|---|---|---|---|---|"
    for scene, features in dict.fromkeys((it.scene, it.features) for it in samples):
        own = [it for it in samples if (it.scene, it.features, it.error) == (scene, features, "") and it.right]
        if own:
            alone = np.array([it.sigmas for it in own])[..., 0]
            shown = ", ".join(f"{value:.2f}" for value in np.quantile(alone[alone > 0], [0.5, 0.68, 0.95, 0.99]))
            both = max(value for it in own for _, value in it.sigmas)
            others = threshold([it for it in samples if it.scene != scene])
            named = sum(bool(it.named) for it in own)
            yield f"| {scene} | {features} | {len(own)} | {shown} | {both:.2f} | {others:.2f} | {named} |"


def wrong_lines(samples: Sequence[Sample], key: Callable[[Sample], str]) -> Iterator[str]:
    """Lines of a table: photographs with wrong intrinsics."""
    yield "| | photographs | answered | position inside 95 % | angle | named | another named | inside or named |"
    yield "|---|---|---|---|---|---|---|---|"
    wrong = [it for it in samples if it.error]
    for label in (*dict.fromkeys(map(key, wrong)), "all"):
        own = [it for it in wrong if label in ("all", key(it))]
        given = [it for it in own if it.answered]
        inside, turned = np.sum([it.inside for it in given], axis=0, dtype=int) if given else (0, 0)
        named = [ERRORS[it.error][0].value in it.named for it in own if it.named]
        share = f"{100 * (inside + sum(named)) / max(1, len(given) + len(named)):.0f} %"
        cells = (len(own), len(given), inside, turned, sum(named), len(named) - sum(named), share)
        yield f"| {label} | {' | '.join(map(str, cells))} |"


def main() -> None:
    """Measures and prints."""
    samples = samples_of_command(__doc__, collect, lambda it: Sample(**it))
    print(f"sigmas = {threshold(samples):.2f}\n")
    for lines in (
        right_lines(samples),
        wrong_lines(samples, lambda it: f"{it.place}, {it.features}"),
        wrong_lines(samples, lambda it: it.error),
    ):
        print("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
