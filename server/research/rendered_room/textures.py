"""Surfaces made from random numbers: wood, bricks, cloth, books, paintings.

There is detail at every scale, for features to hold on to from near and from far, and none of it repeats exactly.
"""

import colorsys
import itertools
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Random = np.random.Generator
Image = NDArray[np.float32]
"""(h, w, 3) RGB as on a screen (sRGB), 0 to 1."""
Colour = tuple[float, float, float]
Shape = tuple[int, int]
"""Height, width."""
Texture = Callable[[Random, Shape], Image]
OAK, WALNUT, PINE, WHITE = (0.62, 0.44, 0.27), (0.36, 0.23, 0.15), (0.78, 0.62, 0.40), (0.88, 0.87, 0.84)
SYLLABLES = "ba re mi to lu ka son vel dor an thi es gra pol ne sta mor".split(" ")  # noqa: SIM905


def noise(random: Random, shape: Shape, cell: tuple[float, float], octaves: int = 5) -> Image:
    """Noise of several scales (h, w), zero mean, unit deviation; `cell` is the coarsest grain in pixels, y and x."""
    total = np.zeros(shape, np.float32)
    for octave in range(octaves):
        grid = [min(max(2, round(n * 2**octave / c)), n) for n, c in zip(shape, cell, strict=True)]
        values = random.standard_normal(grid).astype(np.float32)
        total += 0.6**octave * cv2.resize(values, shape[::-1], interpolation=cv2.INTER_CUBIC)
    total -= total.mean()
    return np.asarray(total / max(float(total.std()), 1e-6), np.float32)


def tinted(image: Image, pattern: NDArray[np.floating], amount: float) -> Image:
    """The image lighter and darker by `amount` times the pattern (h, w)."""
    return np.asarray(np.clip(image * (1 + amount * pattern[..., None]), 0, 1), np.float32)


def some_colour(random: Random) -> Colour:
    """Any hue, neither grey nor dark."""
    return colorsys.hsv_to_rgb(random.random(), random.uniform(0.2, 0.7), random.uniform(0.2, 0.9))


def plain(colour: Colour) -> Texture:
    """A painted wall or cloth: one colour with faint clouds and a fine grain."""

    def paint(random: Random, shape: Shape) -> Image:
        image = tinted(np.full((*shape, 3), colour, np.float32), noise(random, shape, (200, 200)), 0.03)
        return tinted(image, noise(random, shape, (6, 6), 2), 0.04)

    return paint


def wood(colour: Colour) -> Texture:
    """Wood with its grain along the longer side."""

    def grow(random: Random, shape: Shape) -> Image:
        if shape[0] > shape[1]:
            return np.ascontiguousarray(grow(random, shape[::-1]).transpose(1, 0, 2))
        h, w = shape
        bend = noise(random, shape, (h / 1.5, w / 1.5), 2) * 8 + noise(random, shape, (30, 300), 3) * 1.5
        rings = np.sin((np.arange(h)[:, None] + 3 * bend) * random.uniform(0.25, 0.45))
        board = tinted(np.full((*shape, 3), colour, np.float32), rings, 0.07)
        return tinted(board, noise(random, shape, (3, 120), 3), 0.1) * np.float32(random.uniform(0.8, 1.1))

    return grow


def rows(piece: Texture, height_px: int, width_px: tuple[int, int], joint: float) -> Texture:
    """Rows of pieces of a range of widths: boards, bricks, or books on shelves; joints are darker by this factor."""

    def lay(random: Random, shape: Shape) -> Image:
        laid = np.zeros((*shape, 3), np.float32)
        for top in range(0, shape[0], height_px):
            left = 0
            while left < shape[1]:
                width = int(random.integers(*width_px))
                part = laid[top : top + height_px, left : left + width]
                part[:] = piece(random, (height_px, width))[: part.shape[0], : part.shape[1]]
                part[:3] *= joint
                part[:, :3] *= joint
                left += width
        return laid

    return lay


def brick(random: Random, shape: Shape) -> Image:
    """A brick, of a colour of its own."""
    tone = random.uniform(0.7, 1.1)
    colour = (0.58 * tone, 0.36 * tone * random.uniform(0.85, 1.1), 0.29 * tone)
    return tinted(plain(colour)(random, shape), noise(random, shape, (12, 20), 4), 0.12)


