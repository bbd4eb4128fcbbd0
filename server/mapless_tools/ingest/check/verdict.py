"""The verdict on a scene's poses by epipolar errors: right, wrong as a whole and why, or single wrong ones.

Of common mistakes in poses or intrinsics, that is named which, if corrected, makes them fit. A correction converts a
pose as it was given to the intended one. If both world and camera are mirrored, a rotation is still a rotation, so
poses of left-handed engines pass all other checks.

A wrong unit changes no angle, but the depth of the photographed points.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapless.geometry import Array, Quaternion, RigidTransform
from mapless_server.method.scale import triangulate_depths
from mapless_server.method.views import PosedView

from .errors import THRESHOLD_PX, MatchedPair, PairError, Views, errors_of, summary, summary_with

Correction = Callable[[RigidTransform], RigidTransform]
ViewCorrection = Callable[[PosedView], PosedView]

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


def _posed(correction: Correction) -> ViewCorrection:
    return lambda view: replace(view, world_from_camera=correction(view.world_from_camera))


def _turned(quarters: int) -> ViewCorrection:
    """Correction of a photograph that was turned so often to the left, without its pose and its intrinsics."""

    def correct(view: PosedView) -> PosedView:
        camera = view.view.camera
        fx, fy, x, y = camera.focal_x_px, camera.focal_y_px, camera.principal_x_px, camera.principal_y_px
        sides_px = [camera.width_px, camera.height_px]
        for remaining in range(quarters, 0, -1):
            fx, fy, x, y = fy, fx, y, sides_px[remaining % 2] - 1 - x
        camera = replace(camera, focal_x_px=fx, focal_y_px=fy, principal_x_px=x, principal_y_px=y)
        pose = _turned_camera(np.linalg.matrix_power(_QUARTER, quarters))(view.world_from_camera)
        return replace(view, view=replace(view.view, camera=camera), world_from_camera=pose)

    return correct


_CORRECTIONS: Mapping[str, ViewCorrection] = {text: _posed(it) for text, it in CONVENTIONS.items()} | {
    f"poses and intrinsics are of images turned by {90 * it} degrees (EXIF orientation)": _turned(it)
    for it in (1, 2, 3)
}


@dataclass(frozen=True)
class Explanation:
    """A likely mistake, and the photographs that it concerns, if not all; without text there is none.

    `error_px` is the median error of the pairs after its correction.
    """

    text: str = ""
    error_px: float = math.nan
    photographs: tuple[int, ...] = ()


def explain(views: Views, matched: Sequence[MatchedPair], given_px: float) -> Explanation:
    """Finds the mistake whose correction makes the poses fit best; `given_px` is the median error without it."""
    matched = [MatchedPair(item.pair, item.matches[:: 1 + len(item.matches) // _ENOUGH_MATCHES]) for item in matched]
    candidates = []
    for text, correction in _CORRECTIONS.items():
        error_px, bad_share = summary_with(views, matched, correction)
        if bad_share < _BAD_SHARE:
            candidates.append(Explanation(text, error_px))
    for what, change in (("focal lengths are", _focal_scaled), ("focal lengths and principal points are", _scaled)):
        scale, error_px, bad_share = best_scale(views, matched, change)
        if abs(scale - 1) > FOCAL_TOLERANCE and FOCAL_SCALES[0] < scale < FOCAL_SCALES[-1] and bad_share < _BAD_SHARE:
            text = (
                f"the {what} {scale:.2f} times what is given (intrinsics of another image size, or of a video "
                "mode that crops?)"
            )
            candidates.append(Explanation(text, error_px))
    fitting = [candidate for candidate in candidates if candidate.error_px < _GAIN * given_px]
    if not fitting:  # perhaps it was made with some photographs only
        mixed = [_mixed(views, matched, text, correction) for text, correction in _CORRECTIONS.items()]
        fitting = [explanation for explanation in mixed if explanation.text]
    return min(fitting, key=lambda it: it.error_px, default=Explanation())


def best_scale(
    views: Views, matched: Sequence[MatchedPair], change: Callable[[PosedView, float], PosedView]
) -> tuple[float, float, float]:
    """The factor by which to `change` all views with the least median error; that error, and the share of bad pairs."""

    def summary_at(scale: float) -> tuple[float, float]:
        return summary_with(views, matched, lambda view: change(view, scale))

    scales = FOCAL_SCALES
    for _ in range(_REFINEMENTS):
        best = int(np.argmin([summary_at(scale)[0] for scale in scales]))
        low, high = scales[max(best - 1, 0)], scales[min(best + 1, len(scales) - 1)]
        scale = float(scales[best])
        scales = np.geomspace(low, high, 9)
    return scale, *summary_at(scale)


def _mixed(views: Views, matched: Sequence[MatchedPair], text: str, correction: ViewCorrection) -> Explanation:
    """Explains pairs by correcting either, both or none of their photographs; empty if that does not fit."""
    turned = {i: correction(view) for i, view in views.items()}
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


def _focal_scaled(view: PosedView, scale: float) -> PosedView:
    camera = view.view.camera
    scaled = replace(camera, focal_x_px=scale * camera.focal_x_px, focal_y_px=scale * camera.focal_y_px)
    return replace(view, view=replace(view.view, camera=scaled))


def _scaled(view: PosedView, scale: float) -> PosedView:
    camera = _focal_scaled(view, scale).view.camera
    scaled = replace(camera, principal_x_px=scale * camera.principal_x_px, principal_y_px=scale * camera.principal_y_px)
    return replace(view, view=replace(view.view, camera=scaled))


MIN_PARALLAX_DEG = 1.0
"""Of rays that are intersected: at a pixel's error a fiftieth of the depth, or so."""
MIN_POINTS = 100
"""Fewer give no typical depth."""
MIN_DEPTH_M, MAX_DEPTH_M = 0.05, 500.0
"""Typical depths of photographs of places are 0.3 to 300 m. Those in millimetres come out a thousand times as large, in
kilometres as small."""


