"""Photographs and their matches as pictures.

Everywhere, a match that agrees with a pose is green, or has the colour of its point's source, and any other is orange.
Drawn with matplotlib, without pyplot's global state.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray

from mapless.diagnostics import Debug
from mapless.geometry import Array, Camera, resized_pixel
from mapless_server.images import ImageLimits, decode_image

Picture = NDArray[np.uint8]
"""Pixels (H, W, 3), RGB."""
GOOD, WRONG = "#2ee6a6", "#ff6b2b"
"""Colours of matches that agree with a pose, and of those that do not."""
SOURCE_COLOURS = {
    "TRIANGULATED": ("green", GOOD),
    "MEASURED_DEPTH": ("blue", "#4aa8ff"),
    "KEPT_DEPTH": ("yellow", "#ffd23f"),
    "NETWORK_DEPTH": ("white", "#f4f4f4"),
    "PHOTOGRAPH_DEPTH": ("violet", "#b58cff"),
}
"""Names and colours of matches that agree with a pose, by the sources of their points; see `Debug.source`."""
RESIDUAL = "#ff4df0"
MAX_GOOD, MAX_WRONG = 140, 30
"""Most lines of a pair of photographs; more hide one another."""
_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200)
_SEEN_SHARE = 0.006
"""Drawn length of a median residual, relative to the photograph's width."""
_LONGEST_SHARE = 0.06
"""Longest line of a wrong match to its projected point, relative to the photograph's width."""
_GAP_PX = 12
_DPI = 100
_LIMITS = ImageLimits(max_bytes=1 << 30, max_pixels=200_000_000)
"""The server has checked the photographs; its limits may be higher than its defaults."""


def read_picture(image: bytes, max_side_px: int) -> Picture:
    """Reads a photograph without its EXIF orientation, and limits its longer side.

    InvalidArgument of the server if it cannot be read.
    """
    pixels = decode_image(image, _LIMITS)
    scale = min(1.0, max_side_px / max(pixels.shape[:2]))
    return _resized(pixels, max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))


def data_uri(picture: Picture) -> str:
    """The picture as a JPEG in a data URI: nothing is left of the photograph's metadata."""
    encoded = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()


@dataclass(frozen=True, eq=False)
class Shot:
    """A decoded photograph, possibly reduced, and its camera in the image's pixels."""

    image: Picture
    camera: Camera

    @staticmethod
    def of(image: bytes, camera: Camera, max_side_px: int) -> "Shot":
        """Decodes a photograph of a camera; InvalidArgument of the server if it cannot be read."""
        picture = read_picture(image, max_side_px)
        return Shot(picture, camera.resized(picture.shape[1], picture.shape[0]))

    def pixels_of(self, pixels: Array, camera: Camera) -> Array:
        """Pixels (N, 2) of `image` for pixels of the photograph as `camera` has it."""
        return _moved(pixels, self.camera.width_px / camera.width_px, self.camera.height_px / camera.height_px)


def colours_at(picture: Picture, camera: Camera, pixels: Array) -> NDArray[np.uint8]:
    """Colours (N, 3) of a reduced photograph at pixels (N, 2) of the whole one."""
    height, width = picture.shape[:2]
    scale_x, scale_y = width / camera.width_px, height / camera.height_px
    column = resized_pixel(pixels[:, 0], scale_x).round().astype(int)
    row = resized_pixel(pixels[:, 1], scale_y).round().astype(int)
    return np.asarray(picture[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)], np.uint8)


def source_colours(debug: Debug) -> list[str]:
    """The colour (M,) of each match as one that agrees with the pose."""
    return [SOURCE_COLOURS.get(it, ("", GOOD))[1] for it in debug.source] or [GOOD] * len(debug.is_inlier)


def axes_on(picture: Picture) -> Axes:
    """Axes in the pixels of a picture, on which to draw; `rendered` gives the result, of the same size."""
    height, width = picture.shape[:2]
    axes = Figure((width / _DPI, height / _DPI), dpi=_DPI).add_axes((0, 0, 1, 1))
    show(axes, picture)
    return axes


def show(axes: Axes, picture: Picture) -> None:
    """Shows a picture in its own pixels, with limits that further drawing does not change."""
    axes.imshow(picture, interpolation="antialiased", aspect="equal")
    axes.autoscale(False)
    axes.set_axis_off()


