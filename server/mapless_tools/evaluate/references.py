"""The references of each query: by feature matches, or as a file says."""

from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from mapless.text_files import numbered_lines
from mapless_server.errors import InvalidArgument
from mapless_server.images import ImageLimits, image_size
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.matching import OPTIONS, CorrespondOptions, mutual_matches
from mapless_server.method.features.views import PosedView, View
from mapless_server.scenes.retrieval.ranking import spread_choice
from mapless_server.serve.assembly import UNUSABLE, image_limits
from mapless_server.serve.features import make_first_features
from mapless_server.serve.startup import what_is_missing
from mapless_server.settings import Settings, available_cores
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.progress import Progress, tracked
from mapless_tools.usage import UsageError

T = TypeVar("T")
Pairs = Mapping[str, tuple[Frame, ...]]
"""By a query frame's name, its references, most similar first."""


@dataclass(frozen=True, eq=False)
class PlannedQuery:
    """A frame to localize and its references, most similar first; empty if the server chooses."""

    frame: Frame
    references: tuple[Frame, ...]


@dataclass(frozen=True, eq=False)
class Matcher:
    """The features by which queries and references are compared, and the ratio of their matches."""

    extractor: FeatureExtractor
    ratio: float
    limits: ImageLimits

    @classmethod
    def of(cls, settings: Settings) -> "Matcher":
        """Describes the first features that a server with these settings has; UsageError if it has none."""
        try:
            features, extractor = make_first_features(settings)
        except UNUSABLE as error:
            raise UsageError(what_is_missing(error)) from error
        return cls(extractor, OPTIONS[features].query_ratio, image_limits(settings))


def check_images(frames: Iterable[Frame], limits: ImageLimits) -> None:
    """Reads the images' headers; UsageError if one is missing, too large, no photograph, or unlike its camera."""
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


def choose_references(
    query: View, candidates: Sequence[PosedView], count: int, ratio: float = CorrespondOptions.query_ratio
) -> list[int]:
    """Indices of at most `count` candidates, most similar first; `ratio` is that of the features."""
    matches = [len(mutual_matches(query.features, c.view.features, ratio)) for c in candidates]
    return spread_choice(matches, [c.world_from_camera.translation for c in candidates], count)


def rank_by_matches(
    queries: Sequence[Frame], references: Sequence[Frame], k: int, matcher: Matcher, progress: Progress
) -> tuple[PlannedQuery, ...]:
    """Chooses for each query the k references, except itself, that share the most feature matches with it.

    The true poses are not used. The ranking is the server's own, computed here so that a query that is left out is not
    compared with itself. UsageError if an image is damaged.
    """
    used = tuple(dict.fromkeys((*references, *queries)))

    def view_of(frame: Frame) -> View:
        try:
            return frame.described(matcher.extractor, matcher.limits)
        except InvalidArgument as error:
            raise UsageError(f"{frame.image_path}: {error}") from error

    views = dict(zip(used, _map(view_of, used, "features", progress), strict=True))

    def planned(query: Frame) -> PlannedQuery:
        candidates = [frame for frame in references if frame is not query]
        posed = [PosedView(frame.name, frame.name, views[frame], frame.world_from_camera) for frame in candidates]
        chosen = choose_references(views[query], posed, k, ratio=matcher.ratio)
        return PlannedQuery(query, tuple(candidates[i] for i in chosen))

    return tuple(_map(planned, queries, "choosing references", progress))


def pairs_file(path: Path, scene: str, scene_count: int) -> Path:
    """The file of a scene's pairs, or that of its name in a folder; UsageError without one, or for several scenes."""
    if path.is_dir():
        path = path / f"{scene.replace('/', '_')}.txt"
    elif scene_count > 1:
        raise UsageError(f"{path} is one file for {scene_count} scenes: give a folder with SCENE.txt for each")
    if not path.is_file():
        raise UsageError(f"there is no file {path} with the pairs of {scene}")
    return path


def read_pairs(file: Path, dataset: Dataset, folder: Path) -> Pairs:
    """Reads the references of each query in hloc's form: lines "query reference", most similar first.

    An image is named by its path from the scene's folder, or by its frame's name. UsageError names a line that is no
    pair, or names an image that is unknown or in the wrong split.
    """
    frames = _by_name(dataset, folder)
    pairs: dict[str, list[Frame]] = {}
    try:
        lines = list(numbered_lines(file))
    except OSError as error:
        raise UsageError(f"{file} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise UsageError(str(error)) from error
    for number, line in lines:
        names = line.split()
        if not names:
            continue
        if len(names) != 2:
            raise UsageError(f"{file}, line {number}: a query and a reference are wanted, not {line.strip()!r}")
        unknown = [name for name in names if name not in frames]
        if unknown:
            raise UsageError(f"{file}, line {number}: {dataset.name} has no image {unknown[0]!r}")
        query, reference = (frames[name] for name in names)
        for frame, split in ((query, "test"), (reference, "train")):
            if frame.split != split:
                raise UsageError(f"{file}, line {number}: {frame.name} is not in the {split} split")
        if reference not in pairs.setdefault(query.name, []):
            pairs[query.name].append(reference)
    if not pairs:
        raise UsageError(f"{file} has no pairs")
    return {query: tuple(references) for query, references in pairs.items()}


def paired(pairs: Pairs, query: Frame, references: Set[str], k: int) -> PlannedQuery:
    """Makes a query with the first k of its pairs that are references of the setting; UsageError if there are none."""
    chosen = tuple(frame for frame in pairs.get(query.name, ()) if frame.name in references)[:k]
    if not chosen:
        raise UsageError(f"the pairs file names no reference of the query {query.name} among those of the setting")
    return PlannedQuery(query, chosen)


def _by_name(dataset: Dataset, folder: Path) -> dict[str, Frame]:
    root = folder.resolve()
    frames = {frame.name: frame for frame in dataset.frames}
    for frame in dataset.frames:
        path = frame.image_path.resolve()
        if path.is_relative_to(root):
            frames[path.relative_to(root).as_posix()] = frame
    return frames


def _map(function: Callable[[Frame], T], items: Sequence[Frame], step: str, progress: Progress) -> list[T]:
    with ThreadPoolExecutor(available_cores()) as pool:
        try:
            return list(tracked(step, pool.map(function, items), len(items), progress))
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
