"""Retrieval, measured: `python -m research.retrieval FOLDER_OF_SCENES` prints Markdown.

Three questions. Is there a reference among the ten that sees the same place? Is a photograph localized as well from
them as from the best ones? What does a ranking cost, and in how much memory? The first two are asked on real scenes;
the last of random vectors, because time does not depend on what they are, and in processor time of the one thread that
ranks.
"""

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from mapless.geometry import Array, Camera, RigidTransform
from mapless_server.method.answer import Localization
from mapless_server.method.features import FEATURES, make_extractor
from mapless_server.method.views import Features, View
from mapless_server.networks.weights import find_weights
from mapless_server.scenes import RankOptions, Selection, rank_references
from mapless_server.scenes.retrieval.index import Entries, SceneIndex
from mapless_server.scenes.retrieval.vlad import DIMENSION, VladDescriptor
from mapless_server.store import IndexedReference, SceneChanges
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.plan import EvaluationOptions, split_frames
from mapless_tools.ingest.formats.cameras import read_folder

from .places import KITCHEN, Pair, Place, answered, read_place

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
    """References and queries of a place, as frame indices, and the references' index, whose ids these are."""

    title: str
    place: Place
    references: tuple[int, ...]
    queries: tuple[int, ...]
    features: str
    descriptor: VladDescriptor
    entries: Entries

    def others(self, query: int) -> list[int]:
        """The references except the query itself."""
        return [reference for reference in self.references if reference != query]

    def retrieved(self, query: int, options: RankOptions | None = None, count: int = COUNT) -> list[int]:
        """The answer of RetrieveReferences."""
        vector = self.descriptor.describe(self.place.views[query])
        among = {str(reference) for reference in self.others(query)}
        selection = Selection(count, among=among, options=options or RankOptions())
        return [int(it.reference_id) for it in rank_references(self.entries, vector, selection)]

    def matched(self, query: int, shortlist: Sequence[int]) -> list[int]:
        """Those of a shortlist with the most feature matches."""
        return self.place.most_matching(self.place.views[query], shortlist, COUNT, self.features)

    def errors(self, query: int, references: Sequence[int]) -> Array:
        """Distance and angle (N, 2) between the query's camera and references'."""
        poses = self.place.poses
        return np.array([pose_error(poses[query], poses[it]) for it in references]).reshape(-1, 2)

    def nearest(self, query: int) -> list[int]:
        """The references that truly stand nearest, in units of what counts as near."""
        others = self.others(query)
        away = (self.errors(query, others) / (NEAR_M, NEAR_DEG)).sum(axis=1)
        return [others[i] for i in np.argsort(away, kind="stable")[:COUNT]]

    def is_near(self, query: int, references: Sequence[int]) -> bool:
        """Whether one of the references sees the same place."""
        return bool((self.errors(query, references) <= (NEAR_M, NEAR_DEG)).all(axis=1).any())


def read_cases(data: Path, features: str, weights_dir: Path, query_count: int) -> Iterator[Case]:
    """The scenes' photographs, with learned features or SIFT."""
    extractor = make_extractor(features, None if features == "sift" else find_weights(features, weights_dir))
    descriptor = VladDescriptor.of(extractor)
    for folder in dict.fromkeys(folder for folder, _ in SCENES):
        frame_count = len(read_folder(data / folder).frames)
        splits = {
            count: split_frames(frame_count, EvaluationOptions(count, None if count is None else query_count))
            for count in [count for it, count in SCENES if it == folder]
        }
        used = {i for split in splits.values() for i in (*split.references, *split.queries)}
        place = read_place(data / folder, extractor, sorted(used))
        for count, split in splits.items():
            title = folder if count is None else f"{folder}, {count}"
            entries = _index(place, split.references, descriptor).entries()
            yield Case(title, place, split.references, split.queries, features, descriptor, entries)


def _index(place: Place, references: Sequence[int], descriptor: VladDescriptor) -> SceneIndex:
    index = SceneIndex(descriptor.dimension)
    added = [IndexedReference(str(i), str(i), place.poses[i], descriptor.describe(place.views[i])) for i in references]
    index.apply(SceneChanges(1, tuple(added), frozenset(), True))
    return index


