"""Looks through a video once, at a small size: what its frames show, and how sharp they are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless_tools.progress import Progress

from .content import Content
from .video import Video, display_matrix, hdr_name, is_oblique, opened_video, small_grey

if TYPE_CHECKING:
    from av import VideoFrame

_SHARPNESS_PX = 640
_TRACKS_PX = 320
_TRACKS_PER_S = 15.0
"""Frames that are compared; a hand turns a camera by 5 degrees meanwhile, a tenth of what it shows."""
_MAX_PIXELS = 5e10
"""Pixels of all frames of a video together: 13 minutes of 1080p at 30 Hz, which take three minutes. Of longer ones, the
key frames are looked at."""
_KEYS_PER_FRAME = 2
_BLANK_DEVIATION = 3.0
"""Grey levels: a frame of less contrast, such as of a covered lens, is not chosen."""
_REPORTED = 100
_DAMAGED_SHARE = 0.98
_ENDS_SHARE, _ENDS_S = 0.9, 1.0


@dataclass(frozen=True)
class Packets:
    """The frames that a video holds by its packets: presentation times in the stream's unit, sorted, and key frames'.

    Empty where the container has no times; then frames are counted.
    """

    times: tuple[int, ...]
    key_times: tuple[int, ...]
    count: int


@dataclass(frozen=True)
class Watched:
    """The frames of a video that were looked at; lists of equal length, in the types of JSON.

    `frame` is the index among all decoded frames, `pts` the time in the stream's unit, -1 where there is none, `time_s`
    in seconds. `content` and `sharpness` are as `choose_frames` takes them.
    """

    frame: list[int]
    pts: list[int]
    time_s: list[float]
    content: list[float]
    sharpness: list[float]
    usable: list[bool]
    notes: list[str]
    keys_only: bool
    count: int

    def extent(self) -> float:
        """By how much the content of usable frames grows."""
        content = [it for it, is_usable in zip(self.content, self.usable, strict=True) if is_usable]
        return content[-1] - content[0] if content else 0.0

    def to_json(self) -> dict[str, object]:
        """The fields."""
        return asdict(self)


def watch(file: Path, frames: int, label: str, progress: Progress) -> Watched:
    """Looks through a video of which at most so many frames will be chosen; ValueError if nothing can be decoded."""
    packets = packets_of(file)
    errors: list[str] = []
    with opened_video(file) as video:
        pixels = float(video.stream.width * video.stream.height) * packets.count
        declared, duration_s = video.stream.frames, video.duration_s
    keys_only = pixels > _MAX_PIXELS and len(packets.key_times) >= _KEYS_PER_FRAME * frames
    with opened_video(file, keys_only=keys_only) as video:
        total = len(packets.key_times) if keys_only else packets.count
        watching = _Watching(video, packets, keys_only)
        for done, frame in enumerate(_reported(video.frames(errors), total, label, progress)):
            watching.add(done, frame)
    if not watching.frame:
        reason = Counter(errors).most_common(1)[0][0] if errors else "there is no frame in it"
        raise ValueError(f"no frame of its video can be decoded: {reason}")
    expected = total if keys_only else max(total, declared)
    damage = _damage(len(watching.frame), expected, errors) or _missing_end(watching.seen_s(), duration_s)
    return watching.result(damage, packets.count)


def packets_of(file: Path) -> Packets:
    """Reads the times of a video's frames without decoding them."""
    from av.error import FFmpegError

    times, keys, count = [], [], 0
    with opened_video(file) as video:
        try:
            for packet in video.container.demux(video.stream):
                if not packet.size or packet.is_discard:
                    continue
                count += 1
                if packet.pts is not None:
                    times.append(packet.pts)
                    if packet.is_keyframe:
                        keys.append(packet.pts)
        except (FFmpegError, OSError):
            pass  # the file is cut off here, which decoding reports
    if len(set(times)) < count:
        return Packets((), (), count)
    return Packets(tuple(sorted(times)), tuple(sorted(keys)), count)


