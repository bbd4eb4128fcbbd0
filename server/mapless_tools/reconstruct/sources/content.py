"""The content of a video along its frames: a number that grows by one with each view that shows something else.

A view is another one when the camera shows too little of the last one, or shows it moved by too much. Frames that are
blurred beside those before them do not decide, nor do those that show nothing.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .tracks import MIN_CORNERS, Reference

_LOST_SHARE = 0.3
"""Share of the corners of a view; that many of them no longer seen make another view. Two views that share 70 % of
what they show have common points with three or more of their neighbours."""
_MOTION = 0.08
"""Share of the diagonal; this much median motion makes another view, even if all is still seen, as when walking
forward."""
_BLURRED, _SHARP_PERCENT = 0.5, 75
"""A frame is blurred if it is half as sharp as the sharper quarter of those before it, of which half may be blurred."""
_RECENT = 15
_MAX_WAIT = 15
"""Frames that may be blurred or show nothing before they count."""
_TRACKED, _UNTRACKED = 0.5, 0.1


@dataclass(frozen=True)
class Cut:
    """The number of the first frame, of those that were added, of another scene."""

    position: int


class Content:
    """Measures the content of frames that are added in their order."""

    def __init__(self) -> None:
        self.cuts: list[Cut] = []
        self._reference: Reference | None = None
        self._views = 0
        self._progress = 0.0
        self._recent: deque[float] = deque(maxlen=_RECENT)
        self._waited = 0
        self._share = 1.0
        self._loss: int | None = None
        self._unsure_cut: int | None = None
        self._count = 0

    def add(self, grey: NDArray[np.uint8], sharpness: float) -> float:
        """Takes the next small frame in grey (H, W), and returns its content."""
        position, self._count = self._count, self._count + 1
        if self._reference is None:
            self._begin(grey)
        else:
            self._compare(self._reference, grey, sharpness, position)
        self._recent.append(sharpness)
        return self._views + self._progress

    def _begin(self, grey: NDArray[np.uint8]) -> bool:
        """Makes a frame the one that later frames are compared with; False if it shows nothing."""
        reference = Reference(grey)
        if reference.corner_count < MIN_CORNERS:
            return False
        self._reference, self._progress, self._share, self._waited, self._loss = reference, 0.0, 1.0, 0, None
        return True

    def _compare(self, reference: Reference, grey: NDArray[np.uint8], sharpness: float, position: int) -> None:
        seen = reference.seen_in(grey)
        if self._unsure_cut is not None:
            if seen.share >= _TRACKED:
                self.cuts.append(Cut(self._unsure_cut))
            self._unsure_cut = None
        if seen.share >= _UNTRACKED:
            self._loss = None
        elif self._loss is None and self._share >= _TRACKED:
            self._loss = position
        self._share = seen.share
        progress = max((1 - seen.share) / _LOST_SHARE, seen.motion / _MOTION)
        is_blurred = sharpness < _BLURRED * float(np.percentile(self._recent, _SHARP_PERCENT))
        if is_blurred and self._waited < _MAX_WAIT:
            self._waited += 1
        elif progress < 1:
            self._waited, self._progress = 0, max(self._progress, progress)
        else:
            loss = self._loss
            if self._begin(grey):
                self._views, self._unsure_cut = self._views + 1, loss
