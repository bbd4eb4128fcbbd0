"""The quantiles of trust, from answers that are known to be right, and what they accept in a place left out.

    PYTHONPATH=client:server python -m research.trust FOLDER_OF_SCENES [--weights FOLDER] [--samples FILE]

Natural answers are those to the queries of a place from its own references, many and few, near and far apart. Wrong
poses come from other places; from mirrored photographs; from references two of which have wrong poses; and from
references that look elsewhere. Photographs with most of their features left out give right answers that are hard to
tell. A wrong focal length is not here: of a flat wall a photograph with another focal length is the same.

Quantiles of the natural right answers alone, of the third of the places where they have the least evidence, in which
every place counts alike: with quantiles of all places, 60 to 80 % of the right answers in a difficult place were
accepted where 97 % were promised. To test them each place is left out once, and judged by what the others teach.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.answer import Localization
from mapless_server.method.correspond import make_matcher
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.rejection import RejectionReason
from mapless_server.method.trust.evidence import Evidence, evidence_of, votes_of
from mapless_server.method.trust.judge import LEVELS
from mapless_server.method.views import Features
from mapless_tools.ingest.formats.cameras import read_folder

from .places import (
    ALL,
    SPARSE,
    Pair,
    Place,
    answered,
    cross_pairs,
    natural_pairs,
    read_places,
    right_pairs,
    samples_of_command,
    weights_alike,
)

LEARNED = {"edgepoint2-l64": "edgepoint2-l64.safetensors", "aliked": "aliked-n16.safetensors"}
"""Further kinds of features, and the files of their weights."""
FEATURES_LEFT = (150, 300)
CROSS_QUERIES, CROSS_K = 8, 5
HARD_PAIRS, HARD_KS = 12, (3, 6)
COVERAGES = (0.90, 0.95, 0.97, 0.98, 0.99)
DIFFICULT_PLACES, DIFFICULTY_LEVEL = 1 / 3, 0.05
"""The quantiles are of this share of the places, with the lowest scores at this level."""


@dataclass(frozen=True)
class Sample:
    """A pose that passed the gate, with its evidence, and whether it is near enough to the truth (`Measured.right`).

    Its kind is "natural", "cross", "mirrored", "moved" (wrong reference poses), "elsewhere" (references that look away)
    or "thinned".
    """

    kind: str
    place: str
    features: str
    right: bool
    evidence: Evidence


def collect(data: Path, features: str, extractor: FeatureExtractor) -> Iterator[Sample]:
    """Localizes everything in a folder of the scenes' folders; half an hour, with ALIKED an hour."""
    places = read_places(data, ALL, extractor)
    for place in places.values():
        yield from _samples("natural", natural_pairs(place, features), features)
    yield from _samples("cross", cross_pairs(list(places.values()), CROSS_QUERIES, CROSS_K, features), features)
    for name, place in places.items():
        random = np.random.default_rng(11)
        few = min(SPARSE.get(name, (5,)))
        pairs = [p for p in right_pairs(place, max(few, 4), HARD_KS, features=features) if len(p.references) >= 3]
        chosen = [pairs[i] for i in np.unique(np.linspace(0, len(pairs) - 1, HARD_PAIRS).round().astype(int))]
        thinned = (_thinned(pair, left, random) for pair in chosen for left in FEATURES_LEFT)
        yield from _samples("thinned", thinned, features)
        yield from _samples("moved", (_moved(pair, random) for pair in chosen), features)
        yield from _samples("elsewhere", _elsewhere(place), features)
        yield from _samples("mirrored", _mirrored(place, data / name, extractor), features)


