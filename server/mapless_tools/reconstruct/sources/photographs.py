"""Reads the photographs of the sources, in the order in which they were taken; names duplicates and blurred ones."""

import re
from collections.abc import Sequence
from pathlib import Path

from mapless_tools.progress import Progress, tracked

from ..pictures import Omitted
from .finding import SourceFile, natural
from .judging import mostly_blurred, without_blurred, without_duplicates
from .looking import Looked, look
from .options import SourceOptions
from .remembered import Remembered

_TIME = re.compile(r"[12]\d{3}:\d\d:\d\d \d\d:\d\d:\d\d")
_REASON_CHARACTERS = 200


def read_photographs(
    files: Sequence[SourceFile], folder: Path, options: SourceOptions, remembered: Remembered, progress: Progress
) -> tuple[list[Looked], list[Omitted], list[str]]:
    """The photographs that take part, those that do not, and notes."""
    if not files:
        return [], [], []

    def looked_at(file: SourceFile) -> Looked | Omitted:
        try:
            return look(file, folder, options.limits, remembered)
        except ValueError as error:
            return Omitted(file.name, str(error)[:_REASON_CHARACTERS])

    results = [looked_at(it) for it in tracked("reading photographs", files, len(files), progress)]
    kept, duplicates = without_duplicates([it for it in results if isinstance(it, Looked)])
    kept, blurred = without_blurred(kept)
    unusable = [it for it in results if isinstance(it, Omitted)]
    return in_order(kept), [*unusable, *duplicates, *blurred], _notes(kept)


def in_order(photographs: Sequence[Looked]) -> list[Looked]:
    """Sorts photographs by the time in their EXIF, then by name.

    One without a time has that of the photograph before it by name: a series of which some were edited stays together.
    """
    time = ""
    keyed = []
    for it in sorted(photographs, key=lambda it: natural(it.file.name)):
        time = it.exif.taken_at if _TIME.fullmatch(it.exif.taken_at) else time
        keyed.append((time, it))
    return [it for _, it in sorted(keyed, key=lambda pair: pair[0])]


def _notes(kept: Sequence[Looked]) -> list[str]:
    notes = []
    converted = sum(it.is_converted for it in kept)
    if converted:
        notes.append(f"{converted} photographs of HEIC or AVIF were converted to upright JPEG of quality 95")
    if mostly_blurred(kept):
        notes.append("most photographs are blurred: positions will be less accurate than with sharp ones")
    return notes
