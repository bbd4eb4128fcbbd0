"""Pictures that all photographs of a camera carry: drawn on photographs, with the pixels that they cover."""

from collections.abc import Callable, Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Overlay = Callable[[Image, int], tuple[Image, Mask]]
"""Draws on a photograph (H, W, 3) or (H, W) with a number of its own; returns it and the pixels (H, W) covered."""

_FONT = cv2.FONT_HERSHEY_SIMPLEX


def nothing(image: Image, number: int) -> tuple[Image, Mask]:
    """Leaves the photograph as it is."""
    return image, np.zeros(image.shape[:2], bool)


def badge(image: Image, number: int) -> tuple[Image, Mask]:
    """An opaque badge with marks, 22 x 16 % of the image, in the upper left corner."""
    h, w = image.shape[:2]
    mask = np.zeros((h, w), bool)
    mask[: round(0.16 * h), : round(0.22 * w)] = True
    return _pasted(image, clutter(image.shape, 1), mask), mask


def bonnet(image: Image, number: int) -> tuple[Image, Mask]:
    """The bonnet of a car with reflections: the lower 18 % in the middle, rounded."""
    h, w = image.shape[:2]
    mask = np.zeros((h, w), np.uint8)
    cv2.ellipse(mask, (w // 2, h), (round(0.45 * w), round(0.18 * h)), 0, 180, 360, 1, -1)
    return _pasted(image, clutter(image.shape, 2), mask > 0), mask > 0


def gripper(image: Image, number: int) -> tuple[Image, Mask]:
    """Two fingers from the lower edge to the middle of the image."""
    h, w = image.shape[:2]
    mask = np.zeros((h, w), np.uint8)
    for side in (-1, 1):
        outline = [
            (0.5 + side * 0.20, 1.0),
            (0.5 + side * 0.06, 0.62),
            (0.5 + side * 0.10, 0.60),
            (0.5 + side * 0.30, 1),
        ]
        cv2.fillPoly(mask, [np.array([(x * w, y * h) for x, y in outline], np.int32)], 1)
    return _pasted(image, clutter(image.shape, 3), mask > 0), mask > 0


def time_stamp(image: Image, number: int) -> tuple[Image, Mask]:
    """Date and time in the lower left corner; the time is another one in each photograph."""
    seconds = 36_000 + 17 * number
    text = f"2026-11-{20 + number % 9:02d} {seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d} CAM 03"
    return _written(image, [(text, 0.03, 0.95)], 0.0012)


def hud(image: Image, number: int) -> tuple[Image, Mask]:
    """Lines and numbers of a display, some of which change."""
    h, w = image.shape[:2]
    lines = [
        (f"ALT {120 + number * 3 % 50:4d} m", 0.03, 0.08),
        ("MODE LOITER  GPS 3D FIX", 0.03, 0.14),
        (f"BAT {99 - number % 40} %  HDOP 0.7", 0.66, 0.08),
        (f"SPD {number * 7 % 13:2d}.{number % 10} m/s", 0.66, 0.14),
        ("REC  1080p30  ISO AUTO", 0.62, 0.94),
    ]
    drawn, mask = _written(image, lines, 0.0009)
    cross = np.zeros((h, w), np.uint8)
    for a, b in (
        ((0.42, 0.5), (0.47, 0.5)),
        ((0.53, 0.5), (0.58, 0.5)),
        ((0.5, 0.42), (0.5, 0.46)),
        ((0.1, 0.3), (0.1, 0.7)),
    ):
        cv2.line(cross, (round(a[0] * w), round(a[1] * h)), (round(b[0] * w), round(b[1] * h)), 1, max(2, w // 400))
    for tick in range(9):
        y = round((0.3 + 0.05 * tick) * h)
        cv2.line(cross, (round(0.1 * w), y), (round((0.12 + 0.01 * (tick % 2)) * w), y), 1, max(2, w // 400))
    drawn[cross > 0] = 255
    return drawn, mask | (cross > 0)


def watermark(image: Image, number: int) -> tuple[Image, Mask]:
    """Half-transparent words across the middle of the image."""
    return _written(image, [("SURVEY COPY", 0.08, 0.55), ("do not use", 0.30, 0.72)], 0.0036, 0.5)


OVERLAYS: Mapping[str, Overlay] = {
    "badge": badge,
    "bonnet": bonnet,
    "gripper": gripper,
    "time stamp": time_stamp,
    "display": hud,
    "watermark": watermark,
}


def black(overlay: Overlay) -> Overlay:
    """The same pixels black."""

    def blackened(image: Image, number: int) -> tuple[Image, Mask]:
        mask = overlay(image, number)[1]
        return _pasted(image, np.zeros_like(image), mask), mask

    return blackened


def _written(
    image: Image, lines: list[tuple[str, float, float]], size: float, strength: float = 1.0
) -> tuple[Image, Mask]:
    h, w = image.shape[:2]
    mask = np.zeros((h, w), np.uint8)
    for text, x, y in lines:
        cv2.putText(
            mask, text, (round(x * w), round(y * h)), _FONT, size * w, 1, max(2, round(2.2 * size * w)), cv2.LINE_8
        )
    white = (image + strength * (255.0 - image)).astype(np.uint8)
    outline = cv2.dilate(mask, np.ones((3, 3), np.uint8)) > 0
    dark = (image * (1 - 0.8 * strength)).astype(np.uint8)
    return _pasted(_pasted(image, dark, outline), white, mask > 0), outline


def _pasted(image: Image, other: Image, mask: Mask) -> Image:
    pasted = image.copy()
    pasted[mask] = other[mask]
    return pasted


def clutter(shape: tuple[int, ...], seed: int) -> Image:
    """A picture full of corners."""
    random, (h, w) = np.random.default_rng(seed), shape[:2]
    picture = np.full(shape, 90, np.uint8)
    for _ in range(700):
        centre = (int(random.integers(w)), int(random.integers(h)))
        colour = [int(c) for c in random.integers(0, 256, 3)]
        size = int(random.integers(w // 250 + 2, w // 40 + 4))
        if random.random() < 0.5:
            cv2.circle(picture, centre, size, colour, -1)
        else:
            cv2.rectangle(
                picture, centre, (centre[0] + size, centre[1] + int(size * random.uniform(0.3, 1.5))), colour, -1
            )
    return picture
