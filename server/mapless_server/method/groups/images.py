"""The photographs of a group with their matches, in one common world.

A photograph that was rejected alone still has matches, and those of the group together may be enough for a pose.

A point that one reference observes has its distance from a depth: the reference's, or the photograph's own at the pose
that its own answer gives it. The group knows no errors that depths share, so each of n depths has n times the variance
of these, besides its own: together they hold the scale no firmer than one.

Points at the photograph's own depth are on the rays of their pixels at the pose of its own answer, wrong matches too,
and so agree with that pose whatever it is. The group uses those of accepted answers, inliers only, and counts none of
them as evidence: that is the answer's own, which the group has where the joint pose keeps its inliers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform

from ..bundle.estimate import PosedSupport, Support, observers
from ..bundle.pose_problem import AdjustOptions
from ..bundle.priors import NO_PRIORS, IntrinsicsSigma, Priors
from ..bundle.readout import RollingShutter
from ..features.limits import INLIER_PX, MIN_INLIERS
from ..judge.answer import Answer, Localization
from ..judge.evidence import findable_count, hull_share
from ..judge.references import moved_matches, without
from ..judge.two_view import MIN_HULL_SHARE
from ..options import DoubtOptions
from ..pairs.stationary import StationaryOptions
from ..pose.generalized import CameraMatches
from ..pose.own_depth import at_own_depth
from ..pose.pnp import MIN_MATCHES, failure_by_chance, log10_false_alarms
from ..rejection import Rejection, RejectionReason
from ..structure.match import MatchOptions, search
from ..structure.model import DepthPlanes, PointMatches, ScaleSource, Structure

MIN_FOUND_SHARE = 0.08
"""Least share of inliers among the points inside the images, or among the photographs' features if they are fewer.

With many references the structure extends far beyond one photograph, so `DoubtOptions.inliers` are enough for any
share. Evidence: group-gate.
"""


@dataclass(frozen=True, eq=False)
class GroupImage:
    """A photograph of a group with its own answer.

    Attributes:
        answer: the photograph's own answer; the group uses its `support`.
        match: options of the guided search.
        priors: priors on its camera's pose.
        intrinsics: standard deviations of its intrinsics, which the joint covariance contains; None if it contains
            none, for intrinsics that were given.
        shutter: its read-out by a rolling shutter; None for a global one.
    """

    answer: Answer
    match: MatchOptions
    priors: Priors = NO_PRIORS
    intrinsics: IntrinsicsSigma | None = None
    shutter: RollingShutter | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class MatchedImage(Support):
    """A photograph with matches that do not depend on a pose of it, in the world of its group.

    Attributes:
        image: its index in the group.
        own_pose: world_from_camera of its own answer; None if it is rejected.
        own_covariance: (6, 6) covariance of `own_pose`, order x y z rx ry rz, fixed world axes, metres and radians.
        match: see GroupImage.
        own_trust: trust in `own_pose` if depths give it, whose evidence needs no second reference; else 0.
        own_count: number of its inliers.
        at_own_depth: (P,) which points have their distance from the photograph's own depth, at `own_pose`.
        motion_covariance: (6, 6) the part of `own_covariance` by the camera's motion during a rolling shutter's
            read-out; None without one.
        shutter: see GroupImage.
    """

    image: int
    own_pose: RigidTransform | None
    own_covariance: Array | None
    match: MatchOptions
    at_own_depth: NDArray[np.bool_]
    own_trust: float = 0.0
    own_count: int = 0
    motion_covariance: Array | None = None
    shutter: RollingShutter | None = None

    def camera_matches(self, rig_from_camera: RigidTransform) -> CameraMatches:
        """Returns the matches as pixels and points of a camera with this pose in the rig."""
        return CameraMatches(self.matches.seen(self.query, self.structure.x_in_world), rig_from_camera)

    def matches_at(self, world_from_camera: RigidTransform) -> PointMatches:
        """Returns the matches and those of a guided search from a pose."""
        found = search(self.query, self.references, self.structure, world_from_camera, self.matches, self.match)
        matches = self.matches.and_last(found.point, found.keypoint, found.guided)
        return replace(matches, radius_px=self.match.radius_px)


@dataclass(frozen=True, eq=False)
class PosedImage:
    """A matched image posed by its group, and its inliers.

    Attributes:
        source: the matched image.
        world_from_camera: its pose in the group.
        matches: 2D-3D matches of the photograph.
        inliers: (M,) which of the matches are inliers.
        errors_px: (M,) reprojection errors; NaN for points behind the camera.
    """

    source: MatchedImage
    world_from_camera: RigidTransform
    matches: PointMatches
    inliers: NDArray[np.bool_]
    errors_px: Array

    def inliers_by_reference(self) -> tuple[int, ...]:
        """Number of inliers on points that each reference observes."""
        seen = observers(self.source.structure, self.matches.point[self.inliers])
        return tuple(np.bincount(seen, minlength=len(self.source.references)).tolist())

    def findable_count(self) -> int:
        """Number of points that should be visible."""
        return findable_count(self.source.query, self.source.structure.x_in_world, self.world_from_camera)

    def hull_share(self) -> float:
        """Share of the image that the convex hull of the inliers covers."""
        return hull_share(self.source.query, self.matches, self.inliers)

    def keeps_own_answer(self) -> bool:
        """Whether the inliers of its own answer mostly agree with its pose in the group."""
        return bool(self.inliers.sum() >= AdjustOptions.min_kept_share * self.source.own_count)

    def without_own_depth(self) -> PosedImage:
        """Without points at the photograph's own depth."""
        source, kept = self.source, ~self.source.at_own_depth
        if kept.all():
            return self
        structure, matches = _with_points(source.structure, source.matches, kept)
        source = replace(source, structure=structure, matches=matches, at_own_depth=source.at_own_depth[kept])
        rows = kept[self.matches.point]
        _, matches = _with_points(self.source.structure, self.matches, kept)
        return replace(self, source=source, matches=matches, inliers=self.inliers[rows], errors_px=self.errors_px[rows])

    def moved(self) -> PosedImage:
        """Without matches at the same pixels as in the references, see `judge.references`."""
        kept = moved_matches(replace(self.source, matches=self.matches), StationaryOptions())
        return replace(
            self, matches=self.matches.select(kept), inliers=self.inliers[kept], errors_px=self.errors_px[kept]
        )


