"""Surfaces made from random numbers: wood, plaster, bricks, cloth, books, paintings.

There is detail at every scale, for features to hold on to from near and from far, and none of it repeats exactly.
"""

import colorsys
import itertools
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Random = np.random.Generator
Image = NDArray[np.float32]
"""(h, w, 3) RGB as on a screen (sRGB), 0 to 1; or (h, w)."""
Colour = tuple[float, float, float]
Shape = tuple[int, int]
"""Height, width."""
HUES = (0.0, 0.02, 0.05, 0.08, 0.10, 0.13, 0.16, 0.25, 0.38, 0.48, 0.55, 0.58, 0.62, 0.68, 0.85, 0.95)
SYLLABLES = "ba re mi to lu ka son vel dor an thi es gra pol ne sta mor".split(" ")  # noqa: SIM905
FONTS = (0, 2, 3, 4, 7)
"""Simplex, duplex, complex, triplex and script of OpenCV."""


def plain(shape: Shape, colour: Colour) -> Image:
    """One colour."""
    return np.full((*shape, 3), colour, np.float32)


def noise(random: Random, shape: Shape, cell: tuple[float, float], octaves: int = 5) -> Image:
    """Noise of several scales (h, w), zero mean, unit deviation; `cell` is the coarsest grain in pixels, y and x."""
    total, weight = np.zeros(shape, np.float32), 1.0
    for octave in range(octaves):
        grid = [min(max(2, round(n * 2**octave / c)), n) for n, c in zip(shape, cell, strict=True)]
        values = random.standard_normal(grid).astype(np.float32)
        total += weight * cv2.resize(values, shape[::-1], interpolation=cv2.INTER_CUBIC)
        weight *= 0.6
    total -= total.mean()
    return np.asarray(total / max(float(total.std()), 1e-6), np.float32)


def tinted(image: Image, pattern: NDArray[Any], amount: float) -> Image:
    """The image lighter and darker by `amount` times the pattern (h, w)."""
    return np.asarray(np.clip(image * (1 + amount * pattern[..., None]), 0, 1), np.float32)


def some_colour(random: Random, saturation: tuple[float, float], value: tuple[float, float]) -> Colour:
    """A hue as people buy them, with saturation and value in the given ranges."""
    hue = random.choice(HUES) + random.normal(0, 0.015)
    return colorsys.hsv_to_rgb(hue % 1, random.uniform(*saturation), random.uniform(*value))


def word(random: Random) -> str:
    """A word of no language, two or three syllables."""
    return "".join(random.choice(SYLLABLES, random.integers(2, 4))).capitalize()


def plaster(random: Random, shape: Shape, base: Colour) -> Image:
    """A painted wall: nearly one colour, faint clouds, roller grain, a few stains."""
    wall = tinted(plain(shape, base), noise(random, shape, (400, 400), 4), 0.02)
    wall = tinted(wall, noise(random, shape, (6, 6), 2), 0.02)
    return tinted(wall, np.clip(noise(random, shape, (150, 150), 6) - 2.2, 0, 1), -0.12)


