"""Masks in files: a PNG for each photograph, in which 0 means ignore, under COLMAP's names."""

from collections.abc import Iterable
from pathlib import Path, PurePosixPath

FOLDER = "masks"
"""Where exports put them."""


def mask_name(image: str) -> str:
    """Path of an image's mask in the folder of masks, from the image's path in the folder of images: COLMAP's rule."""
    return f"{image}.png"


def find_mask(masks: Path, names: Iterable[str]) -> Path | None:
    """The mask of an image that may have these paths, the likeliest first; None if there is none.

    Under COLMAP's name, "a/1.jpg.png", or the image's with the ending .png, "a/1.png". A file instead of a folder is
    the mask of every image, as of a camera that sees its own vehicle.

    ValueError if there is neither a file nor a folder.
    """
    if masks.is_file():
        return masks
    if not masks.is_dir():
        raise ValueError(f"there is neither a mask nor a folder of masks {masks}")
    for name in names:
        for candidate in (mask_name(name), str(PurePosixPath(name).with_suffix(".png"))):
            file = masks / candidate
            if file.is_file():
                return file
    return None
