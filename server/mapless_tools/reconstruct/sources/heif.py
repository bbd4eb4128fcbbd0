"""Converts HEIC, HEIF and AVIF files to JPEG, upright.

Such a file says twice how its raster is turned: by properties of the container, which a decoder applies or not, and by
EXIF, which iPhones write, too, and which does not count (ISO 23008-12, annex A). pillow-heif applies the container's
and resets the EXIF's; Pillow's decoder of AVIF applies none and sets the EXIF's by the container's. In both the EXIF
that is with the pixels in memory is right, and the file's is not.
"""

from pathlib import Path

from PIL import Image, ImageOps

from mapless_server.images import ImageLimits

from .jpeg import write_jpeg


def jpeg_of_heif(file: Path, target: Path, limits: ImageLimits) -> None:
    """Writes a HEIC, HEIF or AVIF file as JPEG of quality 95 in the upright raster; its EXIF is kept without a turn.

    ValueError if it cannot be decoded or is too large.
    """
    from pillow_heif import register_heif_opener

    register_heif_opener(thumbnails=False)
    try:
        with Image.open(file, formats=("HEIF", "AVIF")) as opened:
            _check_size(opened.size, limits)
            icc_profile = opened.info.get("icc_profile")
            upright = ImageOps.exif_transpose(opened)
            exif = upright.info.get("exif", b"")
            picture = upright.convert("RGB")
    except (OSError, SyntaxError, RuntimeError, EOFError, Image.DecompressionBombError) as error:
        raise ValueError(f"it cannot be decoded: {error}") from error
    write_jpeg(target, picture, exif=exif, icc_profile=icc_profile)


def _check_size(size_px: tuple[int, int], limits: ImageLimits) -> None:
    if size_px[0] * size_px[1] > limits.max_pixels:
        raise ValueError(f"it has {size_px[0]}x{size_px[1]} pixels; at most {limits.max_pixels} are accepted")
