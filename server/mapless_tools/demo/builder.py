"""Puts a room together from boxes, prisms and panels, each a few textured rectangles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Concatenate, ParamSpec

import numpy as np
from numpy.typing import ArrayLike

from mapless.geometry import Array

from .light import Box
from .raycast import Quad
from .textures import Image, Shape

LOWEST_EYE_M = 0.85
"""No camera is lower: what looks down from below this height is never seen, and is left out."""

FACES = {
    "front": ((0, 0, 1), (1, 0, 0), (0, 0, -1)),
    "right": ((1, 0, 1), (0, 1, 0), (0, 0, -1)),
    "back": ((1, 1, 1), (-1, 0, 0), (0, 0, -1)),
    "left": ((0, 1, 1), (0, -1, 0), (0, 0, -1)),
    "top": ((0, 1, 1), (1, 0, 0), (0, -1, 0)),
    "bottom": ((0, 0, 0), (1, 0, 0), (0, 1, 0)),
}
"""Where the texture of a box's face begins, and its rows and columns, as shares of the box; the front looks to -y."""

Texture = Callable[[Shape], Image]
"""Makes a texture of a size in texels."""

Options = ParamSpec("Options")


@dataclass(eq=False)
class Room:
    """A room being furnished.

    Attributes:
        random: source of everything that varies.
        quads: all rectangles, those of the boxes included.
        boxes: all solids, for light and for keeping cameras out.
        outline: (2, 3) each, edges worth drawing: the room's own and those of the larger furniture.
    """

    random: np.random.Generator
    quads: list[Quad] = field(default_factory=list)
    boxes: list[Box] = field(default_factory=list)
    outline: list[Array] = field(default_factory=list)

    def surface(
        self,
        texture: Callable[Concatenate[np.random.Generator, Shape, Options], Image],
        *args: Options.args,
        **kwargs: Options.kwargs,
    ) -> Texture:
        """One of `textures`, drawn with the room's randomness."""
        return lambda shape: texture(self.random, shape, *args, **kwargs)

    def box(
        self,
        low: ArrayLike,
        size: ArrayLike,
        texture: Texture,
        *,
        faces: Mapping[str, Texture | None] | None = None,
        yaw_deg: float = 0.0,
        about: ArrayLike | None = None,
        texels_per_m: float = 650,
        draw: bool = False,
    ) -> None:
        """Put an upright box.

        Args:
            low: (3,) its low corner before it is turned, world, metres.
            size: (3,) metres.
            texture: of all faces but those named in
            faces: None for one that stands against something and is never seen.
            yaw_deg: how far it is turned, seen from above counter-clockwise.
            about: (x, y) it is turned about; None for its own middle.
            texels_per_m: detail of the textures.
            draw: whether its edges are worth drawing.
        """
        low, size = np.asarray(low, float), np.asarray(size, float)
        faces = faces or {}
        turn = Box(np.zeros(3), size, np.radians(yaw_deg)).world_from_box()
        pivot = low + size / 2 if about is None else np.append(np.asarray(about, float), 0.0)
        for face, (corner, columns, rows) in FACES.items():
            make = faces.get(face, texture)
            if make is None or (face == "bottom" and low[2] < LOWEST_EYE_M):
                continue
            across, down = turn @ (size * columns), turn @ (size * rows)
            image = make(texels(down, across, texels_per_m))
            self.quads.append(
                Quad(pivot + turn @ (low + size * corner - pivot), across, down, image, owner=len(self.boxes))
            )
        self.boxes.append(Box(pivot + turn @ (low + size / 2 - pivot), size, np.radians(yaw_deg)))
        if draw:
            self.outline.extend(self.boxes[-1].edges())

    def prism(self, base: ArrayLike, radius: float, height: float, side: Image, top: Image, sides: int = 14) -> None:
        """Put an upright prism, nearly a cylinder, on `base` (3,); `side` is wrapped around it."""
        x, y, z = np.asarray(base, float)
        angles = np.linspace(0, 2 * np.pi, sides + 1)
        ring = np.stack(
            [x + radius * np.cos(angles), y + radius * np.sin(angles), np.full(sides + 1, z + height)], axis=-1
        )
        cuts = np.linspace(0, side.shape[1], sides + 1).astype(int)
        owner = len(self.boxes)
        for i in range(sides):
            strip = np.ascontiguousarray(side[:, cuts[i] : cuts[i + 1]])
            self.quads.append(Quad(ring[i], ring[i + 1] - ring[i], np.array([0.0, 0.0, -height]), strip, owner=owner))
        corner = np.array([x - radius, y + radius, z + height])
        across, down = np.array([2 * radius, 0, 0]), np.array([0, -2 * radius, 0.0])
        self.quads.append(Quad(corner, across, down, top, is_round=True, owner=owner))
        self.boxes.append(Box(np.array([x, y, z + height / 2]), np.array([1.8 * radius, 1.8 * radius, height])))

    def panel(
        self,
        corner: ArrayLike,
        across: ArrayLike,
        down: ArrayLike,
        texture: Image,
        *,
        is_round: bool = False,
        glows: bool = False,
    ) -> None:
        """Put a single rectangle, or the ellipse in it."""
        corner, across, down = (np.asarray(a, float) for a in (corner, across, down))
        self.quads.append(Quad(corner, across, down, texture, is_round=is_round, glows=glows))


def texels(down: ArrayLike, across: ArrayLike, texels_per_m: float) -> Shape:
    """Size of a texture for a rectangle."""
    h, w = (int(np.clip(round(float(np.linalg.norm(edge)) * texels_per_m), 6, 2400)) for edge in (down, across))
    return h, w
