"""Comparison of a photograph's camera with others, by the poses that explain its matches.

Half or double the focal length, or a wide lens whose distortion is left out, are too far off for the linear check
(`judge.intrinsics`): a pose then fits a part of the matches, at similar depths or near the centre, and these do not
contradict it. But far more of all matches agree with one pose of a camera that is nearer to the true one. So poses are
computed with other focal lengths, other values of k1, without the lens, and, where these are unusual, with the
principal point in the centre and with square pixels; the score of `pose.relative` compares them, by points and by
matches without points together.

A camera is accused only if that is significant (`significance`): if the keypoints that score higher with another
camera outweigh those that score lower by more than chance, with the best poses of both cameras that are found from all
matches. A pose that is explained clearly worse than one of another camera is rejected also where that is not
significant, for lack of evidence.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform
from mapless.lenses import Distortion, Fisheye

from ..bundle.adjust import LEAST_MATCHES
from ..bundle.estimate import PosedSupport, Support
from ..bundle.intrinsics import corrected, read_as
from ..bundle.priors import IntrinsicsSigma
from ..features.views import View
from ..pose import pnp
from ..pose.pnp import PnpOptions, ransac
from ..pose.relative import Evidence, RelativePoseOptions, find_pose, scores_by_keypoint
from ..pose.two_view_matches import TwoViewMatches
from ..rejection import Advice, Hint, IntrinsicsCheck, IntrinsicsParameter, Rejection, RejectionReason
from ..significance import is_significant, sigmas_of_gains
from .intrinsics import advice_for, checked_parameters, checks_of

MANY_MATCHES = 100
"""So many matches are not by chance: a reference shows what the photograph shows, and with points another camera needs
to score less, see `MIN_GAIN`."""

MIN_GAIN, LARGE_SHARE, MIN_GAIN_ELSE = 1.1, 0.45, 1.2
"""A pose is rejected if one of another camera scores this many times as high, where there are many matches with points
and no large share of them agrees with the pose; else if it scores 1.2 times as high. A pose that a large share agrees
with is as right as its radii say, though its camera be a little wrong. Evidence: other-cameras."""

MAX_LINES = 1500
"""Most matches with references that are compared: of more, those of every second keypoint, or fewer."""

UNUSUAL_PRINCIPAL_SHARE, UNUSUAL_ASPECT = 0.1, 0.03
"""Distance of the principal point from the centre, as a share of the width, from which the centre is tried too; share
by which both focal lengths differ, from which square pixels are tried too."""

PNP = PnpOptions(min_iterations=30, max_iterations=300, max_matches=300)
"""RANSAC of the poses by points. Few matches suffice to compare cameras."""

LINES = RelativePoseOptions(min_iterations=50, max_iterations=150, pair_iterations=200, strongest=1)
"""The search by all matches: of each camera where the pose rests on matches without points, 20 to 40 ms; of two cameras
before one is accused by points, whose own search takes longer."""


@dataclass(frozen=True)
class _Steps:
    """Other cameras that are tried: so many focal lengths, and values of k1 (`lens`), on either side of those given.

    There are `per_octave` focal lengths from one to its double. A value of k1 moves the image's corner by `bend`, a
    share of its distance from the principal point, against the next.
    """

    focal: int
    per_octave: int
    lens: int
    bend: float


BY_POINTS, BY_LINES = _Steps(5, 4, 3, 0.08), _Steps(2, 2, 1, 0.16)
"""Coarse enough to miss no camera, and coarser where each takes longer."""


@dataclass(frozen=True, eq=False)
class ScoredCamera:
    """A camera with the best pose that was found, None if none was, and its scores (F,) by keypoint."""

    camera: Camera
    pose: RigidTransform | None
    scores: Array

    @staticmethod
    def of(camera: Camera, matches: Evidence, pose: RigidTransform | None) -> "ScoredCamera":
        """The camera with the scores of a pose by the matches of the photograph as read with it."""
        none = np.zeros(len(matches.query.features))
        return ScoredCamera(camera, pose, none if pose is None else scores_by_keypoint(matches, pose))

    @property
    def total(self) -> float:
        """Sum of the scores."""
        return float(self.scores.sum())


@dataclass(frozen=True, eq=False)
class _Compared:
    """The matches that cameras are compared by: those of the whole image with points, and those with references.

    They are of every `step`-th keypoint, and so are the views: reading these with other lenses takes long.
    """

    support: Support
    by_lines: bool
    step: int
    lines: TwoViewMatches
    x_in_world: Array
    keypoint: NDArray[np.intp]

    @staticmethod
    def of(support: Support, by_lines: bool) -> "_Compared":
        matches, lines = support.matches, TwoViewMatches.of(support.query, support.references, support.query_matches)
        step = 1 + len(lines) // MAX_LINES
        used = np.flatnonzero(~matches.guided & (matches.keypoint % step == 0))
        points = support.structure.x_in_world[matches.point[used]]
        lines = lines[lines.keypoint % step == 0]
        lines = replace(lines, keypoint=lines.keypoint // step)
        return _Compared(support, by_lines, step, lines, points, matches.keypoint[used] // step)

    def thinned(self, view: View) -> View:
        """A view of the photograph with every `step`-th keypoint."""
        return replace(view, features=view.features.every(self.step))

    def own(self, given: Camera) -> ScoredCamera:
        """The given camera with its best pose: the estimate, or another one."""
        found = list[ScoredCamera]()
        if isinstance(self.support, PosedSupport):
            estimate = self.support.estimate
            # The estimate's own intrinsics are those that were estimated with it, within what the caller allows.
            view = self.thinned(estimate.view or self.support.query)
            found.append(ScoredCamera.of(given, self.matches_of(view), estimate.world_from_camera))
        if not self.by_lines:
            found.append(self.scored(given))
        return max(found, key=lambda it: it.total)

    def scored(self, camera: Camera) -> ScoredCamera:
        """A camera with the best pose that a brief search finds, comparable with that of the given camera."""
        matches = self.matches_of(self.read_as(camera))
        pose = None
        if self.by_lines:
            pose = find_pose(matches, LINES)
        elif len(matches.x_in_world) >= pnp.MIN_MATCHES:  # through a strong lens few may be seen
            pose = ransac(matches.points, None, PNP)
        found = ScoredCamera.of(camera, matches, pose)
        # Without points a wrong lens can reach the right camera's score more nearly than a wrong focal length.
        is_bent = self.by_lines and camera.distortion != self.support.query.distortion
        return replace(found, scores=found.scores / MIN_GAIN) if is_bent else found

    def searched(self, before: ScoredCamera, other: ScoredCamera) -> ScoredCamera:
        """A camera with the best of three poses: as before, the other camera's, and one found from all matches.

        The search by points alone fails where few of them are right. Two cameras then differ by whether it failed.
        It takes 0.1 to 0.3 s, only where an accusation would follow. A third camera, whose search failed as well, is
        not found by it: no camera is accused then.
        """
        matches = self.matches_of(self.read_as(before.camera))
        poses = (other.pose, find_pose(matches, LINES))
        return max([before, *(ScoredCamera.of(before.camera, matches, it) for it in poses)], key=lambda it: it.total)

    def read_as(self, camera: Camera) -> View:
        """The photograph as read with a camera, with every `step`-th keypoint."""
        return read_as(self.thinned(self.support.query), camera)

    def matches_of(self, view: View) -> Evidence:
        """The matches of a thinned view whose keypoints its camera sees."""
        is_seen = np.asarray(np.isfinite(view.features.keypoints).all(axis=1))
        points, keypoint, lines = self.x_in_world, self.keypoint, self.lines.read_as(view)
        if not is_seen.all():
            points, keypoint = points[is_seen[keypoint]], keypoint[is_seen[keypoint]]
            lines = lines[is_seen[lines.keypoint]]
        return Evidence(view, self.support.references, lines, points, keypoint)


@dataclass(frozen=True, eq=False)
class Comparison:
    """The given camera and the best of the others.

    Attributes:
        gain: ratio of the other's score to that of the photograph's pose.
        sigmas, tested: gain of the other, keypoint by keypoint, in standard deviations, each with its best pose by all
            matches where it is significant without; number of cameras compared.
        checks: the parameters in which the two differ, in conflict.
        lens: lens of the given camera.
    """

    gain: float
    sigmas: float
    tested: int
    checks: tuple[IntrinsicsCheck, ...]
    lens: Distortion | None

    @property
    def is_significant(self) -> bool:
        """Whether the given camera is accused."""
        return is_significant(self.sigmas, self.tested)

    @property
    def named(self) -> str:
        """The other camera, in words."""
        return ", ".join(map(_difference, self.checks))

    @property
    def advice(self) -> str:
        """The parameters to check, in words."""
        return advice_for(self.lens, self.checks)


def compare_cameras(support: Support) -> Comparison | None:
    """Compares the photograph's camera with others by all of its matches; None if there are too few, or no others."""
    by_lines = isinstance(support, PosedSupport) and support.two_view is not None
    if not by_lines and int((~support.matches.guided).sum()) < LEAST_MATCHES:
        return None
    query, steps = support.query, BY_LINES if by_lines else BY_POINTS
    prior_sigma = (support.intrinsics_sigma or IntrinsicsSigma()).of(query.camera)
    given = replace(query.camera, distortion=query.distortion)
    others = list(_other_cameras(given, prior_sigma, steps))
    if not others:
        return None
    compared = _Compared.of(support, by_lines)
    best, tested = max(map(compared.scored, others), key=lambda it: it.total), len(others)
    own = compared.own(given)
    if not by_lines:
        between = _between(given, best.camera, steps)
        best, tested = max([best, *map(compared.scored, between)], key=lambda it: it.total), tested + len(between)
    sent = query.photograph.camera if query.photograph else given
    checks = _differences(sent, prior_sigma, given, best.camera, steps)
    gain = best.total / own.total if own.total > 0 else np.inf if best.total > 0 else 0.0
    sigmas = sigmas_of_gains(best.scores - own.scores)
    if not by_lines and is_significant(sigmas, tested):
        found, searched = compared.searched(best, own), compared.searched(own, best)
        sigmas = sigmas_of_gains(found.scores - searched.scores)
    return Comparison(float(gain), sigmas, tested, checks, sent.distortion)


