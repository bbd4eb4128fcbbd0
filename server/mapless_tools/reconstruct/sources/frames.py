"""Makes JPEG files of the chosen frames of a video, and of no other."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from mapless_tools.progress import Progress

from .jpeg import write_jpeg
from .video import Video, opened_video
from .watching import Watched, packets_of

if TYPE_CHECKING:
    from av import VideoFrame


def write_frames(
    file: Path, watched: Watched, chosen: Sequence[int], folder: Path, label: str, progress: Progress
) -> dict[int, Path]:
    """Writes the frames at these positions in `watched`, those that are missing, and returns their files.

    Files are named by the frame's index. A frame that the second decoding does not yield has none.
    """
    folder.mkdir(exist_ok=True)
    files = {it: folder / f"{watched.frame[it]:06d}.jpg" for it in chosen}
    missing = [it for it in chosen if not files[it].exists()]
    if not missing:
        return files
    step = f"writing frames of {label}"
    progress(step, len(chosen) - len(missing), len(chosen))
    for done, (position, picture) in enumerate(_pictures(file, watched, missing), len(chosen) - len(missing) + 1):
        write_jpeg(files[position], picture)
        progress(step, done, len(chosen))
    return {it: path for it, path in files.items() if path.exists()}


def _pictures(file: Path, watched: Watched, positions: Sequence[int]) -> Iterator[tuple[int, Image.Image]]:
    """Yields positions and upright pictures; those that are not found by seeking are, by counting from the start."""
    found = set()
    if all(watched.pts[it] != -1 for it in positions):
        with opened_video(file, keys_only=watched.keys_only) as video:
            wanted = {watched.pts[it]: it for it in positions}
            for position, frame in _sought(video, wanted, packets_of(file).key_times):
                found.add(position)
                yield position, Image.fromarray(video.upright(frame))
    rest = set(positions) - found
    if rest:
        with opened_video(file, keys_only=watched.keys_only) as video:
            for position, frame in enumerate(video.frames([])):
                if position in rest:
                    yield position, Image.fromarray(video.upright(frame))
                if position >= max(rest):
                    return


def _sought(video: Video, wanted: Mapping[int, int], key_times: Sequence[int]) -> Iterator[tuple[int, VideoFrame]]:
    """Yields the frames of these times; where a key frame lies between two of them, what is before it is skipped.

    Ends where the video cannot be sought in.
    """
    from av.error import FFmpegError

    frames = video.frames([])
    frame = next(frames, None)
    for pts in sorted(wanted):
        before = bisect_right(key_times, pts)
        if frame is None or (before and frame.pts is not None and key_times[before - 1] > frame.pts):
            try:
                video.container.seek(pts, stream=video.stream)
            except (FFmpegError, OSError):
                return
            frames = video.frames([])
            frame = next(frames, None)
        while frame is not None and frame.pts is not None and frame.pts < pts:
            frame = next(frames, None)
        if frame is not None and frame.pts == pts:
            yield wanted[pts], frame
