"""Finds which common mistake in poses or intrinsics, if corrected, makes them fit.

A correction converts a pose as it was given to the intended one. If both world and camera are mirrored, a rotation is
still a rotation, so poses of left-handed engines pass all other checks.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapless.geometry import Array, Quaternion, RigidTransform
from mapless_server.method.views import PosedView

from .errors import MatchedPair, PairError, Views, errors_of, summary, summary_with

Correction = Callable[[RigidTransform], RigidTransform]

FOCAL_SCALES = np.geomspace(0.2, 5.0, 33)
"""Wrong image sizes are usually wrong by a factor of up to four."""
FOCAL_TOLERANCE = 0.03
"""A focal length that would have to change by less is not the reason."""

_GAIN = 0.4  # an explanation must reduce the error to this share, or it explains nothing
_BAD_SHARE = 0.5  # of the pairs, that may stay bad
_MIXED_BAD_SHARE = 0.2  # stricter, because each pair is given the choice of which of its two to correct
_REFINEMENTS = 3
_ENOUGH_MATCHES = 64  # for a median that distinguishes mistakes


def _turned_camera(rotation: Array) -> Correction:
    return lambda pose: RigidTransform(pose.rotation @ rotation, pose.translation)


def _mirrored(pose: RigidTransform) -> RigidTransform:
    mirror = np.diag([1.0, -1.0, 1.0])
    return RigidTransform(mirror @ pose.rotation @ mirror, mirror @ pose.translation)


def _reordered(order: tuple[int, int, int, int]) -> Correction:
    """The correction for a quaternion (x, y, z, w) whose parts were read in a wrong order."""

    def correct(pose: RigidTransform) -> RigidTransform:
        q = pose.quaternion()
        parts = (q.x, q.y, q.z, q.w)
        return RigidTransform(Quaternion(*(parts[i] for i in order)).matrix(), pose.translation)

    return correct


def _within_inverse(correction: Correction) -> Correction:
    """Applies a correction to the inverse of a pose, camera_from_world."""
    return lambda pose: correction(pose.inverse()).inverse()


_OPENGL = _turned_camera(np.diag([1.0, -1.0, -1.0]))
_QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_W_FIRST = _reordered((1, 2, 3, 0))
_W_LAST = _reordered((3, 0, 1, 2))

CONVENTIONS: Mapping[str, Correction] = {
    "the camera axes are OpenGL's (x right, y up, z back) where the format has OpenCV's, or the reverse": _OPENGL,
    "the poses are camera_from_world, not world_from_camera": RigidTransform.inverse,
    "the poses are camera_from_world with OpenGL's camera axes": lambda pose: _OPENGL(pose.inverse()),
    "the quaternions are w x y z and were read as x y z w": _W_FIRST,
    "the quaternions are x y z w and were read as w x y z": _W_LAST,
    "the quaternions of camera_from_world are w x y z and were read as x y z w": _within_inverse(_W_FIRST),
    "the quaternions of camera_from_world are x y z w and were read as w x y z": _within_inverse(_W_LAST),
    "the poses are of images turned by 90 degrees (EXIF orientation)": _turned_camera(_QUARTER),
    "the poses are of images turned by 180 degrees (EXIF orientation)": _turned_camera(_QUARTER @ _QUARTER),
    "the poses are of images turned by 270 degrees (EXIF orientation)": _turned_camera(_QUARTER.T),
    "the axes are left-handed (y up, as in Unity)": _mirrored,
}
"""Corrections by what the report says of the mistake."""


@dataclass(frozen=True)
class Explanation:
    """A likely mistake, and the photographs that it concerns, if not all; without text there is none.

    `error_px` is the median error of the pairs after its correction.
    """

    text: str = ""
    error_px: float = math.nan
    photographs: tuple[int, ...] = ()


def explain(views: Views, matched: Sequence[MatchedPair], given_px: float) -> Explanation:
    """Finds the mistake whose correction makes the poses fit best.

    `given_px` is the median error without correction.
    """
    matched = [MatchedPair(item.pair, item.matches[:: 1 + len(item.matches) // _ENOUGH_MATCHES]) for item in matched]
    candidates = []
    for text, correction in CONVENTIONS.items():
        error_px, bad_share = summary_with(views, matched, lambda view, c=correction: _corrected(view, c))  # type: ignore[misc]
        if bad_share < _BAD_SHARE:
            candidates.append(Explanation(text, error_px))
    scale, error_px, bad_share = best_focal_scale(views, matched)
    if abs(scale - 1) > FOCAL_TOLERANCE and FOCAL_SCALES[0] < scale < FOCAL_SCALES[-1] and bad_share < _BAD_SHARE:
        text = (
            f"the focal lengths are {scale:.2f} times what is given (intrinsics of another image size, or of a video "
            "mode that crops?)"
        )
        candidates.append(Explanation(text, error_px))
    fitting = [candidate for candidate in candidates if candidate.error_px < _GAIN * given_px]
    if not fitting:  # perhaps it was made with some photographs only
        mixed = [_mixed(views, matched, text, correction) for text, correction in CONVENTIONS.items()]
        fitting = [explanation for explanation in mixed if explanation.text]
    return min(fitting, key=lambda it: it.error_px, default=Explanation())


def best_focal_scale(views: Views, matched: Sequence[MatchedPair]) -> tuple[float, float, float]:
    """The factor on all focal lengths with the least median error; that error, and the share of bad pairs with it."""

    def summary_at(scale: float) -> tuple[float, float]:
        return summary_with(views, matched, lambda view: _focal_scaled(view, scale))

    scales = FOCAL_SCALES
    for _ in range(_REFINEMENTS):
        best = int(np.argmin([summary_at(scale)[0] for scale in scales]))
        low, high = scales[max(best - 1, 0)], scales[min(best + 1, len(scales) - 1)]
        scale = float(scales[best])
        scales = np.geomspace(low, high, 9)
    return scale, *summary_at(scale)


def _mixed(views: Views, matched: Sequence[MatchedPair], text: str, correction: Correction) -> Explanation:
    """Explains pairs by correcting either, both or none of their photographs; empty if that does not fit."""
    turned = {i: _corrected(view, correction) for i, view in views.items()}
    best: list[PairError] = []
    votes: Counter[int] = Counter()
    for item in matched:
        choices = [
            (error, chosen)
            for chosen in ((), item.pair[:1], item.pair[1:], item.pair)
            for error in errors_of({i: (turned if i in chosen else views)[i] for i in item.pair}, [item])
        ]
        if choices:
            error, chosen = min(choices, key=lambda choice: choice[0].error_px)
            best.append(error)
            for i in item.pair:
                votes[i] += 1 if i in chosen else -1
    error_px, bad_share = summary(best)
    concerned = tuple(sorted(i for i, count in votes.items() if count > 0))
    if bad_share >= _MIXED_BAD_SHARE or not concerned:
        return Explanation()
    return Explanation(f"with some photographs, not all, {text}", error_px, concerned)


def _corrected(view: PosedView, correction: Correction) -> PosedView:
    return replace(view, world_from_camera=correction(view.world_from_camera))


def _focal_scaled(view: PosedView, scale: float) -> PosedView:
    camera = view.view.camera
    scaled = replace(camera, focal_x_px=scale * camera.focal_x_px, focal_y_px=scale * camera.focal_y_px)
    return replace(view, view=replace(view.view, camera=scaled))