def wrong_camera(support: PosedSupport, best_reference: str) -> Rejection | None:
    """A rejection if a pose of another camera scores clearly higher; it names the camera if that is significant.

    A pose that rests on matches without points is compared with few cameras by a brief search.
    """
    by_lines, found = support.two_view is not None, compare_cameras(support)
    if found is None:
        return None
    inliers, least = support.estimate.inliers, 1.0
    if not by_lines:
        count = int((~support.matches.guided).sum())
        least = MIN_GAIN if count >= MANY_MATCHES and inliers.mean() < LARGE_SHARE else MIN_GAIN_ELSE
    if found.gain < least:
        return None
    agreeing = f"{inliers.sum()} of {len(inliers)} matches agree with the pose"
    if not found.is_significant:
        few = "its matches with single references" if by_lines else agreeing
        return Rejection(RejectionReason.GATE, f"{few}: too few to tell it from others that explain as much")
    message = f"{agreeing}; all together fit one of {found.named} better"
    if by_lines:  # the matches with points may be none
        message = f"its matches agree better with a pose of {found.named}"
    hint = Hint("judge", Advice.CHECK_CALIBRATION, found.advice, best_reference)
    return Rejection(RejectionReason.GATE, message, hint, intrinsics_checks=found.checks)


def _difference(check: IntrinsicsCheck) -> str:
    digits = 2 if check.parameter is IntrinsicsParameter.K1 else 0
    return f"{check.parameter.field} {check.estimated:.{digits}f} instead of {check.given:.{digits}f}"