class _Watching:
    """The measures of the frames of one video."""

    def __init__(self, video: Video, packets: Packets, keys_only: bool) -> None:
        self._packets, self._keys_only = packets, keys_only
        self._time_base = float(video.stream.time_base or 0)
        rate = video.stream.average_rate or video.stream.guessed_rate
        self._frame_s = 1 / float(rate) if rate else 1 / 30
        self._pixel_aspect = video.pixel_aspect
        self._content = Content()
        self._compared: list[int] = []
        self._contents: list[float] = []
        self._size_px = (0, 0)
        self.frame: list[int] = []
        self._pts: list[int] = []
        self._time_s: list[float] = []
        self._sharpness: list[float] = []
        self._usable: list[bool] = []
        self._facts: dict[str, None] = {}

    def add(self, done: int, frame: VideoFrame) -> None:
        """Measures the next frame."""
        if not self.frame:
            self._size_px = _within(frame.width, frame.height, _SHARPNESS_PX)
            self._note_facts(frame)
        grey = small_grey(frame, self._size_px)
        deviation = float(cv2.meanStdDev(grey)[1][0, 0])
        pts = frame.pts if frame.pts is not None and self._packets.times else -1
        index = int(np.searchsorted(self._packets.times, pts)) if self._keys_only else done
        time_s = pts * self._time_base if pts != -1 else index * self._frame_s
        self.frame.append(index)
        self._pts.append(pts)
        self._sharpness.append(_sharpness(grey))
        self._usable.append(deviation >= _BLANK_DEVIATION and not frame.is_corrupt)
        last = self._time_s[self._compared[-1]] if self._compared else -np.inf
        self._time_s.append(time_s)
        if not last < time_s < last + 0.9 / _TRACKS_PER_S:
            self._compared.append(len(self.frame) - 1)
            small = cv2.resize(grey, _within(*self._size_px, _TRACKS_PX), interpolation=cv2.INTER_AREA)
            self._contents.append(self._content.add(np.asarray(small, np.uint8), self._sharpness[-1]))

    def seen_s(self) -> float:
        """The time from the first frame to the last."""
        return max(self._time_s) - min(self._time_s)

    def result(self, damage: list[str], count: int) -> Watched:
        """The measures; the content between frames that were compared is interpolated."""
        positions = np.arange(len(self.frame))
        content = np.maximum.accumulate(np.interp(positions, self._compared, self._contents))
        notes = [*self._facts, *damage]
        cuts = [self._time_s[self._compared[it.position]] for it in self._content.cuts]
        if cuts and not self._keys_only:
            shown = ", ".join(f"{it:.1f} s" for it in cuts[:5]) + (", ..." if len(cuts) > 5 else "")
            notes.append(f"it is cut, at {shown}: parts of different places cannot be put together")
        blank = len(self._usable) - sum(self._usable)
        if blank:
            notes.append(f"{blank} frames show nothing or are damaged")
        return Watched(
            self.frame,
            self._pts,
            self._time_s,
            content.tolist(),
            self._sharpness,
            self._usable,
            notes,
            self._keys_only,
            count,
        )

    def _note_facts(self, frame: VideoFrame) -> None:
        if self._keys_only:
            self._facts["it is long: only its key frames were looked at"] = None
        if frame.interlaced_frame:
            self._facts["it is interlaced: every second row is used"] = None
        if self._pixel_aspect != 1:
            self._facts[f"its pixels are not square ({self._pixel_aspect:.4g} to 1): frames are resampled"] = None
        if hdr_name(frame):
            self._facts[f"it is HDR ({hdr_name(frame)}): frames have its curve of brightness, in 8 bits"] = None
        if is_oblique(display_matrix(frame)):
            self._facts["it asks to be turned by an angle that is no multiple of 90 degrees: the nearest is used"] = (
                None
            )


def _damage(decoded: int, expected: int, errors: list[str]) -> list[str]:
    """A note of frames that could not be decoded."""
    if not errors and decoded >= _DAMAGED_SHARE * expected:
        return []
    reason = f" ({Counter(errors).most_common(1)[0][0]})" if errors else ""
    return [f"it is cut off or damaged: {decoded} of {max(expected, decoded)} frames could be decoded{reason}"]


def _missing_end(seen_s: float, duration_s: float) -> list[str]:
    """A note that the frames end long before the time that the header has for them."""
    if seen_s >= min(_ENDS_SHARE * duration_s, duration_s - _ENDS_S):
        return []
    return [f"it is cut off or damaged: it ends after {seen_s:.1f} s, by its header after {duration_s:.1f} s"]


def _reported(frames: Iterator[VideoFrame], total: int, label: str, progress: Progress) -> Iterator[VideoFrame]:
    step = f"looking through {label}"
    progress(step, 0, total)
    for done, frame in enumerate(frames, 1):
        yield frame
        if done % _REPORTED == 0:
            progress(step, min(done, total), total)
    progress(step, total, total)


def _within(width_px: int, height_px: int, side_px: int) -> tuple[int, int]:
    """The size of a picture that is reduced to this long side."""
    scale = min(1.0, side_px / max(width_px, height_px))
    return max(16, round(width_px * scale)), max(16, round(height_px * scale))


def _sharpness(grey: NDArray[np.uint8]) -> float:
    """The mean square of the differences between pixels that are two apart."""
    squares = cv2.norm(grey[:, 2:], grey[:, :-2], cv2.NORM_L2SQR) + cv2.norm(grey[2:], grey[:-2], cv2.NORM_L2SQR)
    return float(squares) / grey.size + 1e-6