def shapes(random: Random, shape: Shape, count: int = 40) -> Image:
    """An abstract painting: ellipses, polygons and brush strokes over a gradient."""
    h, w = shape
    ramp = np.linspace(0, 1, h, dtype=np.float32)[:, None, None]
    ends = [np.array(some_colour(random), np.float32) for _ in range(2)]
    image = np.ascontiguousarray(np.broadcast_to(ends[0] * (1 - ramp) + ends[1] * ramp, (h, w, 3)))
    for _ in range(count):
        paint, kind = some_colour(random), random.integers(3)
        x, y, size = random.uniform(0, w), random.uniform(0, h), random.uniform(0.04, 0.25) * min(h, w)
        if kind == 0:
            axes = (int(size), max(1, int(size * random.uniform(0.3, 1))))
            cv2.ellipse(image, (int(x), int(y)), axes, random.uniform(0, 180), 0, 360, paint, -1, cv2.LINE_AA)
        elif kind == 1:
            corners = np.array([x, y]) + random.uniform(-size, size, (5, 2))
            cv2.fillPoly(image, [cv2.convexHull(corners.astype(np.int32))], paint, cv2.LINE_AA)
        else:
            stroke = np.array([x, y]) + np.cumsum(random.uniform(-0.5, 0.5, (8, 2)) * size, axis=0)
            cv2.polylines(image, [stroke.astype(np.int32)], False, paint, max(1, int(size / 9)), cv2.LINE_AA)
    return tinted(image, noise(random, shape, (30, 40)), 0.06)


def framed(random: Random, shape: Shape) -> Image:
    """A painting in a wooden frame."""
    image, border_px = wood(WALNUT)(random, shape), max(8, min(shape) // 16)
    inner = image[border_px:-border_px, border_px:-border_px]
    inner[:] = shapes(random, inner.shape[:2])
    return image


def write(random: Random, image: Image, middle: float, height: float) -> None:
    """Write a word of no language into the image, in place: at a height of it and so high, as shares of its own."""
    h, w = image.shape[:2]
    text = "".join(random.choice(SYLLABLES, random.integers(2, 4))).upper()
    (text_w, text_h), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, 1.0, 2)
    scale = min(height * h / text_h, 0.88 * w / text_w)
    origin = (round((w - scale * text_w) / 2), round(middle * h + scale * text_h / 2))
    letters = np.zeros((h, w), np.uint8)  # OpenCV 5 writes text into bytes only
    cv2.putText(letters, text, origin, cv2.FONT_HERSHEY_DUPLEX, scale, (255,), max(1, round(2 * scale)), cv2.LINE_AA)
    ink = 0.08 if image.mean() > 0.5 else 0.95
    image += (letters / np.float32(255))[..., None] * (ink - image)


def cover(random: Random, shape: Shape) -> Image:
    """A book cover, a box of cereal: shapes, and a word on a band."""
    image, middle = shapes(random, shape, 14), random.uniform(0.25, 0.75)
    band = image[int((middle - 0.14) * shape[0]) : int((middle + 0.14) * shape[0])]
    band[:] = some_colour(random)
    write(random, band, 0.5, 0.55)
    return image


def book(random: Random, shape: Shape) -> Image:
    """The spine of a standing book with its title and bands, and the dark above it."""
    spine = plain(some_colour(random))(random, shape[::-1])
    for x in random.uniform(0.03, 0.97, 3):
        spine[:, int(x * shape[0]) :][:, :4] = some_colour(random)
    write(random, spine, 0.5, 0.6)
    spine = np.ascontiguousarray(np.rot90(spine, -1))
    spine[: int(random.uniform(0.1, 0.35) * shape[0])] = 0.06
    return spine


def panelled(random: Random, shape: Shape) -> Image:
    """The front of a door or cupboard: wood with panels, joints and handles."""
    image = np.ascontiguousarray(wood(OAK)(random, shape))
    columns = np.linspace(0, shape[1], max(3, round(2 * shape[1] / shape[0]) + 1)).astype(int).tolist()
    for (left, right), (top, bottom) in itertools.product(
        itertools.pairwise(columns), itertools.pairwise((0, shape[0] // 2, shape[0]))
    ):
        d = (right - left) // 8
        cv2.rectangle(image, (left, top), (right, bottom), (0.08, 0.06, 0.05), 2)
        cv2.rectangle(image, (left + d, top + d), (right - d, bottom - d), (0.34, 0.24, 0.15), 3)
        cv2.circle(image, (right - d // 2, (top + bottom) // 2), max(3, d // 4), (0.75, 0.7, 0.55), -1)
    return image