def median_depth(views: Views, matched: Sequence[MatchedPair]) -> float | None:
    """Median depth of points that pairs of photographs show, in the unit of the poses; None if there are too few."""
    depths = []
    for item in matched:
        centre, ray = [], []
        for side, index in enumerate(item.pair):
            posed = views[index]
            rays = posed.view.camera.rays(posed.view.features.keypoints[item.matches[:, side]])
            centre.append(np.broadcast_to(posed.world_from_camera.translation, rays.shape))
            ray.append(rays @ posed.world_from_camera.rotation.T)
        depth, parallax_deg = triangulate_depths(np.stack(centre, axis=1), np.stack(ray, axis=1))
        depths.append(depth[(depth > 0).all(axis=1) & (parallax_deg >= MIN_PARALLAX_DEG)].ravel())
    found = np.concatenate(depths) if depths else np.zeros(0)
    return float(np.median(found)) if len(found) >= 2 * MIN_POINTS else None


def implausible_depth(depth: float | None) -> str:
    """One sentence about a median depth that is not plausible in metres; empty if it is plausible."""
    if depth is None or MIN_DEPTH_M <= depth <= MAX_DEPTH_M:
        return ""
    likely = "millimetres" if depth > MAX_DEPTH_M else "kilometres"
    return (
        f"what the photographs show is {depth:.3g} m away, in the median ({MIN_DEPTH_M:g} to {MAX_DEPTH_M:g} m are "
        f"plausible): are the poses in {likely}?"
    )


_WRONG_SHARE = 0.4  # more bad pairs than one photograph in five could make
_SUSPECT_SHARE = 0.6
_SUSPECT_PAIRS = 2


@dataclass(frozen=True)
class Verdict:
    """The verdict on all pairs; medians and shares are NaN without pairs.

    Suspects do not fit their neighbours although the scene as a whole does; or they are what the explanation concerns,
    if not all. The explanation is the likely mistake if the scene as a whole is wrong, `explained_px` the median error
    after its correction. The median depth of photographed points is in the unit of the poses; None if unknown, or the
    scene is wrong.
    """

    pairs: tuple[PairError, ...]
    unmatched_count: int
    median_px: float
    bad_share: float
    threshold_px: float
    suspects: tuple[int, ...] = ()
    explanation: str = ""
    explained_px: float = math.nan
    median_depth: float | None = None

    @property
    def is_known(self) -> bool:
        """Whether there were any pairs to judge by."""
        return bool(self.pairs)

    @property
    def is_wrong(self) -> bool:
        """Whether the scene as a whole does not fit: more pairs are bad than single photographs can explain."""
        return self.is_known and self.bad_share > _WRONG_SHARE


def judge(views: Views, matched: Sequence[MatchedPair], unmatched_count: int = 0) -> Verdict:
    """Judges the matched pairs; `unmatched_count` pairs have too few matches."""
    errors = errors_of(views, matched)
    if not errors:
        return Verdict((), unmatched_count, math.nan, math.nan, THRESHOLD_PX)
    median_px, bad_share = summary(errors)
    threshold_px = float(np.median([error.threshold_px for error in errors]))
    verdict = Verdict(tuple(errors), unmatched_count, median_px, bad_share, threshold_px)
    if verdict.is_wrong:
        found = explain(views, matched, median_px)
        verdict = replace(verdict, explanation=found.text, explained_px=found.error_px, suspects=found.photographs)
    else:
        verdict = replace(verdict, median_depth=median_depth(views, matched))
    return verdict if verdict.explanation else replace(verdict, suspects=suspects_of(errors))


def suspects_of(errors: Sequence[PairError]) -> tuple[int, ...]:
    """Photographs almost all of whose pairs are bad, the worst first; its pairs then do not count against others."""
    left = list(errors)
    suspects: list[int] = []
    while True:
        total = Counter(i for error in left for i in error.pair)
        bad = Counter(i for error in left if error.is_bad for i in error.pair)
        doubtful = [i for i in bad if bad[i] >= _SUSPECT_PAIRS and bad[i] >= _SUSPECT_SHARE * total[i]]
        if not doubtful:
            return tuple(suspects)
        worst = max(doubtful, key=lambda i: (bad[i] / total[i], bad[i], -i))
        suspects.append(worst)
        left = [error for error in left if worst not in error.pair]
