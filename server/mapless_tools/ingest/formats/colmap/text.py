"""COLMAP's text files: a line for a camera; two for an image, of which the second, its observations, may be empty."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ..collecting import read_text
from .cameras import PARAMETERS, ColmapCamera
from .records import ImageRecord


def read_cameras(file: Path) -> Iterator[ColmapCamera]:
    """The cameras of a cameras.txt."""
    for number, line in enumerate(read_text(file).splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        place = f"{file}:{number}"
        words = line.split()
        if len(words) < 4 or words[1] not in PARAMETERS:
            raise ValueError(f"{place}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, found {line.strip()[:80]!r}")
        wanted = PARAMETERS[words[1]]
        if len(words) != 4 + len(wanted):
            raise ValueError(f"{place}: {words[1]} has parameters {' '.join(wanted)}, found {len(words) - 4} numbers")
        try:
            camera_id, width_px, height_px = int(words[0]), int(words[2]), int(words[3])
            parameters = [float(word) for word in words[4:]]
        except ValueError as error:
            raise ValueError(f"{place}: {error}") from error
        yield ColmapCamera(camera_id, words[1], width_px, height_px, parameters)


def read_images(file: Path) -> Iterator[ImageRecord]:
    """The images of an images.txt; their observations are passed over."""
    lines = enumerate(_lines(file), 1)
    for number, line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split(maxsplit=9)  # a name may have spaces
        if len(words) != 10:
            raise ValueError(
                f"{file}:{number}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, found {line.strip()[:80]!r}"
            )
        try:
            record = ImageRecord(int(words[0]), [float(w) for w in words[1:8]], int(words[8]), words[9].rstrip())
        except ValueError as error:
            raise ValueError(f"{file}:{number}: {error}") from error
        yield record
        next(lines, None)


def _lines(file: Path) -> Iterator[str]:
    """The lines, one after the other: observations make files of gigabytes."""
    try:
        with file.open(encoding="utf-8") as stream:
            yield from stream
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{file} is not text: {error}") from error
