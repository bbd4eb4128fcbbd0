"""Masks: in files a PNG for each photograph, in which 0 means ignore, under COLMAP's names; and in requests."""

from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

from google.protobuf.message import Message

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


class IgnoredMask(UserWarning):
    """A server that is older than masks has ignored that of a call: it has used, or stored, the whole photograph."""

    def __init__(self, address: str) -> None:
        super().__init__(
            f"the server {address} has ignored the mask, and used the whole photograph: it says no version, so it is "
            "older than 0.3.0, from which on servers know masks"
        )


def carries_mask(request: Message) -> bool:
    """Whether a request has the mask of a photograph."""
    fields: Any = request.DESCRIPTOR
    message: Any = request
    if "mask" in fields.fields_by_name and message.HasField("mask"):
        return True
    parts = [part for name in _WITH_PHOTOGRAPHS if name in fields.fields_by_name for part in getattr(message, name)]
    if "reference" in fields.fields_by_name and isinstance(message.reference, Message):
        parts.append(message.reference)
    return any(map(carries_mask, parts))


_WITH_PHOTOGRAPHS = ("images", "frames", "requests")
"""Fields with the parts of a request that have a photograph each."""