def _other_cameras(given: Camera, prior_sigma: Array, steps: _Steps) -> Iterator[Camera]:
    """Cameras that the given one may be mistaken for, none of them within three standard deviations (4,) of it."""
    x, y = (given.width_px - 1) / 2, (given.height_px - 1) / 2
    bases = [given]
    if np.hypot(given.principal_x_px - x, given.principal_y_px - y) > UNUSUAL_PRINCIPAL_SHARE * given.width_px:
        bases.append(replace(given, principal_x_px=x, principal_y_px=y))
    if abs(np.log(given.focal_x_px / given.focal_y_px)) > UNUSUAL_ASPECT:
        bases += [replace(base, focal_x_px=base.focal_y_px) for base in bases]
    for base in bases:
        for step in range(-steps.focal, steps.focal + 1):
            log_factor = np.log(2) * step / steps.per_octave
            if abs(log_factor) > 3 * prior_sigma[0] or (step == 0 and base is not given):
                yield _scaled(base, float(np.exp(log_factor)))
    lenses = [given.pinhole() if given.distortion else replace(given, distortion=Fisheye())]
    lenses += [_bent(given, step * _k1_step(given, steps)) for step in range(-steps.lens, steps.lens + 1)]
    yield from (it for it in lenses if abs(_bend(it) - _bend(given)) > 3 * prior_sigma[3])


