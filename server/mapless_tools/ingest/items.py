"""Frames on their way to a server: grouped into messages, read, and known by what identifies them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from mapless import NewReference
from mapless_server.errors import InvalidArgument as BadImage
from mapless_server.images.decode import image_size
from mapless_tools.dataset import Frame

from .existing import Stored
from .formats.collecting import ANY_SIZE

BATCH_COUNT = 8
"""References a message: progress shows, and little is sent again when one is refused."""

BATCH_BYTES = 6 * 2**20
"""Of images a message; large ones take the server long to receive, which its other callers feel."""


@dataclass(frozen=True, eq=False)
class Item:
    """A frame that is ready to be sent."""

    frame: Frame
    image: bytes
    stored: Stored

    def reference(self) -> NewReference:
        """What the client sends."""
        return NewReference(self.frame.name, self.image, self.frame.camera, self.frame.world_from_camera)


def read_item(frame: Frame) -> Item:
    """A frame with its image's bytes; ValueError if they cannot be what its camera took."""
    file, camera = frame.image_path, frame.camera
    try:
        image = file.read_bytes()
        width, height = image_size(image, ANY_SIZE)
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
    except BadImage as error:
        raise ValueError(f"{file}: {error}") from error
    if (width, height) != (camera.width_px, camera.height_px):
        raise ValueError(f"{file} has {width}x{height} pixels, its camera {camera.width_px}x{camera.height_px}")
    stored = Stored(frame.name, hashlib.sha256(image).hexdigest(), camera, frame.world_from_camera)
    return Item(frame, image, stored)


def batches_of(frames: Sequence[Frame]) -> Iterator[Sequence[Frame]]:
    """Frames in their order, as many together as one message shall have; their files are not read."""
    batch: list[Frame] = []
    batch_bytes = 0
    for frame in frames:
        try:
            size_bytes = frame.image_path.stat().st_size
        except OSError:  # whoever reads it says so
            size_bytes = 0
        if batch and (len(batch) == BATCH_COUNT or batch_bytes + size_bytes > BATCH_BYTES):
            yield batch
            batch, batch_bytes = [], 0
        batch.append(frame)
        batch_bytes += size_bytes
    if batch:
        yield batch