def matched_images_of(images: Sequence[GroupImage]) -> list[MatchedImage]:
    """Returns the photographs that have matches, in one world: that of the first one."""
    with_matches = [
        (i, image, support)
        for i, image in enumerate(images)
        if (support := _support_of(image.answer)) is not None
        and len(support.matches)
        and not _is_of_network(image.answer)
    ]
    return [_matched_image(i, image, support, with_matches[0][2].origin) for i, image, support in with_matches]


def _support_of(answer: Answer) -> Support | None:
    """The support of an answer; of the points at the photograph's own depth those of an accepted answer's inliers."""
    support = answer.support
    if support is None or not (own := at_own_depth(support)).any():
        return support
    kept = ~own
    if isinstance(answer.outcome, Localization) and isinstance(support, PosedSupport):
        kept[support.matches.point[support.estimate.inliers]] = True
    rows = kept[support.matches.point]
    structure, matches = _with_points(support.structure, support.matches, kept)
    support = replace(support, structure=structure, matches=matches)
    if not isinstance(support, PosedSupport):
        return support
    estimate = support.estimate
    estimate = replace(estimate, inliers=estimate.inliers[rows], errors_px=estimate.errors_px[rows])
    return replace(support, estimate=estimate)


def _with_points(
    structure: Structure, matches: PointMatches, points: NDArray[np.bool_]
) -> tuple[Structure, PointMatches]:
    """Selects some points (P,) of a structure, and the matches with them."""
    planes = None if structure.planes is None else structure.planes[points]
    matches = matches.select(points[matches.point])
    matches = replace(matches, point=(np.cumsum(points) - 1)[matches.point])
    structure = Structure(structure.x_in_world[points], structure.tracks.select(points), structure.noise, planes)
    return structure, matches


def _matched_image(index: int, image: GroupImage, support: Support, origin: Array) -> MatchedImage:
    offset = support.origin - origin
    outcome = image.answer.outcome
    structure = _held(support).shifted(offset)
    references = tuple(replace(r, world_from_camera=r.world_from_camera.shifted(offset)) for r in support.references)
    # Matches from a guided search around a rejected pose would be evidence for that pose.
    guided = support.matches.guided
    is_kept = ~guided if not guided.all() or isinstance(outcome, Rejection) else guided
    own_pose, own_covariance, own_trust, own_count = None, None, 0.0, 0
    if isinstance(outcome, Localization):
        own_pose, own_covariance = outcome.world_from_camera.shifted(-origin), outcome.covariance
        if outcome.scale_source is not ScaleSource.REFERENCES:
            own_trust, own_count = outcome.trust or 0.0, outcome.inlier_count
    return MatchedImage(
        query=support.query,
        references=references,
        structure=structure,
        matches=support.matches.select(is_kept),
        origin=origin,
        query_matches=support.query_matches,
        intrinsics_sigma=image.intrinsics,
        reference_error_px=support.reference_error_px,
        image=index,
        own_pose=own_pose,
        own_covariance=own_covariance,
        match=image.match,
        at_own_depth=at_own_depth(support),
        own_trust=own_trust,
        own_count=own_count,
        motion_covariance=support.estimate.motion_covariance if isinstance(support, PosedSupport) else None,
        shutter=image.shutter,
    )


