"""Reads the videos of the sources: frames that are sharp and apart by what they show."""

import filecmp
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapless_server.errors import InvalidArgument
from mapless_server.images import image_size
from mapless_tools.progress import Progress

from ..pictures import Omitted, VideoTime
from .choosing import choose_frames, common_spacing
from .finding import SourceFile
from .frames import write_frames
from .options import SourceOptions
from .remembered import Remembered, identity
from .video import opened_video
from .watching import Watched, watch

_LIVE_S = 5.0
"""A phone's moving photograph lies beside the photograph, with its stem, and has three seconds."""
_REASON_CHARACTERS = 200


@dataclass(frozen=True)
class ChosenFrame:
    """A frame of a video that takes part, and the JPEG that was made of it."""

    file: SourceFile
    path: Path
    width_px: int
    height_px: int
    time: VideoTime


def read_videos(
    files: Sequence[SourceFile],
    photographs: Sequence[SourceFile],
    folder: Path,
    options: SourceOptions,
    remembered: Remembered,
    progress: Progress,
) -> tuple[list[ChosenFrame], list[Omitted], list[str], int]:
    """The frames that take part, in the order of the videos and of time, what does not, notes, and how many there are.

    ValueError if there are more videos than frames may be chosen.
    """
    watched: list[tuple[SourceFile, Watched]] = []
    omitted: list[Omitted] = []
    beside = {(it.path.parent, it.path.stem.casefold()) for it in photographs}
    for file in files:
        result = _watched(file, [it for it, _ in watched], beside, options, remembered, progress)
        if isinstance(result, Omitted):
            omitted.append(result)
        else:
            watched.append((file, result))
    spacing = common_spacing([it.extent() for _, it in watched], options.frames)
    chosen, notes = [], []
    for file, it in watched:
        positions = choose_frames(np.array(it.content), np.array(it.sharpness), np.array(it.usable), spacing)
        paths = write_frames(file.path, it, positions, folder / f"video-{identity(file.path)}", file.name, progress)
        frames, refused = _checked(file, it, paths, options)
        chosen += frames
        omitted += refused
        rest = it.count - len(frames) - len(refused)
        if rest:
            omitted.append(Omitted(file.name, "what they show, chosen frames show too, or they are less sharp", rest))
        notes += [f"{file.name}: {note}" for note in (_choice(it, frames, spacing), *it.notes)]
    return chosen, omitted, notes, sum(it.count for _, it in watched)


def _watched(
    file: SourceFile,
    earlier: Sequence[SourceFile],
    beside: set[tuple[Path, str]],
    options: SourceOptions,
    remembered: Remembered,
    progress: Progress,
) -> Watched | Omitted:
    """The frames that a video offers, or why it takes no part."""
    try:
        copied = next((it for it in earlier if filecmp.cmp(it.path, file.path, shallow=False)), None)
        if copied:
            return Omitted(file.name, f"it has the same bytes as {copied.name}")
        if (file.path.parent, file.path.stem.casefold()) in beside and _duration_s(file.path) < _LIVE_S:
            return Omitted(file.name, "it is the moving part of the photograph beside it")
        key = f"{identity(file.path)} {options.frames}"
        known = remembered.get(key)
        if known is not None:
            return Watched(**known)
        result = watch(file.path, options.frames, file.name, progress)
    except (OSError, ValueError) as error:
        return Omitted(file.name, str(error)[:_REASON_CHARACTERS])
    remembered.put(key, result.to_json())
    return result


def _duration_s(file: Path) -> float:
    with opened_video(file) as video:
        return video.duration_s


def _checked(
    file: SourceFile, watched: Watched, paths: dict[int, Path], options: SourceOptions
) -> tuple[list[ChosenFrame], list[Omitted]]:
    """The frames whose files are accepted, and the others."""
    frames, refused = [], []
    for position, path in sorted(paths.items()):
        time = VideoTime(file.name, watched.frame[position], watched.time_s[position])
        size_px = _size(path, options)
        if isinstance(size_px, str):
            refused.append(Omitted(f"{file.name}, frame {time.frame}", size_px))
        else:
            frames.append(ChosenFrame(file, path, *size_px, time))
    return frames, refused


def _size(path: Path, options: SourceOptions) -> tuple[int, int] | str:
    """Width and height of a file, or why it is not accepted."""
    try:
        return image_size(path.read_bytes(), options.limits)
    except InvalidArgument as error:
        return str(error)


def _choice(watched: Watched, frames: Sequence[ChosenFrame], spacing: float) -> str:
    if not frames:
        return "no frame was chosen"
    taken = f"{len(frames)} of {watched.count} frames were chosen, as JPEG of quality 95"
    if spacing > 1:
        taken += f"; they are {spacing:.1f} times as far apart as they could be, since frames is a bound"
    if len(frames) < 3 <= watched.count:
        taken += "; the camera hardly moves"
    return taken
