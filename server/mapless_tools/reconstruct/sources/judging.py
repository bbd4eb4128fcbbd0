"""Names the photographs that add nothing: files of the same picture, and blurred ones."""

import math
import statistics
from collections import defaultdict
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array
from mapless_server.images import ANY_SIZE, decode_image

from ..pictures import Omitted
from .blur import SIDE_PX
from .looking import SMALL_PX, Looked, upright_grey

_SAME_SIDES = 0.02
"""Relative: a program that resizes rounds both sides."""
_ALIKE = 0.9
"""Correlation at which two photographs are compared more closely."""
_COMPARED_PX = 512
_MAX_MOTION_PX = 0.3
"""Median motion between two files of one picture, in a raster of COMPARED_PX; programs that resize or compress leave
less than 0.28, from one frame of a hand-held video to the next it is 0.4 at least."""
_MIN_POINTS = 20
_BLANK = 0.5
"""Grey levels, root mean square: less is a picture of nothing, which is like any other such."""
_BLOCK = 500
_BLURRED_PX = 2.0
_BLURRED_RATIO = 2.5


def without_duplicates(photographs: Sequence[Looked]) -> tuple[list[Looked], list[Omitted]]:
    """Keeps, of files that show the same picture, the one with the most pixels, of these that with the most bytes."""
    omitted: dict[int, Omitted] = {}
    order = sorted(range(len(photographs)), key=lambda i: _worth(photographs[i]), reverse=True)
    for first, second in _alike([photographs[i] for i in order]):
        kept, other = order[first], order[second]
        if kept not in omitted and other not in omitted:
            reason = _sameness(photographs[kept], photographs[other])
            if reason:
                omitted[other] = Omitted(photographs[other].file.name, reason)
    return [it for i, it in enumerate(photographs) if i not in omitted], [omitted[i] for i in sorted(omitted)]


def without_blurred(photographs: Sequence[Looked]) -> tuple[list[Looked], list[Omitted]]:
    """A photograph is omitted as blurred if it is so beside the others of its camera."""
    blurs: dict[object, list[float]] = defaultdict(list)
    for it in photographs:
        if it.blur is not None:
            blurs[_camera(it)].append(it.blur)
    kept, omitted = [], []
    for it in photographs:
        usual = _usual(it.blur, blurs[_camera(it)])
        if it.blur is not None and usual is not None and it.blur >= max(_BLURRED_PX, _BLURRED_RATIO * usual):
            reason = f"it is blurred by {it.blur:.1f} pixels of {SIDE_PX}, the others of its camera by {usual:.1f}"
            omitted.append(Omitted(it.file.name, reason))
        else:
            kept.append(it)
    return kept, omitted


def mostly_blurred(photographs: Sequence[Looked]) -> bool:
    """Whether half of the photographs are blurred so much that they would be omitted beside sharp ones."""
    blurs = [it.blur for it in photographs if it.blur is not None]
    return bool(blurs) and statistics.median(blurs) >= _BLURRED_PX


def _worth(photograph: Looked) -> tuple[int, bool, int]:
    return photograph.width_px * photograph.height_px, bool(photograph.exif.make), photograph.byte_count


def _usual(blur: float | None, of_camera: list[float]) -> float | None:
    """The median of the other photographs of a camera; None if there is none."""
    others = sorted(of_camera)
    if blur is not None:
        others.remove(blur)
    return statistics.median(others) if others else None


def _camera(it: Looked) -> tuple[object, ...]:
    """The camera of a photograph, as far as its blur depends on it."""
    exif = it.exif
    return exif.make, exif.model, exif.lens, exif.focal_mm, *sorted((it.width_px, it.height_px))


def _alike(photographs: Sequence[Looked]) -> Iterator[tuple[int, int]]:
    """Pairs of indices, the smaller first, of photographs that look the same at a small size, or are the same bytes."""
    vectors = np.array([_fine(it.small).ravel() for it in photographs], np.float32).reshape(-1, SMALL_PX**2)
    for start in range(0, len(vectors), _BLOCK):
        alike = vectors[start : start + _BLOCK] @ vectors.T >= _ALIKE
        rows, columns = np.nonzero(alike)
        yield from ((int(i), int(j)) for i, j in zip(rows + start, columns, strict=True) if i < j)
    seen: dict[str, int] = {}
    for i, it in enumerate(photographs):
        first = seen.setdefault(it.digest, i)
        if first != i:
            yield first, i


def _sameness(kept: Looked, other: Looked) -> str:
    """A clause that two photographs are one; empty if they are two."""
    if kept.digest == other.digest:
        return f"it has the same bytes as {kept.file.name}"
    sides = [_upright_sides(it) for it in (kept, other)]
    if abs(sides[0] / sides[1] - 1) > _SAME_SIDES:
        return ""
    size_px = _compared_px(sides[0], min(max(it.width_px, it.height_px) for it in (kept, other)))
    if _motion_px(_grey(kept, size_px), _grey(other, size_px)) > _MAX_MOTION_PX:
        return ""
    if (kept.width_px, kept.height_px) == (other.width_px, other.height_px):
        return f"it is the same picture as {kept.file.name}, compressed otherwise"
    return f"it is the same picture as {kept.file.name}, with {other.width_px}x{other.height_px} pixels"


def _upright_sides(it: Looked) -> float:
    """Width by height of the upright photograph."""
    sides = it.width_px / it.height_px
    return 1 / sides if it.exif.orientation >= 5 else sides


def _compared_px(sides: float, long_px: int) -> tuple[int, int]:
    scale = min(_COMPARED_PX, long_px) / max(sides, 1)
    return max(1, round(scale * sides)), max(1, round(scale))


def _motion_px(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    """The median motion of corners from one picture to another, pixels; infinite if there are too few to say."""
    points = cv2.goodFeaturesToTrack(first, 200, 0.01, 8)
    if points is None or len(points) < _MIN_POINTS:
        return math.inf
    moved, is_found, _ = cv2.calcOpticalFlowPyrLK(first, second, points, np.empty_like(points), winSize=(15, 15))
    motions = np.linalg.norm(moved - points, axis=-1)
    return float(np.median(np.where(is_found == 1, motions, math.inf)))


def _grey(it: Looked, size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """The upright photograph of this size with usual brightness and contrast, since programs change both."""
    data = it.path.read_bytes()
    grey = upright_grey(data, decode_image(data, ANY_SIZE), size_px).astype(np.float32)
    return np.asarray(np.clip(128 + 40 * (grey - grey.mean()) / max(float(grey.std()), 1.0), 0, 255), np.uint8)


def _fine(grey: NDArray[np.uint8]) -> Array:
    """A picture without what is coarse, of mean 0 and unit length; 0 where there is nothing else."""
    it = grey.astype(np.float32)
    it = cv2.GaussianBlur(it, (0, 0), 1.0) - cv2.GaussianBlur(it, (0, 0), 4.0)
    it -= it.mean()
    length = float(np.sqrt((it**2).sum()))
    return np.asarray(it / length if length > _BLANK * it.size**0.5 else np.zeros_like(it))
