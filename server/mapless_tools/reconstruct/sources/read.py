"""Reads videos and photographs without poses; begin with `read_sources`."""

from collections.abc import Sequence
from pathlib import Path

from mapless_tools.dataset import legal_id, printable
from mapless_tools.progress import Progress

from ..pictures import Omitted, Picture, Pictures
from .finding import find_files
from .looking import Looked
from .options import SourceOptions
from .photographs import read_photographs
from .remembered import Remembered

_LOG = "sources.jsonl"


def read_sources(sources: Sequence[Path], folder: Path, options: SourceOptions, progress: Progress) -> Pictures:
    """Reads videos, photographs, and folders of both; those below them, too, but for hidden ones.

    Photographs in JPEG, PNG and WebP are used where they are, as they are. In `folder`, which is made if it is missing,
    JPEG files of quality 95 are written, upright, of photographs in HEIC, HEIF and AVIF and of the frames of videos; it
    has also what an interrupted run has computed, which the next one continues. A name is a photograph's stem, or a
    video's with the index of the frame; photographs come first, in the order in which they were taken.

    ValueError if a source is missing, the folder cannot be written, or nothing can be used.
    """
    files = find_files(sources, _excluding(options, folder))
    _make_folder(folder)
    remembered = Remembered(folder / _LOG)
    photographs, omitted, notes = read_photographs(files.photographs, folder, options, remembered, progress)
    omitted = [*files.omitted, *omitted]
    chosen = _named(photographs)
    if not chosen:
        raise ValueError(_nothing(sources, omitted))
    return Pictures(tuple(chosen), tuple(omitted), tuple(notes))


def _excluding(options: SourceOptions, folder: Path) -> SourceOptions:
    return SourceOptions(options.frames, options.limits, (*options.excluded, folder))


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _LOG).touch()
    except OSError as error:
        raise ValueError(f"{folder} cannot be written: {error.strerror}") from error


def _named(photographs: Sequence[Looked]) -> list[Picture]:
    names: set[str] = set()
    pictures = []
    for it in photographs:
        name = legal_id(it.file.path.stem, names)
        names.add(name)
        pictures.append(Picture(name, it.path, it.width_px, it.height_px, it.file.path, it.exif))
    return pictures


def _nothing(sources: Sequence[Path], omitted: Sequence[Omitted]) -> str:
    where = ", ".join(printable(str(it)) for it in sources[:3]) + (", ..." if len(sources) > 3 else "")
    if not omitted:
        return f"{where}: there is no photograph (JPEG, PNG, WebP, HEIC) and no video"
    reasons = "; ".join(f"{it.name}: {it.reason}" for it in omitted[:3])
    return f"{where}: no photograph and no video can be used: {reasons}" + ("; ..." if len(omitted) > 3 else "")
