"""Photographs with known poses and references for them: of their own place, few and far apart, and of another place.

The method's own modules work on them in this process, without a server. Folders have `cameras.json`; features are SIFT.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from mapless.geometry import RigidTransform
from mapless_server.images.decode import ImageLimits, decode_image
from mapless_server.method.answer import Answer, Localization, LocalizeOptions
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.correspond import OPTIONS, make_matcher
from mapless_server.method.features import FeatureExtractor, make_extractor
from mapless_server.method.localize import localize
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.retrieve import choose_references
from mapless_server.method.views import PosedView, View
from mapless_tools.dataset import Frame, read_folder
from mapless_tools.evaluate.metrics import pose_error

RIGHT_M, RIGHT_DEG = 0.10, 5.0
"""An answer that is off by more is wrong."""
KITCHEN = "7scenes-redkitchen-seq01-first600"
METRIC: tuple[tuple[str, int | None], ...] = (
    ("fountain-P11", None),
    ("herz-jesus-P8", None),
    (KITCHEN, 30),
    (KITCHEN, 10),
    (KITCHEN, 5),
    ("tum-fr3-office", None),
    ("kitti-drive-a", None),
)
"""Folders and how many frames, evenly spread, are references; None leaves one out."""
OTHERS = ("fox-portrait", "reichstag-internet")
"""Their unit is no metre; they serve as other places."""
KS = (10, 5, 3)
QUERIES, FRAMES = 40, 150
CROSS_REFERENCES = 30


@dataclass(frozen=True, eq=False)
class Place:
    """A scene's photographs, described.

    Attributes:
        name: of its folder.
        views, poses: by the frame's index.
    """

    name: str
    views: dict[int, View]
    poses: dict[int, RigidTransform]


@dataclass(frozen=True, eq=False)
class Pair:
    """A query and the references that it is given, the most similar first.

    Attributes:
        title: of the setting, for tables.
        k: how many references were asked for.
    """

    title: str
    k: int
    query: View
    references: tuple[PosedView, ...]
    true_pose: RigidTransform | None


@dataclass(frozen=True, eq=False)
class Measured:
    """A pair's answer and how far off its pose is; `off` is None if no pose was found, accepted or not.

    `off` is infinite where the references are of another place: whatever is answered is wrong.
    """

    pair: Pair
    answer: Answer
    off: tuple[float, float] | None

    @property
    def right(self) -> bool:
        """Whether there is a pose that is near enough to the truth."""
        return self.off is not None and self.off[0] <= RIGHT_M and self.off[1] <= RIGHT_DEG


def pose_of(answer: Answer) -> RigidTransform | None:
    """The pose that is answered, or that was found and rejected; None if none was found."""
    if isinstance(answer.outcome, Localization):
        return answer.outcome.world_from_camera
    support = answer.support
    if support is None or support.estimate is None:
        return None
    return support.estimate.world_from_camera.shifted(support.origin)


def read_places(data: Path, names: Iterable[str]) -> dict[str, Place]:
    """Features of the scenes' photographs; of long sequences of every so many-th."""
    extractor = make_extractor("sift")
    places = {}
    for name in names:
        frames = read_folder(data / name).frames
        wanted = range(0, len(frames), max(1, len(frames) // FRAMES))

        with ThreadPoolExecutor(2) as pool:
            views = dict(
                zip(wanted, pool.map(partial(_described, extractor), (frames[i] for i in wanted)), strict=True)
            )
        places[name] = Place(name, views, {i: frames[i].world_from_camera for i in wanted})
        print(f"{name}: {len(views)} photographs", file=sys.stderr, flush=True)
    return places


def right_pairs(place: Place, reference_count: int | None, ks: Sequence[int] = KS) -> Iterator[Pair]:
    """Queries of a scene with k of its references each, or all where it has fewer."""
    indices = sorted(place.views)
    references, queries = indices, indices
    if reference_count is not None:
        references = _spread(indices, reference_count)
        queries = _spread([i for i in indices[1:-1] if i not in references], QUERIES)
    title = place.name if reference_count is None else f"{place.name}, {reference_count}"
    available = len(references) - (1 if reference_count is None else 0)
    wanted = dict.fromkeys(min(k, available) for k in ks)
    for query in queries:
        chosen = _chosen(place, [i for i in references if i != query], place.views[query], max(wanted))
        for k in wanted:
            yield Pair(title, k, place.views[query], chosen[:k], place.poses[query])


def cross_pairs(places: Sequence[Place], queries_each: int, k: int = 10) -> Iterator[Pair]:
    """Queries of each scene, evenly spread, with references of every other."""
    for place in places:
        queries = _spread(sorted(place.views), queries_each)
        for other in places:
            if other is not place:
                references = _spread(sorted(other.views), CROSS_REFERENCES)
                for query in queries:
                    view = place.views[query]
                    yield Pair(f"{place.name} in {other.name}", k, view, _chosen(other, references, view, k), None)


def answered(pairs: Iterable[Pair], options: LocalizeOptions | None = None) -> Iterator[Measured]:
    """Localizes each."""
    pipeline = Pipeline(make_reconstructor("geometric", Path()), make_matcher("sift", 2))
    try:
        for pair in pairs:
            answer = localize(pair.query, pair.references, pipeline, options or LocalizeOptions())
            yield Measured(pair, answer, _off(pair, answer))
    finally:
        pipeline.matcher.close()


def _described(extractor: FeatureExtractor, frame: Frame) -> View:
    return extractor.extract(decode_image(frame.image_path.read_bytes(), ImageLimits()), frame.camera)


def _off(pair: Pair, answer: Answer) -> tuple[float, float] | None:
    pose = pose_of(answer)
    if pose is None:
        return None
    return pose_error(pair.true_pose, pose) if pair.true_pose is not None else (np.inf, np.inf)


def _chosen(place: Place, references: Sequence[int], query: View, k: int) -> tuple[PosedView, ...]:
    posed = [
        PosedView(f"{place.name}-{i}", f"scenes/{place.name}/references/{i}", place.views[i], place.poses[i])
        for i in references
    ]
    return tuple(posed[i] for i in choose_references(query, posed, k, ratio=OPTIONS["sift"].query_ratio))


def _spread(items: Sequence[int], count: int) -> list[int]:
    return [items[i] for i in dict.fromkeys(np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int))]
