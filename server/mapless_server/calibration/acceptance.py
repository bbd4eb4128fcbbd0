"""Accepting and rejecting, measured: `python -m mapless_server.calibration.acceptance FOLDER_OF_SCENES`.

Two questions, asked of the method's own modules in this process, without a server. On the metric scenes: how many
right answers are accepted, and how many of the accepted are wrong? And with references of another place: is anything
accepted? The references of a query are always those that share the most features with it, as the server chooses them;
with few of them, and with references far apart, wrong poses are found.

`right_pairs`, `cross_pairs`, `answered` and the tables are there for other programs too: whoever has another rule gives
another `Judge`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from mapless.geometry import RigidTransform

from ..dataset import Frame, read_folder
from ..decode import ImageLimits, decode_image
from ..evaluation.metrics import pose_error
from ..method.coarse.make import make_reconstructor
from ..method.correspond import OPTIONS, make_matcher
from ..method.features import FeatureExtractor, make_extractor
from ..method.localize import Answer, Localization, LocalizeOptions, Pipeline, localize
from ..method.retrieve import choose_references
from ..method.views import PosedView, View
from .selective import at_coverage, auroc

RIGHT_M, RIGHT_DEG = 0.10, 5.0
"""An answer that is off by more is wrong."""
COVERAGE = 0.95
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


@dataclass(frozen=True)
class Verdict:
    """What a rule says of an answer: whether it is accepted, and a score by which answers can be ordered."""

    accepted: bool
    score: float


Judge = Callable[[Answer], Verdict]


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


def own_verdict(answer: Answer) -> Verdict:
    """The method's own: accepted is what it answers; its trust is the score, or its inliers while it has none."""
    outcome = answer.outcome
    trust = getattr(outcome, "trust", None)
    if isinstance(outcome, Localization):
        return Verdict(True, float(outcome.inlier_count) if trust is None else float(trust))
    return Verdict(False, -1.0 if trust is None else float(trust))


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


def metric_table(measured: Sequence[Measured], judge: Judge = own_verdict) -> Iterator[str]:
    """Right and wrong answers by scene and K, and all together."""
    yield (
        "| scene | K | queries | pose found | right | of these accepted | accepted | of these wrong | AUROC | "
        f"wrong at {100 * COVERAGE:g} % of the right |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|"
    settings = dict.fromkeys((it.pair.title, it.pair.k) for it in measured)
    for title, k in settings:
        yield _row(f"{title} | {k}", [it for it in measured if (it.pair.title, it.pair.k) == (title, k)], judge)
    if measured:
        yield _row("**all** | ", measured, judge)


def cross_table(measured: Sequence[Measured], judge: Judge = own_verdict, threshold: float | None = None) -> list[str]:
    """Answers of another place that are accepted; or whose score reaches a threshold."""
    verdicts = [judge(it.answer) for it in measured]
    accepted = [it for it, verdict in zip(measured, verdicts, strict=True) if verdict.accepted]
    lines = [f"{len(measured)} pairs of a query and references of another scene: {len(accepted)} accepted"]
    found = [verdict.score for it, verdict in zip(measured, verdicts, strict=True) if it.off is not None]
    if found:
        lines.append(f"{len(found)} have a pose; their highest score is {max(found):.4g}")
    if threshold is not None:
        passed = sum(score >= threshold for score in found)
        lines.append(f"{passed} reach {threshold:.4g}, with which {100 * COVERAGE:g} % of the right are accepted")
    return lines + [f"accepted: {it.pair.title}: {it.answer.outcome}" for it in accepted]


def threshold_of(measured: Sequence[Measured], judge: Judge = own_verdict) -> float | None:
    """The score at which `COVERAGE` of the right answers are accepted."""
    found = [it for it in measured if it.off is not None]
    point = at_coverage([judge(it.answer).score for it in found], [it.right for it in found], COVERAGE)
    return None if point is None else point.score


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes' folders")
    parser.add_argument("--only", choices=("metric", "cross"), action="append", help="parts; both if not given")
    parser.add_argument("--scenes", help="only these folders, by commas")
    parser.add_argument("--cross-queries", type=int, default=14, help="queries of each scene tried in all others")
    arguments = parser.parse_args()
    parts = arguments.only or ["metric", "cross"]
    known = list(dict.fromkeys([*(name for name, _ in METRIC), *OTHERS]))
    names = [name for name in known if arguments.scenes is None or name in arguments.scenes.split(",")]
    places = read_places(arguments.data, names)
    metric: list[Measured] = []
    if "metric" in parts:
        for name, count in METRIC:
            if name in places:
                metric += _shown(answered(right_pairs(places[name], count)))
        print("\n".join(metric_table(metric)), flush=True)
    if "cross" in parts:
        cross = _shown(answered(cross_pairs(list(places.values()), arguments.cross_queries)))
        print("\n" + "\n".join(cross_table(cross, threshold=threshold_of(metric))), flush=True)


def _described(extractor: FeatureExtractor, frame: Frame) -> View:
    return extractor.extract(decode_image(frame.image_path.read_bytes(), ImageLimits()), frame.camera)


def _row(head: str, measured: Sequence[Measured], judge: Judge) -> str:
    verdicts = [judge(it.answer) for it in measured]
    found = [(it, verdict) for it, verdict in zip(measured, verdicts, strict=True) if it.off is not None]
    right = sum(it.right for it, _ in found)
    accepted = [it for it, verdict in found if verdict.accepted]
    kept, wrong = sum(it.right for it in accepted), sum(not it.right for it in accepted)
    scores, rights = [verdict.score for _, verdict in found], [it.right for it, _ in found]
    point = at_coverage(scores, rights, COVERAGE)
    return (
        f"| {head} | {len(measured)} | {len(found)} | {right} | {_share(kept, right)} | {len(accepted)} | "
        f"{_share(wrong, len(accepted))} | {auroc(scores, rights):.3f} | "
        f"{'-' if point is None else _share(point.wrong, point.accepted)} |"
    )


def _share(part: int, whole: int) -> str:
    return f"{part} ({100 * part / whole:.1f} %)" if whole else "-"


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


def _shown(measured: Iterable[Measured]) -> list[Measured]:
    """All, and a sign of life for each setting."""
    done: list[Measured] = []
    for it in measured:
        if not done or done[-1].pair.title != it.pair.title:
            print(f"{it.pair.title} ...", file=sys.stderr, flush=True)
        done.append(it)
    return done


if __name__ == "__main__":
    main()
