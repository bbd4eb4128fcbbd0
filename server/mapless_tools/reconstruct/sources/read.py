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
from .posed import notes_of_poses
from .remembered import Remembered
from .videos import ChosenFrame, read_videos

_LOG = "sources.jsonl"
_STEM_CHARACTERS = 100
"""Characters of a video's name in that of a frame, which is to have room for the frame's index."""


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
    frames, unused, said, count = read_videos(files.videos, files.photographs, folder, options, remembered, progress)
    omitted = [*files.omitted, *omitted, *unused]
    chosen = _named(photographs, frames)
    if not chosen:
        raise ValueError(_nothing(sources, omitted))
    posed = notes_of_poses(sources, [it.path for it in files.photographs])
    return Pictures(tuple(chosen), tuple(omitted), (*posed, *notes, *said), len(files.photographs), count)


def _excluding(options: SourceOptions, folder: Path) -> SourceOptions:
    return SourceOptions(options.frames, options.limits, (*options.excluded, folder))


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _LOG).touch()
    except OSError as error:
        raise ValueError(f"{folder} cannot be written: {error.strerror}") from error


def _named(photographs: Sequence[Looked], frames: Sequence[ChosenFrame]) -> list[Picture]:
    names: set[str] = set()

    def legal(stem: str) -> str:
        name = legal_id(stem, names)
        names.add(name)
        return name

    pictures = [
        Picture(legal(it.file.path.stem), it.path, it.width_px, it.height_px, it.file.path, it.exif)
        for it in photographs
    ]
    for it in frames:
        name = legal(f"{it.file.path.stem[:_STEM_CHARACTERS]}_{it.time.frame:06d}")
        pictures.append(Picture(name, it.path, it.width_px, it.height_px, it.file.path, time=it.time))
    return pictures


def _nothing(sources: Sequence[Path], omitted: Sequence[Omitted]) -> str:
    where = ", ".join(printable(str(it)) for it in sources[:3]) + (", ..." if len(sources) > 3 else "")
    if not omitted:
        return f"{where}: there is no photograph (JPEG, PNG, WebP, HEIC) and no video"
    reasons = "; ".join(f"{it.name}: {it.reason}" for it in omitted[:3])
    return f"{where}: no photograph and no video can be used: {reasons}" + ("; ..." if len(omitted) > 3 else "")
