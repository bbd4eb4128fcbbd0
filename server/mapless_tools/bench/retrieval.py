"""Retrieval measured: `python -m mapless_tools.bench.retrieval FOLDER_OF_SCENES` prints Markdown.

Three questions. Is there a reference among the ten that sees the same place? Is a photograph localized as well from
them as from the best ones? What does a ranking cost, and in how much memory? The first two are asked on real scenes
with the method's own modules in this process; the last of random vectors, because time does not depend on what they
are, and in processor time of the one thread that ranks.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from mapless.geometry import Array, Camera, RigidTransform
from mapless_server.images.decode import ImageLimits, decode_image
from mapless_server.method.answer import Localization, LocalizeOptions
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.correspond import OPTIONS, make_matcher
from mapless_server.method.features import FEATURES, make_extractor
from mapless_server.method.localize import localize
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.retrieve import choose_references
from mapless_server.method.views import Features, PosedView, View
from mapless_server.networks.weights import find_weights
from mapless_server.scenes.retrieval.index import Entries, SceneIndex
from mapless_server.scenes.retrieval.ranking import RankOptions, rank_references
from mapless_server.scenes.retrieval.vlad import DIMENSION, VladDescriptor
from mapless_server.store import IndexedReference, SceneChanges
from mapless_tools.dataset import Dataset, read_folder
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.plan import EvaluationOptions, split_frames

from .scenes import KITCHEN

NEAR_M, NEAR_DEG = 0.5, 30.0
COUNT = 10
SIZES = (1_000, 10_000, 100_000, 1_000_000)
UNTHINNED = RankOptions(nearby_weight=1.0)

SCENES: tuple[tuple[str, int | None], ...] = (
    (KITCHEN, 100),
    (KITCHEN, 30),
    ("fountain-P11", None),
    ("herz-jesus-P8", None),
    ("tum-fr3-office", None),
    ("kitti-drive-a", None),
)
"""Folders and how many frames are references; None leaves one out."""


@dataclass(frozen=True, eq=False)
class Case:
    """Photographs of one place: the references, and the queries as indices into `views`.

    Attributes:
        entries: of the references; their ids are indices into `views` as text.
    """

    title: str
    views: dict[int, View]
    poses: dict[int, RigidTransform]
    references: tuple[int, ...]
    queries: tuple[int, ...]
    descriptor: VladDescriptor
    entries: Entries

    def others(self, query: int) -> list[int]:
        """The references less the query itself."""
        return [reference for reference in self.references if reference != query]

    def retrieved(self, query: int, options: RankOptions | None = None, count: int = COUNT) -> list[int]:
        """What RetrieveReferences answers."""
        vector = self.descriptor.describe(self.views[query])
        among = {str(reference) for reference in self.others(query)}
        return [int(it.reference_id) for it in rank_references(self.entries, vector, count, None, among, options)]

    def matched(self, query: int, ratio: float, times: int) -> list[int]:
        """What Localize uses: those with the most matches, of so many times the references that resemble it most."""
        shortlist = self.retrieved(query, UNTHINNED, times * COUNT)
        chosen = choose_references(self.views[query], self.posed(shortlist), COUNT, ratio=ratio)
        return [shortlist[i] for i in chosen]

    def errors(self, query: int, references: Sequence[int]) -> Array:
        """Distance and angle (N, 2) between the query's camera and references'."""
        return np.array([pose_error(self.poses[query], self.poses[it]) for it in references]).reshape(-1, 2)

    def nearest(self, query: int) -> list[int]:
        """The references that truly stand nearest, in units of what counts as near."""
        others = self.others(query)
        away = (self.errors(query, others) / (NEAR_M, NEAR_DEG)).sum(axis=1)
        return [others[i] for i in np.argsort(away, kind="stable")[:COUNT]]

    def most_matching(self, query: int, ratio: float) -> list[int]:
        """The references that share the most matches with the query, after comparing it with all."""
        others = self.others(query)
        chosen = choose_references(self.views[query], self.posed(others), COUNT, ratio=ratio)
        return [others[i] for i in chosen]

    def posed(self, references: Sequence[int]) -> list[PosedView]:
        """As the method wants them."""
        return [PosedView(str(i), f"scenes/a/references/{i}", self.views[i], self.poses[i]) for i in references]


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes' folders")
    parser.add_argument("--features", choices=FEATURES, default="sift")
    parser.add_argument("--weights-dir", type=Path, default=Path("weights"))
    parser.add_argument("--queries", type=int, default=150, help="of a scene with chosen references, at most")
    parser.add_argument("--localize-queries", type=int, default=60, help="of these, how many are localized as well")
    parser.add_argument("--only", choices=("near", "localize", "time"), action="append", help="parts; all if not given")
    arguments = parser.parse_args()
    parts = arguments.only or ["near", "localize", "time"]
    if parts != ["time"]:
        cases = [case for case in _cases(arguments) if case is not None]
        if "near" in parts:
            print_lines(near_table(cases))
        if "localize" in parts:
            print_lines(localize_table(cases, arguments.features, arguments.localize_queries))
    if "time" in parts:
        print_lines(time_table())


def print_lines(lines: Iterator[str]) -> None:
    """Each as soon as it is known."""
    for line in lines:
        print(line, flush=True)
    print()


def near_table(cases: Sequence[Case]) -> Iterator[str]:
    """How many queries get a reference that sees the same place."""
    yield f"| scene | queries | there is one within {NEAR_M} m, {NEAR_DEG:g}° | among {COUNT} | thinned | first |"
    yield "|---|---|---|---|---|---|"
    for case in cases:
        rules: list[Callable[[int], list[int]]] = [
            case.others,
            partial(case.retrieved, options=UNTHINNED),
            case.retrieved,
        ]
        columns = [np.mean([_is_near(case, query, rule(query)) for query in case.queries]) for rule in rules]
        first = np.mean([_is_near(case, query, case.retrieved(query)[:1]) for query in case.queries])
        shares = " | ".join(f"{100 * share:.1f} %" for share in (*columns, first))
        yield f"| {case.title} | {len(case.queries)} | {shares} |"


def localize_table(cases: Sequence[Case], features: str, query_count: int) -> Iterator[str]:
    """Errors of whole localizations from retrieved references and from the best ones."""
    yield "| scene | queries | references | median | 90 % | lost |"
    yield "|---|---|---|---|---|---|"
    ratio = OPTIONS[features].query_ratio
    for case in cases:
        pipeline = Pipeline(make_reconstructor("geometric", Path()), make_matcher(features, 2))
        spread = np.linspace(0, len(case.queries) - 1, min(query_count, len(case.queries))).round().astype(int)
        queries = [case.queries[i] for i in spread]

        rules: dict[str, Callable[[int], list[int]]] = {
            "similar": case.retrieved,
            "similar, not thinned": partial(case.retrieved, options=UNTHINNED),
            "most matches, of the 20 most similar": partial(case.matched, ratio=ratio, times=2),
            "most matches, of the 30 most similar": partial(case.matched, ratio=ratio, times=3),
            "most matches, of all": partial(case.most_matching, ratio=ratio),
            "truly nearest": case.nearest,
        }
        for name, rule in rules.items():
            errors = np.array([_localized(case, query, rule(query), pipeline) for query in queries])
            median, most = np.median(errors, axis=0), np.percentile(errors, 90, axis=0, method="lower")
            lost = int(np.isinf(errors[:, 0]).sum())
            yield (
                f"| {case.title} | {len(queries)} | {name} | {100 * median[0]:.3f} cm, {median[1]:.4f}° | "
                f"{100 * most[0]:.2f} cm, {most[1]:.3f}° | {lost} |"
            )
        pipeline.matcher.close()


def time_table() -> Iterator[str]:
    """What a ranking costs, by the number of references; 2048 features of 128 numbers are described first."""
    random = np.random.default_rng(0)
    descriptors = random.random((2048, 128), np.float32)
    features = descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
    descriptor = VladDescriptor.of(make_extractor("sift"))
    nowhere = np.zeros((len(features), 2), np.float32)
    view = View(Camera(640, 480, 500, 500, 320, 240), Features(nowhere, features, nowhere[:, 0]))
    vector = descriptor.describe(view)
    yield f"Describing 2048 features: {_ms(partial(descriptor.describe, view))}\n"
    yield "| references | ranking | memory | a reference |"
    yield "|---|---|---|---|"
    for size in SIZES:
        index = _random_index(random, size)
        entries = index.entries()
        milliseconds = _ms(partial(rank_references, entries, vector, COUNT))
        held = index.size_bytes
        yield f"| {size:,} | {milliseconds} | {held / 2**20:.0f} MiB | {held / size:.0f} bytes |"


def _cases(arguments: argparse.Namespace) -> Iterator[Case | None]:
    weights = None if arguments.features == "sift" else find_weights(arguments.features, arguments.weights_dir)
    extractor = make_extractor(arguments.features, weights)
    known: dict[str, tuple[Dataset, dict[int, View]]] = {}
    for folder, reference_count in SCENES:
        if not (arguments.data / folder / "cameras.json").is_file():
            print(f"{folder} is absent")
            yield None
            continue
        dataset, views = known.setdefault(folder, (read_folder(arguments.data / folder), {}))
        query_count = None if reference_count is None else arguments.queries
        split = split_frames(len(dataset.frames), EvaluationOptions(reference_count, query_count))
        for i in sorted({*split.references, *split.queries} - views.keys()):
            frame = dataset.frames[i]
            views[i] = extractor.extract(decode_image(frame.image_path.read_bytes(), ImageLimits()), frame.camera)
        poses = {i: frame.world_from_camera for i, frame in enumerate(dataset.frames)}
        descriptor = VladDescriptor.of(extractor)
        index = SceneIndex(descriptor.dimension)
        added = [IndexedReference(str(i), str(i), poses[i], descriptor.describe(views[i])) for i in split.references]
        index.apply(SceneChanges(1, tuple(added), frozenset(), True))
        title = folder if reference_count is None else f"{folder}, {reference_count}"
        yield Case(title, views, poses, split.references, split.queries, descriptor, index.entries())


def _is_near(case: Case, query: int, references: Sequence[int]) -> bool:
    return bool((case.errors(query, references) <= (NEAR_M, NEAR_DEG)).all(axis=1).any())


def _localized(case: Case, query: int, references: Sequence[int], pipeline: Pipeline) -> tuple[float, float]:
    outcome = localize(case.views[query], case.posed(references), pipeline, LocalizeOptions()).outcome
    if not isinstance(outcome, Localization):
        return math.inf, math.inf
    return pose_error(case.poses[query], outcome.world_from_camera)


def _random_index(random: np.random.Generator, size: int) -> SceneIndex:
    index = SceneIndex(DIMENSION)
    for generation, start in enumerate(range(0, size, 10_000)):
        count = min(10_000, size - start)
        vectors = random.standard_normal((count, DIMENSION), np.float32)
        centres = 100 * random.random((count, 3))
        added = tuple(
            IndexedReference(
                f"reference-{start + i:07d}", f"{start + i:032x}", RigidTransform(np.eye(3), centre), vector
            )
            for i, (vector, centre) in enumerate(zip(vectors, centres, strict=True))
        )
        index.apply(SceneChanges(generation, added, frozenset(), generation == 0))
    return index


def _ms(work: Callable[[], object]) -> str:
    seconds = []
    for _ in range(20):
        start_s = time.thread_time()
        work()
        seconds.append(time.thread_time() - start_s)
    return f"{1000 * np.median(seconds):.2f} ms (worst of 20: {1000 * max(seconds):.2f})"


if __name__ == "__main__":
    main()
