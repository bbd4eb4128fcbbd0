"""What is to be measured: which frames are references, which are queries, and which references each query is given."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from mapless_server.errors import InvalidArgument
from mapless_server.images.decode import ImageLimits, decode_image, image_size
from mapless_server.method.answer import Variant
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.retrieve import choose_references
from mapless_server.method.scale_equations import ScaleStrategy
from mapless_server.method.views import PosedView, View
from mapless_server.settings import available_cores
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.progress import Progress

T = TypeVar("T")

MAX_K = 64
"""What one call of Localize takes."""


class UsageError(ValueError):
    """Arguments, settings or a folder are wrong, or do not fit together; the message is for a person."""


QUERY_MARGIN = 3
"""Queries beside references keep this far from the first and the last frame, so that they lie within the walk."""

DEFAULT_QUERY_COUNT = 40


@dataclass(frozen=True)
class EvaluationOptions:
    """Options of an evaluation.

    Attributes:
        reference_count: frames that are references, evenly spread; None leaves one out: every frame is localized from
            all others.
        query_count: frames that are localized, evenly spread; None means 40 beside chosen references, and all frames
            when one is left out.
        k: references that a query is given.
        variant: form of the method.
        scale_strategy: how it finds the metric scale.
    """

    reference_count: int | None = None
    query_count: int | None = None
    k: int = 10
    variant: str = "best"
    scale_strategy: str = "two_stage"

    def __post_init__(self) -> None:
        if self.reference_count is not None and self.reference_count < 2:
            raise ValueError(f"at least 2 references are needed for a baseline, not {self.reference_count}")
        if self.query_count is not None and self.query_count < 1:
            raise ValueError(f"at least 1 query is needed, not {self.query_count}")
        if not 1 <= self.k <= MAX_K:
            raise ValueError(f"k, the references of a query, must be 1 to {MAX_K}, not {self.k}")
        for name, value, known in (
            ("variant", self.variant, [v.value for v in Variant]),
            ("scale", self.scale_strategy, [s.value for s in ScaleStrategy]),
        ):
            if value not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}, not {value!r}")


@dataclass(frozen=True)
class Split:
    """Indices of the frames that are references and of those that are queries, each in order and once."""

    references: tuple[int, ...]
    queries: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class PlannedQuery:
    """A frame to localize and the references it is given, most similar first."""

    frame: Frame
    references: tuple[Frame, ...]


@dataclass(frozen=True, eq=False)
class Plan:
    """All that is to be done: upload the references, localize the queries."""

    dataset: Dataset
    references: tuple[Frame, ...]
    queries: tuple[PlannedQuery, ...]


def split_frames(frame_count: int, options: EvaluationOptions) -> Split:
    """References and queries among F frames.

    With N references: those at round(linspace(0, F - 1, N)), and those of round(linspace(3, F - 4, M)) that are not
    references as queries; fewer than 8 frames have no room for that margin, there it is round(linspace(0, F - 1, M)).
    Without N, every frame is a reference of all others.

    Raises:
        UsageError: there are too few frames.
    """
    if options.reference_count is None:
        if frame_count < 3:
            raise UsageError(f"leaving one out needs at least 3 frames, the folder has {frame_count}")
        wanted = frame_count if options.query_count is None else options.query_count
        return Split(tuple(range(frame_count)), _spread(0, frame_count - 1, wanted))
    if options.reference_count > frame_count:
        raise UsageError(f"{options.reference_count} references are wanted, the folder has {frame_count} frames")
    references = _spread(0, frame_count - 1, options.reference_count)
    margin = QUERY_MARGIN if frame_count >= 8 else 0
    wanted = DEFAULT_QUERY_COUNT if options.query_count is None else options.query_count
    candidates = _spread(margin, frame_count - 1 - margin, wanted)
    queries = tuple(sorted(set(candidates) - set(references)))
    if not queries:
        raise UsageError(
            f"with {options.reference_count} references among {frame_count} frames no frame is left as a query; take "
            "fewer references, more queries, or leave one out"
        )
    return Split(references, queries)


def check_images(frames: Iterable[Frame], limits: ImageLimits) -> None:
    """Reads the images' headers.

    Raises:
        UsageError: an image is missing, too large, no JPEG, PNG or WebP, or of another size than its camera.
    """
    for frame in frames:
        try:
            size = image_size(frame.image_path.read_bytes(), limits)
        except (InvalidArgument, OSError) as error:
            raise UsageError(f"{frame.image_path}: {error}") from error
        camera = frame.camera
        if size != (camera.width_px, camera.height_px):
            raise UsageError(
                f"{frame.image_path} has {size[0]}x{size[1]} pixels, cameras.json says "
                f"{camera.width_px}x{camera.height_px}"
            )


def make_plan(
    dataset: Dataset,
    options: EvaluationOptions,
    extractor: FeatureExtractor,
    ratio: float,
    limits: ImageLimits,
    progress: Progress,
) -> Plan:
    """Chooses references and queries, and ranks the references of each query by their feature matches with it.

    The ranking does not look at the query's true pose. It is the server's own (`retrieve`) with the extractor and ratio
    of its first features, done here because a query that is left out must not be offered itself.

    Raises:
        UsageError: too few frames, or an image is missing, damaged or of another size than its camera.
    """
    split = split_frames(len(dataset.frames), options)
    references, queries = (tuple(dataset.frames[i] for i in part) for part in (split.references, split.queries))
    check_images(dict.fromkeys((*references, *queries)), limits)
    return Plan(
        dataset, references, rank_by_matches(queries, references, options.k, extractor, ratio, limits, progress)
    )


def rank_by_matches(
    queries: Sequence[Frame],
    references: Sequence[Frame],
    k: int,
    extractor: FeatureExtractor,
    ratio: float,
    limits: ImageLimits,
    progress: Progress,
) -> tuple[PlannedQuery, ...]:
    """The queries, each with those k references, itself excepted, that share the most feature matches with it.

    Raises:
        UsageError: an image is damaged.
    """
    used = tuple(dict.fromkeys((*references, *queries)))

    def view_of(frame: Frame) -> View:
        try:
            return extractor.extract(decode_image(frame.image_path.read_bytes(), limits), frame.camera)
        except InvalidArgument as error:
            raise UsageError(f"{frame.image_path}: {error}") from error

    views = dict(zip(used, _map(view_of, used, "features", progress), strict=True))

    def planned(query: Frame) -> PlannedQuery:
        candidates = [frame for frame in references if frame is not query]
        posed = [PosedView(frame.name, frame.name, views[frame], frame.world_from_camera) for frame in candidates]
        chosen = choose_references(views[query], posed, k, ratio=ratio)
        return PlannedQuery(query, tuple(candidates[i] for i in chosen))

    return tuple(_map(planned, queries, "choosing references", progress))


def _spread(first: int, last: int, count: int) -> tuple[int, ...]:
    """`count` whole numbers evenly from `first` to `last`, rounded half to even; fewer where they coincide."""
    return tuple(dict.fromkeys(np.round(np.linspace(first, last, count)).astype(int).tolist()))


def _map(function: Callable[[Frame], T], items: Sequence[Frame], step: str, progress: Progress) -> list[T]:
    results: list[T] = []
    with ThreadPoolExecutor(available_cores()) as pool:
        progress(step, 0, len(items))
        try:
            for result in pool.map(function, items):
                results.append(result)
                progress(step, len(results), len(items))
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return results
