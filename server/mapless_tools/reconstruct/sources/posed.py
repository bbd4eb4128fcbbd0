"""Poses that lie with photographs, which a reconstruction does not use: they are named."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from mapless.cameras import FOLDER_FILE
from mapless_tools.dataset import printable
from mapless_tools.ingest.formats import fits, read_dataset

IN_FOLDER = "cameras"


def notes_of_poses(sources: Sequence[Path], photographs: Iterable[Path]) -> list[str]:
    """A note for each `cameras.json` in or beside the sources, as poses of these photographs, or as a foreign file."""
    given = {it.resolve() for it in photographs}
    return [_note(folder, given) for folder in _folders(sources) if fits(folder, IN_FOLDER)]


def _folders(sources: Sequence[Path]) -> Iterator[Path]:
    """The folders of the sources and those above them, each once."""
    folders = [it if it.is_dir() else it.parent for it in map(Path.resolve, sources)]
    yield from dict.fromkeys(near for it in folders for near in (it, it.parent))


def _note(folder: Path, photographs: set[Path]) -> str:
    file = printable(str(folder / FOLDER_FILE))
    try:
        count = sum(it.image_path.resolve() in photographs for it in read_dataset(folder, IN_FOLDER).frames)
    except ValueError as error:
        return f"{file} is not used: {error}"
    if not count:
        return f"{file} is not used: it is of other photographs"
    return (
        f"{file} has poses of {count} of the photographs already, which are not used: `mapless-server import` takes "
        "them as they are"
    )
