"""Photographs with features, and answers to them by the method's own modules, in this process, without a server.

A query has references of its own place, few and far apart, or of another place.
"""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapless.geometry import RigidTransform
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.bundle.estimate import PosedSupport
from mapless_server.method.bundle.priors import NO_PRIORS, Priors
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.features.extractors import make_extractor
from mapless_server.method.features.matching import OPTIONS
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.localize import localize
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pairs.make import make_matcher
from mapless_server.method.pipeline import Pipeline
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.plan import evenly_spread
from mapless_tools.evaluate.references import choose_references
from mapless_tools.ingest.formats.cameras import read_folder

from .places import DRIVE, FOUNTAIN, KITCHEN, OFFICE, distance_seen, is_right

METRIC: tuple[tuple[str, int | None], ...] = (
    (FOUNTAIN, None),
    ("herz-jesus-P8", None),
    (KITCHEN, 30),
    (KITCHEN, 10),
    (KITCHEN, 5),
    (OFFICE, None),
    (DRIVE, None),
)
"""Folders and how many frames, evenly spread, are references; None leaves one out."""
OTHERS = ("fox-portrait", "reichstag-internet")
"""Their unit is no metre; they serve as other places."""
QUERIES, FRAMES = 40, 150
CROSS_REFERENCES = 30


@dataclass(frozen=True, eq=False)
class Described:
    """A scene's photographs with their features, by the frame's index."""

    name: str
    views: dict[int, View]
    poses: dict[int, RigidTransform]
    metric: bool = True

    def posed(self, indices: Iterable[int]) -> tuple[PosedView, ...]:
        """References at some indices, as the method takes them."""
        return tuple(
            PosedView(f"{self.name}-{i}", f"scenes/{self.name}/references/{i}", self.views[i], self.poses[i])
            for i in indices
        )

    def most_matching(self, query: View, indices: Sequence[int], count: int) -> list[int]:
        """Those of some references that share the most feature matches with a query."""
        chosen = choose_references(query, self.posed(indices), count, ratio=OPTIONS["sift"].query_ratio)
        return [indices[i] for i in chosen]


@dataclass(frozen=True, eq=False)
class Pair:
    """A query and the references that it is given, at most k, the most similar first.

    `true_pose` is None in another place.
    """

    title: str
    k: int
    query: View
    references: tuple[PosedView, ...]
    true_pose: RigidTransform | None
    priors: Priors = NO_PRIORS
    metric: bool = True


@dataclass(frozen=True, eq=False)
class Measured:
    """A pair's answer and its error, in units of the scene and degrees; None if no pose was found, accepted or not.

    The error is infinite where the references are of another place: any pose is wrong.
    """

    pair: Pair
    answer: Answer
    off: tuple[float, float] | None

    @property
    def right(self) -> bool:
        """Whether there is a pose that is near enough to the truth."""
        if self.off is None or self.pair.true_pose is None or self.answer.support is None:
            return False
        support = self.answer.support
        x_in_world = support.structure.x_in_world + support.origin
        distance = distance_seen(support.query.camera, self.pair.true_pose, x_in_world)
        return is_right(*self.off, distance, self.pair.metric)


def read_place(folder: Path, wanted: Sequence[int] | None = None) -> Described:
    """The scene of a folder, with SIFT features; `wanted` are indices of frames, else evenly spread ones."""
    extractor, dataset = make_extractor("sift"), read_folder(folder)
    frames = dataset.frames

    def view_of(index: int) -> View:
        image = decode_image(frames[index].image_path.read_bytes(), ImageLimits())
        return extractor.extract(image, frames[index].camera)

    indices = range(0, len(frames), max(1, len(frames) // FRAMES)) if wanted is None else wanted
    with ThreadPoolExecutor(2) as pool:
        views = pool.map(view_of, indices)
        return Described(
            folder.name,
            dict(zip(indices, views, strict=True)),
            {i: frames[i].world_from_camera for i in indices},
            dataset.metric,
        )


def right_pairs(
    place: Described, reference_count: int | None, ks: Sequence[int], frames_apart: int = 0
) -> Iterator[Pair]:
    """Queries of a scene with k of its references each, or all where it has fewer.

    So many references are evenly spread, and queries between them; None leaves one out. References within so many
    frames of the query are not used.
    """
    indices = sorted(place.views)
    references, queries = indices, indices
    if reference_count is not None:
        references = evenly_spread(indices, reference_count)
        queries = evenly_spread([i for i in indices[1:-1] if i not in references], QUERIES)
    title = place.name if reference_count is None else f"{place.name}, {reference_count}"
    available = len(references) - (1 if reference_count is None else 0)
    wanted = dict.fromkeys(min(k, available) for k in ks)
    for query in queries:
        others = [i for i in references if i != query and abs(i - query) > frames_apart]
        if len(others) < 2:
            continue
        chosen = place.posed(place.most_matching(place.views[query], others, max(wanted)))
        for k in wanted:
            yield Pair(title, k, place.views[query], chosen[:k], place.poses[query], metric=place.metric)


def cross_pairs(places: Sequence[Described], queries_each: int, k: int = 10) -> Iterator[Pair]:
    """Queries of each scene, evenly spread, with references of every other."""
    for place in places:
        queries = evenly_spread(sorted(place.views), queries_each)
        for other in places:
            if other is not place:
                references = evenly_spread(sorted(other.views), CROSS_REFERENCES)
                for query in queries:
                    view = place.views[query]
                    chosen = other.posed(other.most_matching(view, references, k))
                    yield Pair(f"{place.name} in {other.name}", k, view, chosen, None)


def answered(pairs: Iterable[Pair], options: LocalizeOptions | None = None) -> Iterator[Measured]:
    """Localizes each."""
    pipeline = Pipeline(make_reconstructor("geometric", Path()), make_matcher("sift", 2))
    try:
        for pair in pairs:
            answer = localize(pair.query, pair.references, pipeline, options or LocalizeOptions(), priors=pair.priors)
            yield Measured(pair, answer, _error(pair, answer))
    finally:
        pipeline.matcher.close()


def _error(pair: Pair, answer: Answer) -> tuple[float, float] | None:
    """Errors of the pose that is answered, or that was found and rejected; None without a pose."""
    if isinstance(answer.outcome, Localization):
        pose = answer.outcome.world_from_camera
    elif isinstance(answer.support, PosedSupport):
        pose = answer.support.estimate.world_from_camera.shifted(answer.support.origin)
    else:
        return None
    return pose_error(pair.true_pose, pose) if pair.true_pose is not None else (np.inf, np.inf)
