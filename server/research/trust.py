"""The weights and quantiles of trust, from answers that are known to be right or wrong.

    PYTHONPATH=client:server python -m research.trust FOLDER_OF_SCENES [--samples FILE]

Natural answers are those to the queries of a scene from its own references, many and few, near and far apart. Wrong
poses come from other places; from mirrored photographs; from references two of which have wrong poses; and from
references that look elsewhere. Photographs with most of their features left out give right answers that are hard to
tell. A wrong focal length is not here: of a flat wall a photograph with another focal length is the same.

Weights by logistic regression, none below 0, so that more evidence never lowers the trust; every scene counts alike,
and so do right and wrong. Quantiles of the natural right answers alone. To test it each scene is left out once, and
judged by what the others teach.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.answer import Localization
from mapless_server.method.features import make_extractor
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pipeline import StageOptions
from mapless_server.method.rejection import RejectionReason
from mapless_server.method.trust.judge import FEATURES, LEVELS, Evidence, JudgeOptions, evidence_of, trust_of
from mapless_server.method.views import Features
from mapless_tools.dataset import read_folder

from .places import (
    KITCHEN,
    METRIC,
    OTHERS,
    Pair,
    Place,
    answered,
    cross_pairs,
    read_places,
    right_pairs,
    weights_alike,
)

KS = (10, 5, 3, 2)
SPARSE: tuple[tuple[str, int], ...] = (
    ("tum-fr3-office", 6),
    ("kitti-drive-a", 8),
    ("fountain-P11", 5),
    ("herz-jesus-P8", 4),
    (KITCHEN, 8),
)
"""Few references, far apart, of which the queries in between are given all or some."""
FEATURES_LEFT = (150, 300)
CROSS_QUERIES, CROSS_K = 6, 5
HARD_PAIRS, HARD_KS = 12, (3, 6)
COVERAGES = (0.90, 0.95, 0.99)
RIDGE = 0.005
"""On the squared weights of standardized features; four times as much changes no figure by more than a per cent."""


@dataclass(frozen=True)
class Sample:
    """An answer that passed the gate.

    Attributes:
        kind: "natural", "cross", "mirrored", "moved" (wrong reference poses), "elsewhere" (references that look away)
            or "thinned".
        scene: of the references.
        right: whether it is off by no more than 10 cm and 5 degrees.
        evidence: what speaks for it.
    """

    kind: str
    scene: str
    right: bool
    evidence: Evidence


def collect(data: Path) -> Iterator[Sample]:
    """Localizes everything in a folder of the scenes' folders; minutes."""
    metric = list(dict.fromkeys(name for name, _ in METRIC))
    places = read_places(data, [*metric, *OTHERS])
    for name, count in dict.fromkeys((*METRIC, *SPARSE)):
        yield from _samples("natural", right_pairs(places[name], count, KS))
    yield from _samples("cross", cross_pairs(list(places.values()), CROSS_QUERIES, CROSS_K))
    for name in metric:
        place, random = places[name], np.random.default_rng(11)
        pairs = [pair for pair in right_pairs(place, dict(SPARSE)[name], HARD_KS) if len(pair.references) >= 3]
        chosen = [pairs[i] for i in np.unique(np.linspace(0, len(pairs) - 1, HARD_PAIRS).round().astype(int))]
        yield from _samples("thinned", (_thinned(pair, left, random) for pair in chosen for left in FEATURES_LEFT))
        yield from _samples("moved", (_moved(pair, random) for pair in chosen))
        yield from _samples("elsewhere", _elsewhere(place))
        yield from _samples("mirrored", _mirrored(place, data / name))


def _samples(kind: str, pairs: Iterable[Pair]) -> Iterator[Sample]:
    """Of what passes the gate, accepted or not."""
    options = LocalizeOptions(coverage=1.0)
    for it in answered(pairs, options):
        support, outcome = it.answer.support, it.answer.outcome
        passed = isinstance(outcome, Localization) or outcome.reason is RejectionReason.AMBIGUOUS
        if support is not None and support.estimate is not None and passed:
            scene = it.pair.references[0].name.split("/")[1]
            yield Sample(kind, scene, it.right, evidence_of(support, StageOptions().pnp.inlier_px))


def _thinned(pair: Pair, left: int, random: np.random.Generator) -> Pair:
    """With so many of the photograph's features left."""
    f = pair.query.features
    rows = random.permutation(len(f))[:left]
    some = Features(f.keypoints[rows], f.descriptors[rows], f.sizes_px[rows])
    return replace(pair, query=replace(pair.query, features=some))


def _moved(pair: Pair, random: np.random.Generator) -> Pair:
    """With wrong poses of two references, off by 0.2, 1 or 5 metres and some degrees."""
    references = list(pair.references)
    for i in random.permutation(len(references))[:2]:
        pose, direction = references[i].world_from_camera, random.normal(size=3)
        shift = random.choice([0.2, 1.0, 5.0]) * direction / np.linalg.norm(direction)
        wrong = RigidTransform(rotation_from_vector(random.normal(0, 0.1, 3)) @ pose.rotation, pose.translation + shift)
        key = f"{references[i].key}-moved-{random.integers(2**31)}"
        references[i] = replace(references[i], key=key, world_from_camera=wrong)
    return replace(pair, references=tuple(references))