def near_table(cases: Sequence[Case]) -> Iterator[str]:
    """How many queries get a reference that sees the same place."""
    yield f"| scene | queries | there is one within {NEAR_M} m, {NEAR_DEG:g}° | among {COUNT} | thinned | first |"
    yield "|---|---|---|---|---|---|"
    for case in cases:
        rules: list[Callable[[int], list[int]]] = [
            case.others,
            partial(case.retrieved, options=UNTHINNED),
            case.retrieved,
            lambda query: case.retrieved(query)[:1],  # noqa: B023
        ]
        shares = [np.mean([case.is_near(query, rule(query)) for query in case.queries]) for rule in rules]
        yield f"| {case.title} | {len(case.queries)} | {' | '.join(f'{100 * share:.1f} %' for share in shares)} |"


def localize_table(cases: Sequence[Case], query_count: int) -> Iterator[str]:
    """Errors of whole localizations from retrieved references and from the best ones."""
    yield "| scene | queries | references | median | 90 % | lost |"
    yield "|---|---|---|---|---|---|"
    for case in cases:
        spread = np.linspace(0, len(case.queries) - 1, min(query_count, len(case.queries))).round().astype(int)
        queries = [case.queries[i] for i in spread]
        rules: dict[str, Callable[[int], list[int]]] = {
            "similar": case.retrieved,
            "similar, not thinned": partial(case.retrieved, options=UNTHINNED),
            "most matches, of the 20 most similar": lambda q: case.matched(q, case.retrieved(q, UNTHINNED, 20)),  # noqa: B023
            "most matches, of the 30 most similar": lambda q: case.matched(q, case.retrieved(q, UNTHINNED, 30)),  # noqa: B023
            "most matches, of all": lambda q: case.matched(q, case.others(q)),  # noqa: B023
            "truly nearest": case.nearest,
        }
        place = case.place
        for name, rule in rules.items():
            pairs = (
                Pair(f"{case.title}, {name}", COUNT, place.views[q], place.posed(rule(q)), place.poses[q])
                for q in queries
            )
            errors = np.array(
                [
                    it.off if isinstance(it.answer.outcome, Localization) and it.off else (math.inf, math.inf)
                    for it in answered(pairs, features=case.features)
                ]
            )
            median, most = np.median(errors, axis=0), np.percentile(errors, 90, axis=0, method="lower")
            yield (
                f"| {case.title} | {len(queries)} | {name} | {100 * median[0]:.3f} cm, {median[1]:.4f}° | "
                f"{100 * most[0]:.2f} cm, {most[1]:.3f}° | {np.isinf(errors[:, 0]).sum()} |"
            )


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
        milliseconds = _ms(partial(rank_references, index.entries(), vector, Selection(COUNT)))
        held = index.size_bytes
        yield f"| {size:,} | {milliseconds} | {held / 2**20:.0f} MiB | {held / size:.0f} bytes |"


def _random_index(random: np.random.Generator, size: int) -> SceneIndex:
    index = SceneIndex(DIMENSION)
    for generation, start in enumerate(range(0, size, 10_000)):
        count = min(10_000, size - start)
        vectors = random.standard_normal((count, DIMENSION), np.float32)
        poses = [RigidTransform(np.eye(3), centre) for centre in 100 * random.random((count, 3))]
        added = tuple(
            IndexedReference(f"reference-{start + i:07d}", f"{start + i:032x}", poses[i], vectors[i])
            for i in range(count)
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
    cases: list[Case] = []
    if parts != ["time"]:
        cases = list(read_cases(arguments.data, arguments.features, arguments.weights_dir, arguments.queries))
    tables: dict[str, Callable[[], Iterator[str]]] = {
        "near": partial(near_table, cases),
        "localize": partial(localize_table, cases, arguments.localize_queries),
        "time": time_table,
    }
    for part in parts:
        for line in tables[part]():
            print(line, flush=True)
        print()


if __name__ == "__main__":
    main()
