"""Answers to learn trust from: right ones, and wrong ones of every kind that posed photographs can be made to give.

Natural are the queries of a scene from its own references, many and few, near and far apart. Wrong poses come from
other places; from mirrored photographs; from references two of which have wrong poses; from references that look
elsewhere; and, few, from natural queries. Photographs robbed of most of their features give right answers that are hard
to tell.

What is wrong with the camera itself is not here: of a flat wall a photograph with another focal length is the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.images.decode import ImageLimits, decode_image
from mapless_server.method.answer import Localization, LocalizeOptions
from mapless_server.method.features import make_extractor
from mapless_server.method.rejection import RejectionReason
from mapless_server.method.trust.evidence import Evidence, evidence_of
from mapless_server.method.views import Features, PosedView
from mapless_tools.dataset import Frame, read_folder

from .pairs import KITCHEN, METRIC, OTHERS, Pair, Place, answered, cross_pairs, read_places, right_pairs

KS = (10, 5, 3, 2)
SPARSE: tuple[tuple[str, int], ...] = (("tum-fr3-office", 6), ("kitti-drive-a", 8), ("fountain-P11", 5))
SPARSE += (("herz-jesus-P8", 4), (KITCHEN, 8))
"""Few references, far apart, of which the queries in between are given all or some."""
FEATURES_LEFT = (150, 300)
CROSS_QUERIES, CROSS_K = 6, 5
HARD_PAIRS, HARD_KS = 12, (3, 6)


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
        yield from _samples("mirrored", _mirrored(place, read_folder(data / name).frames))


def _samples(kind: str, pairs: Iterable[Pair]) -> Iterator[Sample]:
    """Of what passes the gate, accepted or not."""
    options = LocalizeOptions(coverage=1.0)
    for it in answered(pairs, options):
        support = it.answer.support
        outcome = it.answer.outcome
        passed = isinstance(outcome, Localization) or outcome.reason is RejectionReason.AMBIGUOUS
        if support is not None and support.estimate is not None and passed:
            scene = it.pair.references[0].name.split("/")[1]
            yield Sample(kind, scene, it.right, evidence_of(support, options.pnp.inlier_px))


def _thinned(pair: Pair, left: int, random: np.random.Generator) -> Pair:
    """With so many of the photograph's features left."""
    f = pair.query.features
    rows = random.permutation(len(f))[:left]
    return replace(pair, query=replace(pair.query, features=_some(f, rows)))


def _some(f: Features, rows: NDArray[np.intp]) -> Features:
    return Features(f.keypoints[rows], f.descriptors[rows], f.sizes_px[rows])


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
        references = _posed(place, [i for i in away if i != query])
        yield Pair(place.name, count, place.views[query], references, place.poses[query])


def _mirrored(place: Place, frames: Sequence[Frame]) -> Iterator[Pair]:
    """The mirrored photographs, which show no place at all, with the references that the right ones are given."""
    extractor = make_extractor("sift")
    indices = sorted(place.views)
    for i in indices[:: max(1, len(indices) // HARD_PAIRS)]:
        camera = frames[i].camera
        image = decode_image(frames[i].image_path.read_bytes(), ImageLimits())[:, ::-1]
        flipped = replace(camera, principal_x_px=camera.width_px - 1 - camera.principal_x_px)
        query = extractor.extract(np.ascontiguousarray(image), flipped)
        nearest = sorted((j for j in indices if j != i), key=lambda j: _apart(place, i, j))[:6]
        yield Pair(place.name, 6, query, _posed(place, nearest), None)


def _apart(place: Place, first: int, second: int) -> float:
    """Metres between two photographs, and as many for each radian between their directions."""
    a, b = place.poses[first], place.poses[second]
    between = float(np.linalg.norm(a.translation - b.translation))
    return between + float(np.arccos(np.clip(a.rotation[:, 2] @ b.rotation[:, 2], -1, 1)))


def _posed(place: Place, indices: Sequence[int]) -> tuple[PosedView, ...]:
    return tuple(
        PosedView(f"{place.name}-{i}", f"scenes/{place.name}/references/{i}", place.views[i], place.poses[i])
        for i in indices
    )