def _elsewhere(place: Place, count: int = 5) -> Iterator[Pair]:
    """With those references that look away most."""
    indices = sorted(place.views)
    for query in indices[:: max(1, len(indices) // HARD_PAIRS)]:
        ahead = place.poses[query].rotation[:, 2]
        away = sorted(indices, key=lambda i: float(ahead @ place.poses[i].rotation[:, 2]))[:count]
        references = place.posed(i for i in away if i != query)
        yield Pair(place.name, count, place.views[query], references, place.poses[query])


def _mirrored(place: Place, folder: Path) -> Iterator[Pair]:
    """The mirrored photographs, which show no place at all, with the references that the right ones are given."""
    extractor, frames = make_extractor("sift"), read_folder(folder).frames
    indices = sorted(place.views)

    def apart(first: int, second: int) -> float:
        """Metres between two photographs, and as many for each radian between their directions."""
        a, b = place.poses[first], place.poses[second]
        turned = np.arccos(np.clip(a.rotation[:, 2] @ b.rotation[:, 2], -1, 1))
        return float(np.linalg.norm(a.translation - b.translation) + turned)

    for i in indices[:: max(1, len(indices) // HARD_PAIRS)]:
        camera = frames[i].camera
        image = decode_image(frames[i].image_path.read_bytes(), ImageLimits())[:, ::-1]
        flipped = replace(camera, principal_x_px=camera.width_px - 1 - camera.principal_x_px)
        query = extractor.extract(np.ascontiguousarray(image), flipped)
        nearest = sorted((j for j in indices if j != i), key=lambda j: apart(i, j))[:6]
        yield Pair(place.name, 6, query, place.posed(nearest), None)


def fit(samples: Sequence[Sample]) -> JudgeOptions:
    """The options of the judge."""
    weights = fit_weights(samples)
    natural = [it for it in samples if it.kind == "natural" and it.right]
    quantiles = np.quantile([it.evidence.features() @ weights for it in natural], LEVELS)
    return JudgeOptions(tuple(np.round(weights, 3).tolist()), tuple(np.round(quantiles, 3).tolist()))


def fit_weights(samples: Sequence[Sample]) -> Array:
    """Weights (7,) of the features, none below 0, that tell right samples from wrong ones best.

    Minimizes the mean of log(1 + exp(-y (w . z + b))) + ridge |w|^2 over standardized features z, y = 1 or -1.
    """
    features = np.stack([it.evidence.features() for it in samples])
    sign = np.where([it.right for it in samples], 1.0, -1.0)
    share = np.zeros(len(samples))
    for side in (1.0, -1.0):
        rows = np.flatnonzero(sign == side).tolist()
        share[rows] = 0.5 * weights_alike([samples[i].scene for i in rows])
    spread = features.std(axis=0) + 1e-9
    z = (features - features.mean(axis=0)) / spread

    def loss(unknowns: Array) -> tuple[float, Array]:
        margin = sign * (z @ unknowns[:-1] + unknowns[-1])
        pull = -share * sign / (1 + np.exp(np.clip(margin, -500, 500)))
        value = share @ np.logaddexp(0, -margin) + RIDGE * unknowns[:-1] @ unknowns[:-1]
        return float(value), np.append(z.T @ pull + 2 * RIDGE * unknowns[:-1], pull.sum())

    bounds = [(0.0, None)] * len(FEATURES) + [(None, None)]
    found = minimize(loss, np.zeros(len(FEATURES) + 1), jac=True, bounds=bounds, method="L-BFGS-B")
    return np.asarray(found.x[:-1] / spread)


def left_out(samples: Sequence[Sample]) -> Iterator[str]:
    """Lines of a table: each scene judged by what the others teach, at several coverages."""
    scenes = sorted({it.scene for it in samples if it.kind == "natural"})
    trusts = np.full(len(samples), np.nan)
    for scene in scenes:
        options = fit([it for it in samples if it.scene != scene])
        for i, it in enumerate(samples):
            if it.scene == scene:
                trusts[i] = trust_of(it.evidence, options)
    kinds = np.array([it.kind for it in samples])
    right = np.array([it.right for it in samples])
    others = [kind for kind in dict.fromkeys(kinds.tolist()) if kind != "natural" and not right[kinds == kind].all()]
    yield f"| left out | coverage | right accepted | accepted, wrong | {' | '.join(f'{k}, wrong' for k in others)} |"
    yield "|---|---|---|---|" + "---|" * len(others)
    for title, chosen in [(scene, [scene]) for scene in scenes] + [("each of all", scenes)]:
        own = np.array([it.scene in chosen for it in samples])
        for coverage in COVERAGES:
            accepted = own & (trusts >= 1 - coverage)
            natural = kinds == "natural"
            cells = [
                _share(accepted & natural & right, own & natural & right),
                _share(accepted & natural & ~right, accepted & natural),
                *(_share(accepted & (kinds == k) & ~right, own & (kinds == k) & ~right) for k in others),
            ]
            yield f"| {title} | {coverage:g} | {' | '.join(cells)} |"


def _share(part: NDArray[np.bool_], whole: NDArray[np.bool_]) -> str:
    return f"{part.sum()} of {whole.sum()} ({100 * part.sum() / whole.sum():.1f} %)" if whole.any() else "-"


def main() -> None:
    """Fits and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes' folders")
    parser.add_argument("--samples", type=Path, help="read from this file if it is there, else written to it")
    arguments = parser.parse_args()
    if arguments.samples and arguments.samples.is_file():
        read = json.loads(arguments.samples.read_text())
        samples = [Sample(**{**it, "evidence": Evidence(**it["evidence"])}) for it in read]
    else:
        samples = list(collect(arguments.data))
        if arguments.samples:
            arguments.samples.write_text(json.dumps([asdict(it) for it in samples]))
    options = fit(samples)
    print(f"weights = {options.weights}\nscores = {options.scores}\n")
    print("\n".join(left_out(samples)))


if __name__ == "__main__":
    main()
