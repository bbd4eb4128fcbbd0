"""The camera of each image by sensor_msgs/CameraInfo, which changes with the focus; whether images are rectified."""

import re
import threading
from bisect import bisect_left
from typing import Any

import numpy as np

from .cameras import RosCamera, camera_from_info
from .poses import stamp_ns_of

_WORDS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
_RECTIFIED = frozenset({"rect", "rectified", "undist", "undistort", "undistorted"})
_RAW = frozenset({"raw", "distorted", "unrect", "unrectified"})
_NOT = frozenset({"no", "non", "not", "un"})
_TRANSPORT = "/compressed"


class CameraInfos:
    """The messages of a topic of CameraInfo by time; the camera of an image is that of the nearest message.

    May be used by several threads.
    """

    def __init__(self, rectified: bool = False, kept: int = 0) -> None:
        """Images are rectified or not; of the messages so many are kept, the latest, or all with 0."""
        self.rectified = rectified
        self._kept = kept
        self._lock = threading.Lock()
        self._stamps_ns: list[int] = []
        self._messages: list[Any] = []
        self._made: tuple[Any, RosCamera] | None = None

    def add(self, message: Any, time_ns: int = 0) -> None:
        """Adds a message, of its stamp, or of this time if it has none.

        ValueError, as of `camera_from_info`, if it is of no camera; nothing is added then.
        """
        stamp_ns = stamp_ns_of(message.header.stamp) or time_ns
        with self._lock:
            if self._messages and _state(self._messages[-1]) == _state(message):
                message = self._messages[-1]  # most cameras never change: one message is kept for all
            else:
                self._made = message, camera_from_info(message, self.rectified)
            place = bisect_left(self._stamps_ns, stamp_ns)
            self._stamps_ns.insert(place, stamp_ns)
            self._messages.insert(place, message)
            if self._kept:
                del self._stamps_ns[: -self._kept], self._messages[: -self._kept]

    def at(self, stamp_ns: int) -> RosCamera | None:
        """The camera of an image of this time; None without a message."""
        with self._lock:
            if not self._messages:
                return None
            after = min(bisect_left(self._stamps_ns, stamp_ns), len(self._stamps_ns) - 1)
            nearest = min((after, max(after - 1, 0)), key=lambda i: abs(self._stamps_ns[i] - stamp_ns))
            message = self._messages[nearest]
            if self._made is None or self._made[0] is not message:  # maps of a lens are megabytes: one camera is kept
                self._made = message, camera_from_info(message, self.rectified)
            return self._made[1]


def says_rectified(topic: str) -> bool:
    """Whether a topic's name says that its images are rectified: `image_rect_color`, `rect/image`, `undistorted`.

    The last part of the name counts most: `/rectified/image_raw` is raw.
    """
    for part in reversed(topic.removesuffix(_TRANSPORT).split("/")):
        words = [word.lower() for word in _WORDS.findall(part)]
        for before, word in zip(["", *words], words, strict=False):
            if word in _RECTIFIED:
                return before not in _NOT
        if _RAW.intersection(words):
            return False
    return False


def rectified_differs(message: Any) -> bool:
    """Whether the camera of rectified images is another than that of raw ones, by their CameraInfo."""
    k, p = np.array(message.k, float).reshape(3, 3), np.array(message.p, float).reshape(3, 4)[:, :3]
    return any(message.d) or (bool(p.any()) and not np.allclose(k, p))


def _state(message: Any) -> tuple[Any, ...]:
    region = message.roi
    numbers = (np.array(it, float).tobytes() for it in (message.k, message.d, message.p))
    sizes = (message.width, message.height, message.binning_x, message.binning_y, region.width, region.height)
    return (*sizes, message.distortion_model, *numbers)
