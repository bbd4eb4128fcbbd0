"""Opens videos by FFmpeg's decoders, and turns their frames into upright pictures of square pixels and 8 bits.

A video is read as a stream of bytes: FFmpeg opens no other file, and no address, that a playlist may name.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer
    from av.video.stream import VideoStream

_BUFFER_BYTES = 2**20
_THREADS = 4
"""Each holds a frame or more: 8K in 10 bits has 100 MB a frame."""
_PIXEL_ASPECTS = (0.2, 5.0)
_HDR = {16: "PQ", 18: "HLG"}
"""By the number of the transfer function in ITU-T H.273."""


@dataclass
class Video:
    """A video that is open, and its stream of pictures; `matrix` is its display matrix once a picture was made."""

    container: InputContainer
    stream: VideoStream
    matrix: NDArray[np.float64] | None = None

    @property
    def pixel_aspect(self) -> float:
        """Width of a pixel by its height; 1 where the video says nothing plausible."""
        aspect: Fraction | None = self.stream.sample_aspect_ratio
        value = float(aspect) if aspect else 1.0
        return value if _PIXEL_ASPECTS[0] <= value <= _PIXEL_ASPECTS[1] else 1.0

    @property
    def duration_s(self) -> float:
        """The duration that the header has; 0 if it has none."""
        if self.stream.duration and self.stream.time_base:
            return float(self.stream.duration * self.stream.time_base)
        return (self.container.duration or 0) / 1e6

    def upright(self, frame: VideoFrame) -> NDArray[np.uint8]:
        """A frame as `upright_picture` has it."""
        if self.matrix is None:  # once: a frame whose side data are read is part of a circle, and stays in memory
            self.matrix = display_matrix(frame)
        return upright_picture(frame, self.pixel_aspect, self.matrix)

    def frames(self, errors: list[str]) -> Iterator[VideoFrame]:
        """Yields frames from where the video stands; what is damaged is skipped, and named in `errors`."""
        from av.error import FFmpegError

        packets = self.container.demux(self.stream)
        while True:
            try:
                packet = next(packets, None)
                decoded = [] if packet is None else self.stream.decode(packet)
            except (FFmpegError, OSError) as error:
                errors.append(error.strerror or str(error))
                if len(errors) > _MAX_ERRORS:
                    return
                continue
            if packet is None:
                return
            yield from decoded


_MAX_ERRORS = 100_000


@contextmanager
def opened_video(file: Path, *, keys_only: bool = False) -> Iterator[Video]:
    """Opens the first video stream of a file; ValueError, a clause, if there is none."""
    import av
    from av.error import FFmpegError

    with file.open("rb") as data:
        try:
            container = av.open(data, "r", metadata_errors="replace", buffer_size=_BUFFER_BYTES)
        except (FFmpegError, OSError, ValueError) as error:
            raise ValueError(f"it cannot be read as a video: {_reason(file, error)}") from error
        with container:
            streams = [it for it in container.streams.video if not it.disposition & it.disposition.attached_pic]
            if not streams:
                raise ValueError("it has no video, only sound or data")
            stream = streams[0]
            if not stream.codec_context:
                raise ValueError("there is no decoder for its video")
            stream.thread_type = "AUTO"
            stream.codec_context.thread_count = _THREADS
            if keys_only:
                stream.codec_context.skip_frame = "NONKEY"
            yield Video(container, stream)


def _reason(file: Path, error: Exception) -> str:
    """Why a file cannot be opened, for people."""
    with file.open("rb") as data:
        head = data.read(8)
    if not head:
        return "it is empty"
    if head[4:] == b"ftyp":
        return "its index is missing, as in recordings that were cut off before their end"
    return str(getattr(error, "strerror", None) or error)


def small_grey(frame: VideoFrame, size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """A frame in grey (H, W) of this width and height, as it is stored."""
    small = frame.reformat(width=size_px[0], height=size_px[1], format="gray", interpolation="AREA")
    return np.asarray(small.to_ndarray(), np.uint8)


def upright_picture(frame: VideoFrame, pixel_aspect: float, matrix: NDArray[np.float64]) -> NDArray[np.uint8]:
    """A frame (H, W, 3), RGB, as a viewer shows it.

    Of interlaced frames every second row is used: the others were taken at another time. Pixels that are not square are
    resampled in the direction in which the picture grows.
    """
    picture: NDArray[Any] = frame.to_ndarray(format="rgb24")
    height, width = picture.shape[:2]
    if frame.interlaced_frame:
        picture = picture[::2]
    if pixel_aspect > 1:
        width = round(width * pixel_aspect)
    else:
        height = round(height / pixel_aspect)
    if picture.shape[:2] != (height, width):
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(_turned(picture, matrix), np.uint8)


def display_matrix(frame: VideoFrame) -> NDArray[np.float64]:
    """The matrix (2, 2) that takes directions (x, y) of the stored frame to those of the shown one; no unit."""
    side_data: Any = frame.side_data  # is annotated with one of its kinds
    for it in side_data:
        if it.type.name == "DISPLAYMATRIX":
            a, b, _, c, d = np.frombuffer(bytes(it), np.int32)[:5] / 2**16
            return np.array([[a, c], [b, d]])
    return np.eye(2)


def is_oblique(matrix: NDArray[np.float64]) -> bool:
    """Whether a display matrix turns by another angle than a multiple of 90 degrees."""
    sizes = np.sort(np.abs(matrix), axis=1)
    return bool((sizes[:, 0] > 0.01 * sizes[:, 1]).any())


def hdr_name(frame: VideoFrame) -> str:
    """The name of the frame's curve of brightness where it is that of HDR; else empty."""
    return _HDR.get(int(frame.color_trc), "")


def _turned(picture: NDArray[Any], matrix: NDArray[np.float64]) -> NDArray[Any]:
    (a, c), (b, d) = matrix
    if abs(c) > abs(a):
        picture, a, d = picture.transpose(1, 0, 2), c, b
    return picture[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]
