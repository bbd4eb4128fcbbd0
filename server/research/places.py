"""Photographs with known poses and references for them: of their own place, few and far apart, and of another place.

The method's own modules work on them in this process, without a server. Folders have `cameras.json`.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mapless.geometry import Array, RigidTransform
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.answer import Answer, Localization
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.correspond import OPTIONS, make_matcher
from mapless_server.method.features import FeatureExtractor, make_extractor
from mapless_server.method.localize import localize
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pipeline import Pipeline, StageOptions
from mapless_server.method.priors.known import NO_PRIORS, Priors
from mapless_server.method.results import Support
from mapless_server.method.views import PosedView, View
from mapless_tools.dataset import Frame
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.plan import evenly_spread
from mapless_tools.evaluate.references import choose_references
from mapless_tools.ingest.formats.cameras import read_folder

S = TypeVar("S")

EDGEPOINT2 = {"edgepoint2-l64": "edgepoint2-l64.safetensors"}
"""Learned features, and the file of their weights."""
RIGHT_SHARE, RIGHT_M, RIGHT_DEG = 0.05, 0.25, 5.0
"""An answer is wrong that is off by a larger share of the distance to what the photograph shows, by more degrees or,
in a scene in metres, by more metres."""
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
ALL = (
    *dict.fromkeys(name for name, _ in METRIC),
    *OTHERS,
    "euroc-v101-drone",
    "office-lockers",
    "meeting-room",
    "studio-flat",
    "statue-of-liberty-internet",
)
KS = (10, 5, 3)
"""References that each photograph of a place is given, the others of the place at choice."""
SPARSE: dict[str, tuple[int, ...]] = {
    KITCHEN: (30, 10, 5, 3),
    "tum-fr3-office": (6,),
    "kitti-drive-a": (8,),
    "fountain-P11": (5,),
    "herz-jesus-P8": (4,),
    "euroc-v101-drone": (20, 10, 5),
    "office-lockers": (20, 10),
    "statue-of-liberty-internet": (20, 10),
    "meeting-room": (10, 5),
    "studio-flat": (10, 5),
    "fox-portrait": (10, 5),
}
"""Few references, far apart, of which the queries in between are given ten or all."""
QUERIES, FRAMES = 40, 150
CROSS_REFERENCES = 30


@dataclass(frozen=True, eq=False)
class Place:
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

    def most_matching(self, query: View, indices: Sequence[int], count: int, features: str = "sift") -> list[int]:
        """Those of some references that share the most feature matches with a query."""
        chosen = choose_references(query, self.posed(indices), count, ratio=OPTIONS[features].query_ratio)
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
        largest = RIGHT_SHARE * _distance_seen(self.answer.support, self.pair.true_pose)
        return self.off[0] <= (min(RIGHT_M, largest) if self.pair.metric else largest) and self.off[1] <= RIGHT_DEG


def read_places(data: Path, names: Iterable[str], extractor: FeatureExtractor | None = None) -> dict[str, Place]:
    """The scenes of some folders, as `read_place` does it."""
    return {name: read_place(data / name, extractor) for name in names}


def read_place(folder: Path, extractor: FeatureExtractor | None = None, wanted: Sequence[int] | None = None) -> Place:
    """The scene of a folder, with SIFT features by default; `wanted` are indices of frames, else evenly spread ones."""
    extractor, dataset = extractor or make_extractor("sift"), read_folder(folder)
    frames = dataset.frames
    indices = range(0, len(frames), max(1, len(frames) // FRAMES)) if wanted is None else wanted
    with ThreadPoolExecutor(2) as pool:
        views = pool.map(lambda i: view_of(extractor, frames[i]), indices)
        place = Place(
            folder.name,
            dict(zip(indices, views, strict=True)),
            {i: frames[i].world_from_camera for i in indices},
            dataset.metric,
        )
    print(f"{place.name}: {len(place.views)} photographs", file=sys.stderr, flush=True)
    return place


def view_of(extractor: FeatureExtractor, frame: Frame) -> View:
    """A photograph with its features."""
    return extractor.extract(decode_image(frame.image_path.read_bytes(), ImageLimits()), frame.camera)


def right_pairs(
    place: Place, reference_count: int | None, ks: Sequence[int] = KS, frames_apart: int = 0, features: str = "sift"
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
        chosen = place.posed(place.most_matching(place.views[query], others, max(wanted), features))
        for k in wanted:
            yield Pair(title, k, place.views[query], chosen[:k], place.poses[query], metric=place.metric)


def natural_pairs(place: Place, features: str = "sift") -> Iterator[Pair]:
    """All queries of a place with many and few of its references, near and far apart."""
    if place.name != KITCHEN:  # a film, where a photograph's neighbours are all but the same
        yield from right_pairs(place, None, KS, features=features)
    for count in SPARSE.get(place.name, ()):
        yield from right_pairs(place, count, (min(10, count),), features=features)


def cross_pairs(places: Sequence[Place], queries_each: int, k: int = 10, features: str = "sift") -> Iterator[Pair]:
    """Queries of each scene, evenly spread, with references of every other."""
    for place in places:
        queries = evenly_spread(sorted(place.views), queries_each)
        for other in places:
            if other is not place:
                references = evenly_spread(sorted(other.views), CROSS_REFERENCES)
                for query in queries:
                    view = place.views[query]
                    chosen = other.posed(other.most_matching(view, references, k, features))
                    yield Pair(f"{place.name} in {other.name}", k, view, chosen, None)


def answered(
    pairs: Iterable[Pair],
    options: LocalizeOptions | None = None,
    features: str = "sift",
    stages: StageOptions | None = None,
) -> Iterator[Measured]:
    """Localizes each; a line on standard error for each setting."""
    pipeline = Pipeline(make_reconstructor("geometric", Path()), make_matcher(features, 2), stages or StageOptions())
    title = ""
    try:
        for pair in pairs:
            if pair.title != title:
                title = pair.title
                print(f"{title} ...", file=sys.stderr, flush=True)
            answer = localize(pair.query, pair.references, pipeline, options or LocalizeOptions(), priors=pair.priors)
            yield Measured(pair, answer, _error(pair, answer))
    finally:
        pipeline.matcher.close()


def weights_alike(scenes: Sequence[str]) -> Array:
    """Weights (N,) of sum one, with which every scene counts alike."""
    names, index, counts = np.unique(np.array(scenes, dtype=object), return_inverse=True, return_counts=True)
    return np.asarray(1 / (len(names) * counts[index]))


def _error(pair: Pair, answer: Answer) -> tuple[float, float] | None:
    """Of the pose that is answered, or that was found and rejected."""
    if isinstance(answer.outcome, Localization):
        pose = answer.outcome.world_from_camera
    elif answer.support is not None and answer.support.estimate is not None:
        pose = answer.support.estimate.world_from_camera.shifted(answer.support.origin)
    else:
        return None
    return pose_error(pair.true_pose, pose) if pair.true_pose is not None else (np.inf, np.inf)


def _distance_seen(support: Support, true_pose: RigidTransform) -> float:
    """Median depth of the points that are inside the photograph at its true pose; 0 without any."""
    camera, x_in_world = support.query.camera, support.structure.x_in_world
    x_in_camera = true_pose.shifted(-support.origin).inverse().apply(x_in_world)
    projected = camera.project(x_in_camera)
    inside = ((projected >= 0) & (projected < [camera.width_px, camera.height_px])).all(axis=1)
    return float(np.median(x_in_camera[inside, 2])) if inside.any() else 0.0


def samples_of_command(
    description: str | None,
    collect: Callable[[Path, str, FeatureExtractor], Iterator[S]],
    from_json: Callable[[dict[str, Any]], S],
    learned: Mapping[str, str] = EDGEPOINT2,
) -> list[S]:
    """Returns what a program measures (dataclasses) with SIFT and learned features, or has written to `--samples`."""
    parser = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes' folders")
    parser.add_argument("--weights", type=Path, help=f"folder with {', '.join(learned.values())}, for these too")
    parser.add_argument("--samples", type=Path, help="read from this file if it is there, else written to it")
    arguments = parser.parse_args()
    if arguments.samples and arguments.samples.is_file():
        return [from_json(it) for it in json.loads(arguments.samples.read_text())]
    samples = list(collect(arguments.data, "sift", make_extractor("sift")))
    for name, file in learned.items() if arguments.weights else ():
        samples += collect(arguments.data, name, make_extractor(name, arguments.weights / file))
    if arguments.samples:
        arguments.samples.write_text(json.dumps([asdict(it) for it in samples]))  # type: ignore[call-overload]
    return samples
