"""A photograph as requests carry it: image bytes and the intrinsics that belong to them."""

from __future__ import annotations

from typing import Any

from mapless.wire import FieldError, camera_from_message, joined
from mapless_server.engine.query import Photo
from mapless_server.images.decode import ImageLimits, image_size


def photo_from_message(message: Any, path: str, limits: ImageLimits) -> Photo:
    """The photograph in a message's `image` and `intrinsics`, its header checked; cheap enough for the event loop.

    Raises:
        FieldError: the intrinsics are missing, out of range, or of another size than the image.
        InvalidArgument: the image is refused by its header.
    """
    if not message.HasField("intrinsics"):
        raise FieldError(joined(path, "intrinsics"), "is required")
    camera = camera_from_message(message.intrinsics, joined(path, "intrinsics"))
    width_px, height_px = image_size(message.image, limits, joined(path, "image"))
    if (camera.width_px, camera.height_px) != (width_px, height_px):
        raise FieldError(
            joined(path, "intrinsics.width_px"),
            f"the intrinsics are for {camera.width_px}x{camera.height_px} pixels, the image has {width_px}x{height_px} "
            "(EXIF orientation is not applied)",
        )
    return Photo(message.image, camera, joined(path, "image"))
