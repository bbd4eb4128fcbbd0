"""Writes pictures that are decoded, of a video or a HEIC file, as JPEG files."""

import io
from pathlib import Path

from PIL import Image

from mapless_tools.output_files import whole_file

QUALITY = 95


def write_jpeg(file: Path, picture: Image.Image, *, exif: bytes = b"", icc_profile: bytes | None = None) -> None:
    """Writes a picture as JPEG of quality 95: the whole file or none."""
    # Pillow overlooks that a full disk takes only a part of what it writes.
    encoded = io.BytesIO()
    picture.save(encoded, "JPEG", quality=QUALITY, exif=exif, icc_profile=icc_profile)
    with whole_file(file) as partial:
        partial.write_bytes(encoded.getvalue())
