"""Lists of references for each query, as hloc writes them: lines "query reference", most similar first."""

from __future__ import annotations

from collections.abc import Mapping, Set
from pathlib import Path

from mapless_tools.dataset import Dataset, Frame

from .plan import UsageError

Pairs = Mapping[str, tuple[Frame, ...]]
"""By a query frame's name, its references, most similar first."""


def pairs_file(path: Path, scene: str, scene_count: int) -> Path:
    """The file of a scene: the one given, or in a folder the one of the scene's name.

    Raises:
        UsageError: there is no such file, or one file is given for several scenes.
    """
    if path.is_dir():
        path = path / f"{scene.replace('/', '_')}.txt"
    elif scene_count > 1:
        raise UsageError(f"{path} is one file for {scene_count} scenes: give a folder with SCENE.txt for each")
    if not path.is_file():
        raise UsageError(f"there is no file {path} with the pairs of {scene}")
    return path


def read_pairs(file: Path, dataset: Dataset, folder: Path) -> Pairs:
    """The pairs of a file. An image is named by its path from the scene's folder, or by its frame's name.

    Raises:
        UsageError: the file cannot be read, a line is no pair, an image is unknown, a query is no test frame, or a
            reference is no training frame.
    """
    frames = _by_name(dataset, folder)
    pairs: dict[str, list[Frame]] = {}
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{file} cannot be read: {getattr(error, 'strerror', None) or error}") from error
    for number, line in enumerate(lines, start=1):
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


def chosen(pairs: Pairs, query: Frame, references: Set[str], k: int) -> tuple[Frame, ...]:
    """The first k of a query's pairs that are among the references of the setting, which are named.

    Raises:
        UsageError: there are none.
    """
    its = tuple(frame for frame in pairs.get(query.name, ()) if frame.name in references)[:k]
    if not its:
        raise UsageError(f"the pairs file names no reference of the query {query.name} among those of the setting")
    return its


def _by_name(dataset: Dataset, folder: Path) -> dict[str, Frame]:
    root = folder.resolve()
    frames = {frame.name: frame for frame in dataset.frames}
    for frame in dataset.frames:
        path = frame.image_path.resolve()
        if path.is_relative_to(root):
            frames[path.relative_to(root).as_posix()] = frame
    return frames