def _held(support: Support) -> Structure:
    """The structure with planes near which the points are that one reference observes."""
    structure, depths = support.structure, support.query.depths
    count = len(structure.x_in_world)
    alone = np.bincount(structure.tracks.point, minlength=count) < 2
    if not alone.any():
        return structure
    planes = structure.planes or DepthPlanes.unknown(count)
    normal, offset, information = planes.normal.copy(), planes.offset.copy(), planes.information.copy()
    known = alone & (information > 0)
    shared = known.sum() * (planes.common[known] ** 2).sum(axis=1)
    information[known] = 1 / (1 / information[known] + shared)
    if depths is not None and isinstance(support, PosedSupport):
        point, keypoint = support.matches.point, support.matches.keypoint
        own = alone[point] & ~known[point] & np.isfinite(depths.depth[keypoint]) & support.estimate.inliers
        point, keypoint, pose = point[own], keypoint[own], support.estimate.world_from_camera
        normal[point] = pose.rotation[:, 2]
        offset[point] = structure.x_in_world[point] @ pose.rotation[:, 2]
        variance = depths.relative_sigma[keypoint].astype(np.float64) ** 2 + len(point) * depths.common_sigma**2
        information[point] = 1 / (variance * depths.depth[keypoint].astype(np.float64) ** 2)
    planes = DepthPlanes(normal, offset, information, planes.view, planes.common)
    return replace(structure, planes=planes)


def priors_of(images: Sequence[GroupImage], origin: Array) -> dict[int, Priors]:
    """Priors of each photograph that has some, by index, in a world with this origin (3,)."""
    return {i: image.priors.shifted(-origin) for i, image in enumerate(images) if image.priors}


def too_few_matches(matched_images: Sequence[MatchedImage], noun: str) -> Rejection | None:
    """Returns the rejection of a group with too few matches in all of its photographs together."""
    total = sum(len(it.matches) for it in matched_images)
    message = f"{total} 2D-3D matches in {len(matched_images)} {noun}, {MIN_MATCHES} needed"
    return Rejection(RejectionReason.TOO_FEW_MATCHES, message) if total < MIN_MATCHES else None


def rejection_without_matches(images: Sequence[GroupImage]) -> Rejection:
    """Returns the rejection of a group without matches: that of the photograph that reached the latest stage."""
    order = list(RejectionReason)
    outcomes = [(i, image.answer.outcome) for i, image in enumerate(images)]
    rejected = [(order.index(outcome.reason), i, outcome) for i, outcome in outcomes if isinstance(outcome, Rejection)]
    if not rejected:
        message = "no image has 2D-3D matches"
        if any(_is_of_network(image.answer) for image in images):
            message += " with triangulated points: depths that a network predicts with a single reference do not count"
        return Rejection(RejectionReason.TOO_FEW_MATCHES, message)
    _, i, furthest = max(rejected, key=lambda it: (it[0], -it[1]))
    return Rejection(furthest.reason, f"no image has 2D-3D matches; image {i}: {furthest.message}", furthest.hint)


def group_gate_failure(matched: Sequence[PosedImage]) -> str | None:
    """Returns why the pose of a group fails the gate; None if it passes.

    `pnp.gate_failure` with sums over the photographs; besides, a share of the points must be found, over more than a
    corner of the image. Points at a photograph's own depth do not count; a pose that keeps the inliers of the answer
    that they give has passed the gate of that.
    """
    if any(it.source.at_own_depth.any() and it.source.own_trust and it.keeps_own_answer() for it in matched):
        return None
    matched = [it.without_own_depth() for it in matched]
    inlier_total = sum(int(it.inliers.sum()) for it in matched)
    if inlier_total < MIN_INLIERS:
        return f"{inlier_total} matches agree on a pose besides those at the photographs' own depth"
    count = f"{_agreeing(matched)} in {len(matched)} images agree on a pose"
    moved = [it.moved() for it in matched]
    unmoved_count = inlier_total - sum(int(it.inliers.sum()) for it in moved)
    for some, begin in ((matched, count), (moved, f"{count}; {without(unmoved_count)} {_agreeing(moved)}")):
        photographs = [(it.source.query.camera, it.matches, it.inliers) for it in some]
        if failure := failure_by_chance(begin, log10_false_alarms(photographs, INLIER_PX)):
            return failure
    visible = sum(it.findable_count() for it in matched)
    if inlier_total < min(MIN_FOUND_SHARE * visible, DoubtOptions.inliers):
        return f"{count}, but they should show {visible} points: repeated structure somewhere else, most likely"
    covered = sum(it.hull_share() for it in matched)
    if covered < MIN_HULL_SHARE:
        return f"{count}, but they cover only {100 * covered:.1f} % of an image"
    return None


def _agreeing(matched: Sequence[PosedImage]) -> str:
    """How many of the matches are inliers, for a message."""
    return f"{sum(int(it.inliers.sum()) for it in matched)} of {sum(len(it.matches) for it in matched)} matches"


def _is_of_network(answer: Answer) -> bool:
    """Whether its points have a network's depths (a single reference); a group uses triangulated points only."""
    return answer.scale is not None and answer.scale.source is ScaleSource.NETWORK
