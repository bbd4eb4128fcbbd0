"""The order of the steps, from videos and photographs to a folder of photographs with poses.

Each step keeps its result in `OUT/.work`, under a name made of what it depends on, so that a run that was interrupted
continues, and one with another unit or part computes only what differs. The folder gets its files when all are made.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import pycolmap

from mapless_server import __version__
from mapless_server.choices import AUTO, BEST_VARIANTS, FEATURES
from mapless_server.method.features.matching import OPTIONS
from mapless_server.scenes.retrieval.vlad import VladDescriptor
from mapless_server.serve.features import ANY_ROLL, make_first_features
from mapless_server.settings import available_cores, load_settings
from mapless_tools.progress import Progress, labelled

from .cameras import LensOptions, StartingCamera, starting_cameras
from .features import FeatureFolder
from .mapping import FEWEST, map_photographs, omitted, read_parts, why_no_part
from .matching import ChoosePairs, Evidence, MatchFolder, PairOptions, pairs_of, verify, write_database
from .pictures import Omitted, Part, Picture, Pictures, WorldFrame
from .sources.finding import WORK
from .world.options import WorldOptions
from .world.placing import place


@dataclass(frozen=True)
class ReconstructOptions:
    """Options of a reconstruction.

    Attributes:
        part: which part is written, from 1 on, the largest first.
        features: the local features, as the setting of the server names them.
    """

    part: int = 1
    features: str = AUTO
    lens: LensOptions = field(default_factory=LensOptions)
    world: WorldOptions = field(default_factory=WorldOptions)
    pairs: PairOptions = field(default_factory=PairOptions)

    def __post_init__(self) -> None:
        if self.part < 1:
            raise ValueError(f"part must be at least 1, is {self.part}")
        known = (AUTO, *FEATURES, *BEST_VARIANTS)
        if self.features not in known:
            raise ValueError(f"features must be one of {', '.join(known)}, is {self.features!r}")


@dataclass(frozen=True)
class Reconstructed:
    """A reconstruction: the part that was chosen, in its world, and what is said of it.

    `parts` are the numbers of photographs of all parts; `omitted` are those without a pose in this one.
    """

    pictures: Pictures
    part: Part
    world: WorldFrame
    cameras: tuple[StartingCamera, ...]
    parts: tuple[int, ...]
    omitted: tuple[Omitted, ...]


def reconstruct(pictures: Pictures, work: Path, options: ReconstructOptions, progress: Progress) -> Reconstructed:
    """Computes poses; ValueError says why there are none."""
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value  # our own sentence says why
    chosen = pictures.chosen
    if len(chosen) < FEWEST:
        notes = "".join(f" ({it})" for it in pictures.notes)
        raise ValueError(
            f"too few photographs, {len(chosen)}: with fewer than {FEWEST} nothing confirms their poses; take ten or "
            f"more, each showing half of what the one before shows{notes}"
        )
    cameras = starting_cameras(chosen, options.lens)
    evidence = gather(chosen, options, work, progress)
    attempt = _mapped(chosen, cameras, (evidence,), work, progress)
    if options.features == AUTO and evidence.kind != ANY_ROLL and attempt.largest < len(chosen):
        attempt = _with_any_roll(attempt, chosen, cameras, options, work, progress)
    parts = attempt.parts
    if not parts:
        raise ValueError(why_no_part(attempt.database, attempt.models))
    if options.part > len(parts):
        raise ValueError(f"there is no part {options.part}: the photographs give {len(parts)}")
    part = parts[options.part - 1]
    left_out = (*pictures.omitted, *omitted(part, parts, chosen, attempt.database))
    placed, world = place(part, options.world, progress)
    return Reconstructed(pictures, placed, world, cameras, tuple(len(it.posed) for it in parts), left_out)


@dataclass(frozen=True, eq=False)
class _Attempt:
    """The parts of a reconstruction, what they are from, and its files."""

    evidence: tuple[Evidence, ...]
    database: Path
    models: Path
    parts: tuple[Part, ...]

    @property
    def largest(self) -> int:
        """Photographs of the largest part."""
        return max((len(it.posed) for it in self.parts), default=0)


def _with_any_roll(
    first: _Attempt,
    pictures: Sequence[Picture],
    cameras: Sequence[StartingCamera],
    options: ReconstructOptions,
    work: Path,
    progress: Progress,
) -> _Attempt:
    """A reconstruction in which those that the largest part lacks match by features of any roll, too.

    Learned features match what is upright; some photographs may be rolled against the others.
    """
    posed = {it.picture.name for it in first.parts[0].posed} if first.parts else set()
    rolled = replace(options, features=ANY_ROLL)
    further = gather(pictures, rolled, work, labelled(progress, ANY_ROLL), posed)
    return _mapped(pictures, cameras, (*first.evidence, further), work, progress)


def gather(
    pictures: Sequence[Picture],
    options: ReconstructOptions,
    work: Path,
    progress: Progress,
    posed: Collection[str] = (),
    choose: ChoosePairs = pairs_of,
) -> Evidence:
    """The photographs' features, and the matches of chosen pairs; but not of two that are both `posed`."""
    kind, extractor = make_first_features(load_settings({"features": options.features}).settings)
    features = FeatureFolder(work / "features", extractor, pictures)
    features.extract(progress)
    names = [it.name for it in pictures]
    pairs = choose(names, features, VladDescriptor.of(extractor), options.pairs, progress)
    pairs = [it for it in pairs if it[0] not in posed or it[1] not in posed]
    files = [features.file(it.name).stem for it in pictures]
    ratio = OPTIONS[kind].query_ratio
    key = _digest(__version__, files, names, pairs, ratio)  # another release may write other files
    matches = MatchFolder(work / f"matches-{key}", features, ratio)
    matches.match(pairs, progress)
    return Evidence(kind, features, matches, key)