def _between(given: Camera, best: Camera, steps: _Steps) -> tuple[Camera, Camera]:
    """Half a step to both sides of the best camera."""
    if best.distortion != given.distortion:
        k1 = _k1_step(given, steps) / 2
        return _bent(best, -k1), _bent(best, k1)
    factor = 2 ** (0.5 / steps.per_octave)
    return _scaled(best, 1 / factor), _scaled(best, factor)


def _scaled(camera: Camera, factor: float) -> Camera:
    return replace(camera, focal_x_px=factor * camera.focal_x_px, focal_y_px=factor * camera.focal_y_px)


def _bent(camera: Camera, k1: float) -> Camera:
    return corrected(camera, (0.0, 0.0, 0.0, k1))


def _k1_step(camera: Camera, steps: _Steps) -> float:
    """The difference of k1 of one step: the narrower the lens, the larger."""
    x, y = camera.principal_x_px, camera.principal_y_px
    corner_px = np.hypot(max(x, camera.width_px - 1 - x), max(y, camera.height_px - 1 - y))
    return float(steps.bend * (camera.focal_x_px / corner_px) ** 2)


def _bend(camera: Camera) -> float:
    """The factor of r^3 in the distance at which the lens shows a ray of slope r."""
    return 0.0 if camera.distortion is None else camera.distortion.cubic


def _differences(
    sent: Camera, prior_sigma: Array, given: Camera, found: Camera, steps: _Steps
) -> tuple[IntrinsicsCheck, ...]:
    """The parameters that differ, in pixels of the photograph as sent; standard deviations are those of the steps."""
    scale, uniform = sent.width_px / found.width_px, 1 / np.sqrt(12)
    of_sent, centre_sigma_px = checked_parameters(sent), sent.width_px / 20
    before, after = (
        np.array([it.focal_x_px, it.principal_x_px, it.principal_y_px, _bend(it)]) for it in (given, found)
    )
    focal_sigma_px = scale * found.focal_x_px * np.log(2) / steps.per_octave * uniform
    sigma = np.array([focal_sigma_px, centre_sigma_px, centre_sigma_px, _k1_step(given, steps) * uniform])
    estimated = of_sent + np.array([scale, scale, scale, 1.0]) * (after - before)
    given_sigma = np.array([sent.focal_x_px, scale, scale, 1.0]) * prior_sigma
    values = np.stack([of_sent, estimated, sigma, given_sigma], axis=1)
    return tuple(it for it in checks_of(values, after != before, np.zeros(4, bool)) if it.conflict)