def wallpaper(random: Random, shape: Shape, base: Colour) -> Image:
    """Vertical stripes with a printed sprig at irregular places."""
    wall = plaster(random, shape, base)
    stripes = np.sin(np.arange(shape[1]) * 2 * np.pi / 56) > 0.3
    wall *= np.where(stripes, 0.94, 1.0).astype(np.float32)[None, :, None]
    ink = tuple(float(c) * 0.72 for c in base)
    for _ in range(shape[0] * shape[1] // 6000):
        centre = np.array([random.integers(shape[1]), random.integers(shape[0])])
        for angle in random.uniform(0, 2 * np.pi) + np.arange(random.integers(3, 6)) * 2 * np.pi / 5:
            tip = centre + random.uniform(5, 14) * np.array([np.cos(angle), np.sin(angle)])
            cv2.line(wall, centre.tolist(), tip.astype(int).tolist(), ink, 2, cv2.LINE_AA)
    return wall


def wood(random: Random, shape: Shape, base: Colour) -> Image:
    """Wood with its grain along the longer side."""
    if shape[0] > shape[1]:
        return np.ascontiguousarray(wood(random, shape[::-1], base).transpose(1, 0, 2))
    h, w = shape
    bend = noise(random, shape, (h / 1.5, w / 1.5), 2) * 8 + noise(random, shape, (30, 300), 3) * 1.5
    rings = np.sin((np.arange(h, dtype=np.float32)[:, None] + bend * 3) * random.uniform(0.25, 0.45))
    board = tinted(plain(shape, base), rings, 0.07)
    board = tinted(board, noise(random, shape, (3, 120), 3), 0.09)
    for _ in range(random.poisson(h * w / 160_000)):
        centre = (int(random.integers(w)), int(random.integers(h)))
        for radius in range(3, 12, 2):
            dark = tuple(float(c) * random.uniform(0.45, 0.75) for c in base)
            cv2.ellipse(board, centre, (radius * 2, radius), random.uniform(-8, 8), 0, 360, dark, 2, cv2.LINE_AA)
    return tinted(board, noise(random, shape, (200, 300), 4), 0.05)


def floor_boards(random: Random, shape: Shape, board_px: int) -> Image:
    """Boards along x, each with its own grain, colour and length."""
    floor = np.zeros((*shape, 3), np.float32)
    for top in range(0, shape[0], board_px):
        left = -int(random.integers(0, 4 * board_px))
        while left < shape[1]:
            right = left + int(random.uniform(5, 12) * board_px)
            tone = random.uniform(0.75, 1.1)
            base = (0.56 * tone, 0.39 * tone * random.uniform(0.95, 1.05), 0.25 * tone)
            board = wood(random, (board_px, right - left), base)
            board[:2] *= 0.45
            board[:, :2] *= 0.45
            part = floor[top : top + board_px, max(left, 0) : right]
            start = max(-left, 0)
            part[:] = board[: part.shape[0], start : start + part.shape[1]]
            left = right
    return floor


def bricks(random: Random, shape: Shape, brick_px: tuple[int, int]) -> Image:
    """A wall of bricks (height, width of one in pixels) in running bond."""
    wall = tinted(plain(shape, (0.62, 0.59, 0.54)), noise(random, shape, (8, 8), 3), 0.08)
    h, w = brick_px
    joint = max(2, h // 8)
    grain = noise(random, shape, (30, 30), 5)
    for row, top in enumerate(range(0, shape[0], h)):
        for left in range(-(row % 2) * w // 2, shape[1], w):
            tone = random.uniform(0.7, 1.15)
            base = (0.60 * tone, 0.33 * tone * random.uniform(0.85, 1.2), 0.26 * tone * random.uniform(0.85, 1.2))
            wear = random.integers(-joint // 2, joint // 2 + 1, 4)
            rows = slice(max(top + joint + wear[0], 0), max(top + h + wear[1], 0))
            columns = slice(max(left + joint + wear[2], 0), max(left + w + wear[3], 0))
            wall[rows, columns] = tinted(plain(wall[rows, columns].shape[:2], base), grain[rows, columns], 0.14)
    return wall


def fabric(random: Random, shape: Shape, base: Colour) -> Image:
    """Coarse cloth: two directions of thread, each thread with its own tone."""
    warp = np.repeat(random.standard_normal(shape[1] // 3 + 1), 3)[: shape[1]]
    weft = np.repeat(random.standard_normal(shape[0] // 3 + 1), 3)[: shape[0]]
    cloth = tinted(plain(shape, base), (warp[None, :] + weft[:, None]).astype(np.float32), 0.05)
    return tinted(cloth, noise(random, shape, (60, 60), 5), 0.08)


def rug(random: Random, shape: Shape) -> Image:
    """A woven rug: borders, rows of lozenges in a few wools, wear."""
    wools = [some_colour(random, (0.5, 0.75), (0.25, 0.65)) for _ in range(4)]
    wools += [(0.80, 0.72, 0.58), (0.13, 0.11, 0.16)]
    image = plain(shape, wools[0])
    h, w = shape
    for inset, wool in ((0.03, 4), (0.06, 1), (0.11, 5), (0.13, 2)):
        d = int(inset * h)
        cv2.rectangle(image, (d, d), (w - d, h - d), wools[wool], -1)
    step = h // 9
    for y, x in itertools.product(range(2 * step, h - step, step), range(2 * step, w - step, step)):
        for size in (0.48, 0.34, 0.2):
            r = int(step * size * random.uniform(0.75, 1.1))
            lozenge = np.array([[x, y - r], [x + r, y], [x, y + r], [x - r, y]], np.int32)
            cv2.fillPoly(image, [lozenge], wools[random.integers(6)])
    threads = np.repeat(random.standard_normal((h // 3 + 1, w // 5 + 1)), 3, axis=0).repeat(5, axis=1)[:h, :w]
    image = tinted(image, threads.astype(np.float32), 0.10)
    return tinted(image, noise(random, shape, (120, 120), 5), 0.07)


def write(random: Random, image: Image, text: str, ink: Colour, where: tuple[float, float], height: float) -> None:
    """Write a line into the image, in place: centred at `where` (x, y) and at most `height`, as shares of its size."""
    h, w = image.shape[:2]
    font = int(random.choice(FONTS))
    (text_w, text_h), _ = cv2.getTextSize(text, font, 1.0, 2)
    scale = min(height * h / text_h, 0.88 * w / text_w)
    origin = (round(where[0] * w - scale * text_w / 2), round(where[1] * h + scale * text_h / 2))
    cover = np.zeros((h, w), np.uint8)  # OpenCV 5 writes text into bytes only
    cv2.putText(cover, text, origin, font, scale, (255,), max(1, round(1.8 * scale)), cv2.LINE_AA)
    image += (cover / np.float32(255))[..., None] * (np.array(ink, np.float32) - image)


def book_spine(random: Random, shape: Shape) -> Image:
    """The spine of a lying book: title and author along it, bands."""
    base = some_colour(random, (0.15, 0.8), (0.2, 0.85))
    ink = (0.95, 0.9, 0.75) if sum(base) < 1.5 else (0.1, 0.08, 0.1)
    spine = tinted(plain(shape, base), noise(random, shape, (10, 30), 4), 0.06)
    for x in random.uniform(0.03, 0.97, random.integers(1, 4)):
        cv2.line(spine, (int(x * shape[1]), 0), (int(x * shape[1]), shape[0]), ink, int(random.integers(1, 4)))
    write(random, spine, f"{word(random)} {word(random)}".upper(), ink, (0.42, 0.5), random.uniform(0.35, 0.6))
    write(random, spine, word(random), ink, (0.86, 0.5), 0.3)
    return spine


def standing_spine(random: Random, shape: Shape) -> Image:
    """The spine of a standing book."""
    return np.ascontiguousarray(np.rot90(book_spine(random, shape[::-1]), -1))


def cover(random: Random, shape: Shape) -> Image:
    """A book cover, a box of cereal, a magazine: shapes and some words."""
    image = shapes(random, shape, 12)
    top, bottom = sorted(random.uniform(0.1, 0.9, 2))
    if bottom - top < 0.2:
        top, bottom = 0.15, 0.4
    base = some_colour(random, (0.3, 0.9), (0.2, 0.9))
    image[int(top * shape[0]) : int(bottom * shape[0])] = base
    ink = (1.0, 0.97, 0.9) if sum(base) < 1.5 else (0.08, 0.08, 0.1)
    write(random, image, word(random).upper(), ink, (0.5, (top + bottom) / 2), 0.5 * (bottom - top))
    for y in np.arange(0.06, 0.97, 0.06):
        if not top - 0.05 < y < bottom + 0.05 and random.random() < 0.5:
            line = " ".join(word(random) for _ in range(3))
            write(random, image, line, some_colour(random, (0, 0.3), (0, 1)), (0.5, float(y)), 0.035)
    return tinted(image, noise(random, shape, (40, 40), 5), 0.04)


def shapes(random: Random, shape: Shape, count: int) -> Image:
    """Coloured ellipses, polygons and strokes over a gradient."""
    h, w = shape
    ends = [np.array(some_colour(random, (0.1, 0.6), (0.4, 0.95)), np.float32) for _ in range(2)]
    ramp = np.linspace(0, 1, h, dtype=np.float32)[:, None, None]
    image = np.ascontiguousarray(np.broadcast_to(ends[0] * (1 - ramp) + ends[1] * ramp, (h, w, 3)))
    for _ in range(count):
        paint = some_colour(random, (0.2, 0.95), (0.15, 0.95))
        x, y, size = random.uniform(0, w), random.uniform(0, h), random.uniform(0.04, 0.25) * min(h, w)
        kind = random.integers(3)
        if kind == 0:
            axes = (int(size), max(1, int(size * random.uniform(0.3, 1))))
            cv2.ellipse(image, (int(x), int(y)), axes, random.uniform(0, 180), 0, 360, paint, -1, cv2.LINE_AA)
        elif kind == 1:
            corners = np.array([x, y]) + random.uniform(-size, size, (random.integers(3, 6), 2))
            cv2.fillPoly(image, [cv2.convexHull(corners.astype(np.int32))], paint, cv2.LINE_AA)
        else:
            stroke = np.array([x, y]) + np.cumsum(random.uniform(-0.5, 0.5, (8, 2)) * size, axis=0)
            cv2.polylines(image, [stroke.astype(np.int32)], False, paint, max(1, int(size / 9)), cv2.LINE_AA)
    return image


def painting(random: Random, shape: Shape) -> Image:
    """An abstract painting with brush strokes."""
    image = shapes(random, shape, int(random.integers(25, 60)))
    image = tinted(image, noise(random, shape, (8, 50), 4), 0.07)
    hue = np.stack([noise(random, shape, (90, 90), 5) for _ in range(3)], axis=-1)
    return np.asarray(np.clip(image + 0.05 * hue, 0, 1), np.float32)


def framed(random: Random, shape: Shape, art: Callable[..., Image], frame: Colour, border_px: int) -> Image:
    """A picture in a wooden frame, with a dark line between."""
    image = wood(random, shape, frame)
    inner = image[border_px:-border_px, border_px:-border_px]
    inner[:] = 0.12
    inner[3:-3, 3:-3] = art(random, (inner.shape[0] - 6, inner.shape[1] - 6))
    return image


def carton(random: Random, shape: Shape) -> Image:
    """Cardboard with print and tape."""
    board = tinted(plain(shape, (0.68, 0.52, 0.34)), noise(random, shape, (4, 200), 3), 0.05)
    board[:, shape[1] // 2 - 18 : shape[1] // 2 + 18] *= (1.1, 1.1, 1.05)
    for y in (0.3, 0.55, 0.75):
        write(random, board, f"{word(random)} {random.integers(100, 999)}", (0.2, 0.14, 0.1), (0.5, y), 0.11)
    return np.asarray(np.clip(board, 0, 1), np.float32)


def landscape(random: Random, shape: Shape) -> Image:
    """What the window shows: sky with clouds, hills, trees, houses."""
    h, w = shape
    sky = np.linspace(0, 1, h, dtype=np.float32)[:, None, None] * (0.35, 0.22, 0.05) + (0.55, 0.72, 0.95)
    image = np.ascontiguousarray(np.broadcast_to(sky, (h, w, 3)).astype(np.float32))
    image += np.clip(noise(random, shape, (h / 4, w / 3), 6), 0, 1)[..., None] * (1 - image) * 0.8
    for layer in range(4):
        ridge = (0.42 + 0.12 * layer) * h + noise(random, (1, w), (1, w / 3), 6)[0] * 0.04 * h
        tone = random.uniform(0.8, 1.1)
        green = (tone * (0.20 + 0.03 * layer), tone * (0.36 - 0.03 * layer), tone * 0.18)
        below = np.arange(h)[:, None] > ridge[None, :]
        image[below] = tinted(plain(shape, green), noise(random, shape, (12, 12), 4), 0.2)[below]
    for x in np.sort(random.uniform(0, 0.95, 7)) * w:
        house(random, image, int(x), int(random.uniform(0.6, 0.72) * h), int(random.uniform(0.07, 0.13) * w))
    return np.asarray(np.clip(image, 0, 1), np.float32)


def house(random: Random, image: Image, left: int, bottom: int, width: int) -> None:
    """Draw a house front with windows into the image, in place."""
    top = bottom - int(width * random.uniform(0.8, 1.5))
    cv2.rectangle(image, (left, top), (left + width, bottom), some_colour(random, (0.1, 0.4), (0.6, 0.9)), -1)
    roof = np.array([[left - 6, top], [left + width // 2, top - width // 2], [left + width + 6, top]], np.int32)
    cv2.fillPoly(image, [roof], (0.45, random.uniform(0.18, 0.3), 0.16))
    pane = max(3, width // 7)
    rows, columns = range(top + pane, bottom - pane, 2 * pane), range(left + pane, left + width - pane, 2 * pane)
    for y, x in itertools.product(rows, columns):
        cv2.rectangle(image, (x, y), (x + pane, y + pane), (0.2, 0.25, random.uniform(0.25, 0.5)), -1)


def panelled(random: Random, shape: Shape, base: Colour, grid: tuple[int, int]) -> Image:
    """A door or cupboard front: wood with (rows, columns) raised panels, joints and handles."""
    image = np.ascontiguousarray(wood(random, shape, base))
    cells_y, cells_x = (np.linspace(0, n, g + 1).astype(int).tolist() for n, g in zip(shape, grid, strict=True))
    for (top, bottom), (left, right) in itertools.product(itertools.pairwise(cells_y), itertools.pairwise(cells_x)):
        cv2.rectangle(image, (left, top), (right, bottom), (0.08, 0.06, 0.05), 2)
        d = int(0.12 * min(bottom - top, right - left))
        a, b = (left + d, top + d), (right - d, bottom - d)
        cv2.rectangle(image, a, b, tuple(0.6 * c for c in base), 3)
        cv2.line(image, a, (b[0], a[1]), tuple(min(1.0, 1.3 * c) for c in base), 2)
        cv2.circle(image, (right - d // 2, (top + bottom) // 2), max(3, d // 4), (0.75, 0.7, 0.55), -1)
    return image


def clock_face(shape: Shape) -> Image:
    """A wall clock at ten past ten."""
    image = plain(shape, (0.93, 0.92, 0.88))
    centre, radius = np.array(shape[::-1]) / 2, min(shape) / 2
    rim = (centre.astype(int).tolist(), int(0.97 * radius), (0.1, 0.1, 0.12), int(0.07 * radius))
    cv2.circle(image, *rim, cv2.LINE_AA)
    hours = [(hour / 12, 0.76, 0.88, 5 if hour % 3 == 0 else 2) for hour in range(12)]
    for turns, start, end, width in (*hours, (10.17 / 12, -0.1, 0.5, 6), (10 / 60, -0.1, 0.75, 4)):
        way = np.array([np.sin(2 * np.pi * turns), -np.cos(2 * np.pi * turns)]) * radius
        a, b = ((centre + s * way).astype(int).tolist() for s in (start, end))
        cv2.line(image, a, b, (0.08, 0.08, 0.1), width, cv2.LINE_AA)
    return image
