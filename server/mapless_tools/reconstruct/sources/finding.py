"""Finds the photographs and videos that sources are or contain, and names the images that are not read."""

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from mapless_tools.dataset import printable

from ..pictures import Omitted
from .options import SourceOptions

PHOTOGRAPHS = (".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".png", ".webp", ".heic", ".heif", ".hif", ".avif")
VIDEOS = (
    *(".mp4", ".m4v", ".mov", ".qt", ".mkv", ".webm", ".avi", ".3gp", ".3g2", ".mts", ".m2ts", ".mpg", ".mpeg"),
    *(".ogv", ".wmv", ".asf", ".flv", ".mxf", ".lrv", ".vob"),
)
UNREAD = (
    *(".tif", ".tiff", ".gif", ".bmp", ".jxl", ".jp2", ".exr", ".psd", ".pgm", ".ppm", ".insp"),
    *(".dng", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".srw", ".pef", ".3fr"),
)
"""Endings of images that are not read; RAW among them, whose pixels depend on the program that develops them."""
WORK = ".work"
"""Name of the folder, in that of the output, which has the results of the steps."""
_HIDDEN = ("__MACOSX", "@eaDir")
"""Beside names that begin with a dot: folders of small copies that archives and network drives make."""
_HEAD = 32
_DIGITS = re.compile(r"(\d+)")


@dataclass(frozen=True)
class SourceFile:
    """A file with the name that messages have for it: its path from the source that it was found in."""

    path: Path
    name: str


@dataclass(frozen=True)
class SourceFiles:
    """Photographs and videos, in the natural order of names within each source, and images that are not read."""

    photographs: tuple[SourceFile, ...]
    videos: tuple[SourceFile, ...]
    omitted: tuple[Omitted, ...]


def find_files(sources: Sequence[Path], options: SourceOptions) -> SourceFiles:
    """Lists the files of the sources, those of folders below them, too; each file once, links are followed.

    ValueError if there is no source, or one is missing or cannot be read.
    """
    if not sources:
        raise ValueError("there is no source: give a video, a photograph, or a folder of photographs")
    found: dict[str, list[SourceFile]] = {"photograph": [], "video": [], "unread": []}
    seen: set[Path] = set()
    for source in sources:
        for file in _files_of(source, options):
            resolved = file.path.resolve()
            kind = _kind(file.path, is_given=file.path == source)
            if kind and resolved not in seen:
                seen.add(resolved)
                found[kind].append(file)
    unread = tuple(
        Omitted(it.name, f"{it.path.suffix} is not read: export it as JPEG or PNG") for it in found["unread"]
    )
    return SourceFiles(tuple(found["photograph"]), tuple(found["video"]), unread)


def natural(name: str) -> list[tuple[int, str]]:
    """A key by which names are sorted as people count: image2 before image10."""
    return [(int(it), "") if it.isdecimal() else (-1, it) for it in _DIGITS.split(name.casefold())]


def is_heif(head: bytes) -> bool:
    """Whether a file that begins with these bytes is HEIC, HEIF or AVIF, whatever its name."""
    return head[4:8] == b"ftyp" and head[8:12] in (
        *(b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1", b"avif", b"avis"),
    )


def _files_of(source: Path, options: SourceOptions) -> Iterable[SourceFile]:
    try:
        if _is_special(source) and not source.is_dir():
            raise ValueError(f"{printable(str(source))} is neither a file nor a folder")
        if not source.is_dir():
            with source.open("rb"):
                return [SourceFile(source, printable(source.name))]
    except OSError as error:
        raise ValueError(f"{printable(str(source))} cannot be read: {error.strerror}") from error
    excluded = {it.resolve() for it in options.excluded}
    files = [SourceFile(it, printable(str(it.relative_to(source)))) for it in _walk(source, excluded)]
    return sorted(files, key=lambda it: natural(it.name))


def _walk(source: Path, excluded: set[Path]) -> Iterator[Path]:
    """Yields the files below a folder, but those of hidden and excluded ones, and of results of reconstructions.

    A link to a folder above ends there.
    """

    def fail(error: OSError) -> None:
        raise ValueError(f"{printable(str(error.filename))} cannot be read: {error.strerror}") from error

    entered = {source.resolve()}
    for folder, inner, files in os.walk(source, followlinks=True, onerror=fail):
        here = Path(folder)
        kept = []
        for name in inner:
            resolved = (here / name).resolve()
            left_out = _is_hidden(name) or is_result(here / name) or resolved in excluded
            if not left_out and resolved not in entered:
                entered.add(resolved)
                kept.append(name)
        inner[:] = kept
        yield from (here / name for name in files if not _is_hidden(name) and not _is_special(here / name))


def _is_special(file: Path) -> bool:
    """Whether a file is a pipe, a socket or a device: reading it may never end."""
    return file.exists() and not file.is_file()


def is_result(folder: Path) -> bool:
    """Whether a folder is the output of a reconstruction, whose photographs are those of its sources."""
    return (folder / WORK).is_dir()


def _is_hidden(name: str) -> bool:
    return name.startswith(".") or name in _HIDDEN


def _kind(file: Path, is_given: bool) -> str:
    """The kind of a file by its ending; one of another ending is read if it was given itself, as its content says."""
    ending = file.suffix.lower()
    for kind, endings in (("photograph", PHOTOGRAPHS), ("video", VIDEOS), ("unread", UNREAD)):
        if ending in endings:
            return kind
    return _kind_by_content(file) if is_given else ""


def _kind_by_content(file: Path) -> str:
    with file.open("rb") as stream:
        head = stream.read(_HEAD)
    is_photograph = head.startswith((b"\xff\xd8\xff", b"\x89PNG")) or head[8:12] == b"WEBP" or is_heif(head)
    return "photograph" if is_photograph else "video"