def rendered(figure: Figure | SubFigure) -> Picture:
    """The pixels of a figure."""
    canvas = FigureCanvasAgg(figure.figure if isinstance(figure, SubFigure) else figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


def add_lines(axes: Axes, ends: Array, **style: Any) -> None:
    """Draws segments (S, 2, 2), without those that have an end that is not finite, such as one behind the camera."""
    axes.add_collection(LineCollection(list(ends[np.isfinite(ends).all(axis=(1, 2))]), **style))


def draw_matches(
    axes: Axes,
    pixels: Array,
    projected: Array | None,
    is_good: NDArray[np.bool_],
    depth: Array | None = None,
    colours: Sequence[str] | None = None,
) -> int:
    """Draws the matches of a photograph that the axes show.

    A good one is a dot, and a line to where the pose projects its point; another is a cross, with the beginning of such
    a line. Returns how many times the lines of good ones are as long as their residuals.

    Args:
        axes: in pixels of the photograph.
        pixels: (M, 2) the keypoints.
        projected: (M, 2) the projections of their points, NaN behind the camera; None without a pose.
        is_good: (M,) whether the match agrees with the pose.
        depth: (M,) colours good ones in its order, near red and far blue; None for `colours`.
        colours: (M,) of those that are good; None for green.
    """
    width_px = float(np.ptp(axes.get_xlim()))
    unit = axes.get_window_extent().width / 1000 * 72 / _DPI  # a thousandth of the width, in points
    factor = 1
    if projected is not None:
        residual = projected - pixels
        factor = magnification(residual[is_good], width_px)
        length = np.linalg.norm(residual, axis=1, keepdims=True)
        far = residual * np.minimum(1.0, _LONGEST_SHARE * width_px / np.maximum(length, 1e-9))
        drawn = np.where(is_good[:, None], factor * residual, far)
        ends = np.stack([pixels, pixels + drawn], axis=1)
        add_lines(axes, ends[~is_good], color=WRONG, linewidth=1.2 * unit, alpha=0.5)
        add_lines(axes, ends[is_good], color=RESIDUAL, linewidth=1.6 * unit)
    wrong, good = pixels[~is_good], pixels[is_good]
    axes.scatter(wrong[:, 0], wrong[:, 1], marker="x", c=WRONG, s=(7 * unit) ** 2, linewidths=1.5 * unit)
    style: dict[str, Any] = {"c": GOOD if colours is None else np.asarray(colours)[is_good]}
    if depth is not None:  # its rank: every step of it is to be seen
        rank = np.argsort(np.argsort(-depth[is_good]))
        style = {"c": rank, "cmap": "turbo", "vmin": -0.18 * len(rank), "vmax": 1.05 * len(rank)}
    axes.scatter(good[:, 0], good[:, 1], s=(6.5 * unit) ** 2, linewidths=unit, edgecolors="#06251b", **style)
    return factor


def magnification(residual: Array, width_px: float) -> int:
    """Factor by which residuals (N, 2) are drawn longer, so that a median one is visible."""
    lengths = np.linalg.norm(residual, axis=1)
    lengths = lengths[np.isfinite(lengths)]
    if not len(lengths):
        return 1
    wanted = _SEEN_SHARE * width_px / max(float(np.median(lengths)), 1e-6)
    return max((it for it in _FACTORS if it <= wanted), default=1)


def side_by_side(
    left: Shot,
    right: Shot,
    left_px: Array,
    right_px: Array,
    is_good: NDArray[np.bool_],
    height_px: int = 480,
    colours: Sequence[str] | None = None,
) -> Picture:
    """Draws two photographs at one height, with lines from pixels (M, 2) of one image to those of the other.

    Of very many, some from left to right are drawn; good ones in their `colours` (M,), None for green.
    """
    of_good = np.asarray([GOOD] * len(is_good) if colours is None else colours)
    scales = [height_px / it.image.shape[0] for it in (left, right)]
    images = [
        _resized(it.image, max(1, round(it.image.shape[1] * scale)), height_px)
        for it, scale in zip((left, right), scales, strict=True)
    ]
    gap = np.full((height_px, _GAP_PX, 3), 128, np.uint8)
    axes = axes_on(np.concatenate([images[0], gap, images[1]], axis=1))
    start = _moved(left_px, images[0].shape[1] / left.image.shape[1], scales[0])
    end = _moved(right_px, images[1].shape[1] / right.image.shape[1], scales[1]) + (images[0].shape[1] + _GAP_PX, 0)
    ends = np.stack([start, end], axis=1)
    of_wrong = np.full_like(of_good, WRONG)
    for rows, count, colour, alpha in ((~is_good, MAX_WRONG, of_wrong, 0.6), (is_good, MAX_GOOD, of_good, 0.75)):
        some = _some(rows & np.isfinite(ends).all(axis=(1, 2)), start[:, 0], count)
        add_lines(axes, ends[some], color=colour[some], linewidth=0.9, alpha=alpha)
        for side in (0, 1):
            x, y = ends[some, side].T
            axes.scatter(x, y, c=colour[some], s=9, linewidths=0.6, edgecolors="#06251b")
    return rendered(axes.figure)


def _some(rows: NDArray[np.bool_], x: Array, count: int) -> NDArray[np.intp]:
    """Selects the rows to draw: all, or `count` of them evenly from left to right."""
    found = np.flatnonzero(rows)
    found = found[np.argsort(x[found], kind="stable")]
    if len(found) <= count:
        return found
    return np.asarray(found[np.linspace(0, len(found) - 1, count).round().astype(int)])


def _resized(picture: Picture, width_px: int, height_px: int) -> Picture:
    if picture.shape[:2] == (height_px, width_px):
        return picture
    return np.asarray(cv2.resize(picture, (width_px, height_px), interpolation=cv2.INTER_AREA), np.uint8)


def _moved(pixels: Array, scale_x: float, scale_y: float) -> Array:
    """Pixels (N, 2) of an image after it was resized."""
    return np.stack([resized_pixel(pixels[:, 0], scale_x), resized_pixel(pixels[:, 1], scale_y)], axis=-1)