def _mapped(
    pictures: Sequence[Picture],
    cameras: Sequence[StartingCamera],
    evidence: tuple[Evidence, ...],
    work: Path,
    progress: Progress,
) -> _Attempt:
    database = database_of(pictures, cameras, evidence, work, progress)
    models = database.with_name(f"models-{database.name}")
    with made_once(models) as made:
        if made is not None:
            known = [number for number, it in enumerate(cameras, 1) if it.is_known]
            map_photographs(database, made, len(pictures), known, available_cores(), progress)
    return _Attempt(evidence, database, models, read_parts(database, models, pictures, evidence))


def database_of(
    pictures: Sequence[Picture],
    cameras: Sequence[StartingCamera],
    evidence: tuple[Evidence, ...],
    work: Path,
    progress: Progress,
) -> Path:
    """The database of photographs, with the geometry of each pair that was matched."""
    database = work / f"database-{_digest([it.key for it in evidence], [repr(it) for it in cameras])}"
    with made_once(database) as made:
        if made is not None:
            write_database(made, cameras, [it.name for it in pictures], evidence)
            progress("verification", 0, 1)
            verify(made, available_cores())
            progress("verification", 1, 1)
    return database


@contextmanager
def made_once(result: Path) -> Iterator[Path | None]:
    """A file or folder to make, which gets its name when the block ends without an error; None if it is there."""
    if result.exists():
        yield None
        return
    partial = result.with_name(f".{result.name}.partial")
    for stale in result.parent.glob(f"{partial.name}*"):  # also the log that SQLite keeps beside a database
        remove(stale)
    yield partial
    partial.replace(result)


def remove(path: Path) -> None:
    """Removes a file or a folder, if it is there."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _digest(*values: object) -> str:
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()[:16]


def prepare(sources: Sequence[Path], out: Path) -> Path:
    """Makes the folder and the one for the steps' results in it; ValueError if it is not ours to write."""
    if not sources:
        raise ValueError("name a source, a video or a folder of photographs, before the folder to write")
    for source in sources:
        if not source.exists():
            raise ValueError(f"{source} is not there")
    work = out / WORK
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is not a folder: the folder to write comes last")
    if out.exists() and not work.is_dir() and any(out.iterdir()):
        raise ValueError(
            f"{out} is not empty, and has no results to go on from: delete it, or name a folder that is not there"
        )
    work.mkdir(parents=True, exist_ok=True)
    return work
