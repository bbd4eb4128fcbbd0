"""Points that queries and references have shown so far; of those near one another, one."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from .drawing import Drawing

MAX_POINTS = 150_000
_VOXEL_SHARE, _POINT_SHARE = 0.002, 0.004
"""Shares of the scene's extent: points nearer than this to one another are shown as one; and how large one is."""


class Cloud:
    """Points of one kind, drawn under one name."""

    def __init__(self, drawing: Drawing, name: str, extent_m: float) -> None:
        self._drawing, self._name, self._extent_m = drawing, name, extent_m
        self._points: dict[bytes, tuple[Array, NDArray[np.uint8]]] = {}
        self._drawn: Any = None

    def add(self, placed: Array, colours: NDArray[np.uint8], visible: bool) -> None:
        """Adds points (N, 3), already in the scenery's place, with colours (N, 3)."""
        cells = np.round(placed / (_VOXEL_SHARE * self._extent_m)).astype(np.int64)
        before = len(self._points)
        for cell, point, colour in zip(cells, placed, colours, strict=True):
            if len(self._points) < MAX_POINTS:
                self._points.setdefault(cell.tobytes(), (point, colour))
        if len(self._points) == before:
            return
        points, all_colours = (np.stack(it) for it in zip(*self._points.values(), strict=True))
        self._drawn = self._drawing.points(self._name, points, all_colours, _POINT_SHARE * self._extent_m, visible)

    def show(self, visible: bool) -> None:
        """Shows or hides them."""
        if self._drawn is not None:
            self._drawn.visible = visible