def _samples(kind: str, pairs: Iterable[Pair], features: str) -> Iterator[Sample]:
    """Of what passes the gate, accepted or not."""
    matcher = make_matcher(features)
    for it in answered(pairs, LocalizeOptions(coverage=1.0), features):
        support, outcome = it.answer.support, it.answer.outcome
        # What judge rejects has a hint, or names two poses; what the gate rejects has neither.
        judged = isinstance(outcome, Localization) or outcome.hint or outcome.reason is RejectionReason.AMBIGUOUS
        if support is not None and support.estimate is not None and judged:
            matches = matcher.match_query(it.pair.query, it.pair.references)
            votes = votes_of(support, matches)
            place = it.pair.references[0].name.split("/")[1]
            yield Sample(kind, place, features, it.right, evidence_of(support, votes, matches))
    matcher.close()


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
        yield Pair(place.name, count, place.views[query], references, place.poses[query], metric=place.metric)


def _mirrored(place: Place, folder: Path, extractor: FeatureExtractor) -> Iterator[Pair]:
    """The mirrored photographs, which show no place at all, with the references that the right ones are given."""
    frames, indices = read_folder(folder).frames, sorted(place.views)

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


def fit(samples: Sequence[Sample]) -> Array:
    """Quantiles of the scores of natural right answers at `LEVELS`, in difficult places; places and features alike."""
    scores: dict[str, dict[str, list[float]]] = {}
    for it in samples:
        if it.kind == "natural" and it.right:
            scores.setdefault(it.place, {}).setdefault(it.features, []).append(it.evidence.score)
    lowest = {
        place: float(np.mean([np.quantile(it, DIFFICULTY_LEVEL) for it in by_features.values()]))
        for place, by_features in scores.items()
    }
    difficult = sorted(lowest, key=lowest.__getitem__)[: max(1, round(DIFFICULT_PLACES * len(lowest)))]
    groups = {f"{place} {name}": it for place in difficult for name, it in scores[place].items()}
    weights = weights_alike([name for name, group in groups.items() for _ in group])
    pooled = np.concatenate([np.array(it) for it in groups.values()])
    return np.asarray(np.quantile(pooled, LEVELS, weights=weights, method="inverted_cdf"))


def left_out(samples: Sequence[Sample]) -> Iterator[str]:
    """Lines of a table: each place judged by what the others teach, at several coverages."""
    places = sorted({it.place for it in samples if it.kind == "natural"})
    trusts = np.full(len(samples), np.nan)
    for place in places:
        scores = fit([it for it in samples if it.place != place])
        for i, it in enumerate(samples):
            if it.place == place:
                trusts[i] = np.interp(it.evidence.score, scores, LEVELS)
    kinds, right = (np.array([getattr(it, name) for it in samples]) for name in ("kind", "right"))
    others = [kind for kind in dict.fromkeys(kinds.tolist()) if kind != "natural" and not right[kinds == kind].all()]
    heads = ["left out", "features", "coverage", "right accepted", "accepted, wrong", *(f"{k}, wrong" for k in others)]
    yield f"| {' | '.join(heads)} |"
    yield "|---|---|---|---|---|" + "---|" * len(others)
    natural = kinds == "natural"
    for features in dict.fromkeys(it.features for it in samples):
        for title, chosen in [(place, [place]) for place in places] + [("each of all", places)]:
            own = np.array([it.place in chosen and it.features == features for it in samples])
            for coverage in COVERAGES:
                accepted = own & (trusts >= 1 - coverage)
                cells = [
                    _share(accepted & natural & right, own & natural & right),
                    _share(accepted & natural & ~right, accepted & natural),
                    *(_share(accepted & (kinds == k) & ~right, own & (kinds == k) & ~right) for k in others),
                ]
                yield f"| {title} | {features} | {coverage:g} | {' | '.join(cells)} |"


def _share(part: NDArray[np.bool_], whole: NDArray[np.bool_]) -> str:
    return f"{part.sum()} of {whole.sum()} ({100 * part.sum() / whole.sum():.1f} %)" if whole.any() else "-"


def main() -> None:
    """Fits and prints."""
    samples = samples_of_command(
        __doc__, collect, lambda it: Sample(**{**it, "evidence": Evidence(**it["evidence"])}), LEARNED
    )
    print(f"scores = {tuple(np.round(fit(samples), 3).tolist())}\n")
    print("\n".join(left_out(samples)))


if __name__ == "__main__":
    main()
