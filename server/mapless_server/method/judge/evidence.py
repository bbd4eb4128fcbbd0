"""Evidence for a pose: quantities that mean the same for every scene, unit and kind of feature.

One is how far apart the poses are that disjoint halves of the data give. A pose that is right and well determined is
found again from half of the matches, and from the matches with half of the references; chance, repeated structure and
wrong reference poses put the halves at different places. Matches from a guided search agree with the pose around which
they were searched, so they take no part unless there are no others.

RANSAC finds the pose of a half, unless most of a half agree with the pose in question: RANSAC would find the same a
little moved, so that is computed.
"""

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform

from ..bundle.estimate import PosedSupport, Support
from ..features.limits import EPIPOLAR_PX, LOSS_SCALE_PX, MIN_INLIERS
from ..features.tracks import keypoint_offsets
from ..features.views import Matches, PosedView, View
from ..optim.optimize import LEAST_DAMPING, cauchy_weight, pose_jacobian
from ..pose.pnp import PnpOptions, ransac
from ..pose.two_view_matches import TwoViewMatches
from ..structure.model import PixelPoints, PointMatches, Structure

MOST_POINTS = 2000
"""The shares that references find are computed from so many points, evenly thinned."""

LEAST_SHARE, LEAST_HULL_SHARE, LEAST_EPIPOLAR_SHARE, LEAST_DISAGREEMENT = 0.01, 0.002, 0.0004, 0.001
"""Below these evidence is not better or worse."""

LEAST_AGREEING = 8
"""Where the majority of a half's matches agree with the pose, and so many, the half's own pose is near it."""

LINEAR_SHARE, LINEAR_STEPS = 0.02, 5
"""Largest motion, and standard deviation, in which residuals are linear (of the distance, and radians); steps."""

ROW, COLUMN = np.triu_indices(6)
TWICE = np.where(ROW == COLUMN, 1.0, 2.0)
"""The elements of a symmetric matrix of the pose's motion, and how often each occurs."""

SPLITS = 3
"""Splits into halves, of which the median counts; one split may put all good matches into one half."""

SHUFFLING = 0.3
"""References are assigned to halves in the order of their numbers of matches, each raised by up to this share at
random, so that the splits differ and the halves remain balanced."""

PNP = PnpOptions(min_iterations=30, max_iterations=1000, max_matches=600)
"""RANSAC of the halves' poses; 1000 iterations find a pose with a third of the matches as inliers."""

NO_AGREEMENT = 1.0
"""The disagreement of halves that give no pose: as far apart as what they see is away."""


@dataclass(frozen=True, eq=False)
class Votes:
    """Matches with each reference, carried to points; row v is one match.

    Attributes:
        reference: (V,) index of the reference.
        keypoint: (V,) index of the query's keypoint.
        seen: the points and the keypoints' pixels.
    """

    reference: NDArray[np.intp]
    keypoint: NDArray[np.intp]
    seen: PixelPoints

    def __getitem__(self, rows: NDArray[np.bool_]) -> "Votes":
        return Votes(self.reference[rows], self.keypoint[rows], self.seen[rows])

    def keypoint_count(self, rows: NDArray[np.bool_]) -> int:
        """Number of different keypoints among the selected rows (V,)."""
        return int(np.count_nonzero(np.bincount(self.keypoint[rows])))


def votes_of(support: Support) -> Votes:
    """The matches of a support's query with keypoints of triangulated points."""
    query, structure, query_matches = support.query, support.structure, support.query_matches
    tracks, offsets = structure.tracks, keypoint_offsets(support.references)
    point_of = np.full(offsets[-1], -1)
    point_of[offsets[tracks.view] + tracks.keypoint] = tracks.point
    reference = np.repeat(np.arange(len(query_matches)), [len(m) for m in query_matches])
    pairs = np.concatenate([np.asarray(m, np.intp).reshape(-1, 2) for m in query_matches])
    point = point_of[offsets[reference] + pairs[:, 1]]
    known = point >= 0
    keypoint = pairs[known, 0]
    seen = PixelPoints(query.camera, structure.x_in_world[point[known]], query.features.pixels(keypoint))
    return Votes(reference[known], keypoint, seen)


def disagreement_of_matches(support: PosedSupport, distance_m: float) -> float:
    """Distance between the cameras that random halves of the matches give, as a share of `distance_m`; at most 1."""
    seen = support.matches.unguided().seen(support.query, support.structure.x_in_world)

    def random_half(random: np.random.Generator) -> NDArray[np.bool_]:
        return np.asarray(random.permutation(len(seen)) % 2 == 0)

    return _median_disagreement(seen, random_half, distance_m, support.estimate.world_from_camera)


def disagreement_of_references(support: PosedSupport, votes: Votes, distance_m: float) -> float:
    """The same distance for matches with one half of the references and with the other half.

    The halves have about as many matches each; of several matches of a keypoint within a half the first counts.
    """
    counts = np.bincount(votes.reference, minlength=len(support.references))

    def half_of_votes(random: np.random.Generator) -> NDArray[np.bool_]:
        return np.asarray(half_of_references(counts, random)[votes.reference])

    pose = support.estimate.world_from_camera
    return _median_disagreement(votes.seen, half_of_votes, distance_m, pose, votes.keypoint)


def half_of_references(counts: NDArray[np.intp], random: np.random.Generator) -> NDArray[np.bool_]:
    """Mask (K,) of the first half of the references, so that both halves have about as many matches (K,)."""
    order = np.argsort(-counts * (1 + SHUFFLING * random.random(len(counts))), kind="stable")
    in_first, totals = np.zeros(len(counts), bool), [0, 0]
    for reference in order:
        in_first[reference] = totals[0] <= totals[1]
        totals[0 if in_first[reference] else 1] += counts[reference]
    return in_first


def _median_disagreement(
    seen: PixelPoints,
    draw_half: Callable[[np.random.Generator], NDArray[np.bool_]],
    distance_m: float,
    pose: RigidTransform,
    keypoint: NDArray[np.intp] | None = None,
) -> float:
    """Median over the splits of the distance of the two halves' cameras, as a share of `distance_m`; at most 1."""
    random = np.random.default_rng(0)
    firsts = np.array([draw_half(random) for _ in range(SPLITS)])
    halves = np.stack([firsts, ~firsts], axis=1).reshape(2 * SPLITS, -1)
    if keypoint is not None:
        rows, halves = _first_of_each(keypoint, seen.x_in_world, halves)
        seen = seen[rows]
    shifts = _shifts_nearby(seen, halves, pose, distance_m)
    for half, shift in zip(halves, shifts, strict=True):
        if np.isnan(shift[0]) and half.sum() >= MIN_INLIERS:
            found = ransac(seen[half], None, PNP)
            shift[:] = np.nan if found is None else found.translation - pose.translation
    apart = np.linalg.norm(shifts[::2] - shifts[1::2], axis=1) / distance_m
    return float(min(NO_AGREEMENT, statistics.median(np.nan_to_num(apart, nan=NO_AGREEMENT).tolist())))


def _first_of_each(
    keypoint: NDArray[np.intp], x_in_world: Array, halves: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Indices (R,) of different matches, and which of these are the first of their keypoint in each half (H, R)."""
    order = np.argsort(keypoint, kind="stable")
    keypoint, x = keypoint[order], x_in_world[order, 0]
    is_new = np.diff(keypoint, prepend=-1) > 0
    starts = np.flatnonzero(is_new | (np.diff(x, prepend=np.nan) != 0))
    if not len(starts):
        return order, halves
    halves = np.logical_or.reduceat(halves[:, order], starts, axis=1)
    count = np.cumsum(halves, axis=1)
    of_keypoint = np.flatnonzero(is_new[starts])[np.cumsum(is_new[starts]) - 1]
    return order[starts], halves & (count - (count - halves)[:, of_keypoint] == 1)


def _shifts_nearby(seen: PixelPoints, halves: NDArray[np.bool_], pose: RigidTransform, distance_m: float) -> Array:
    """Shifts (H, 3) from a pose's centre to those of halves (H, M) of the matches; NaN where the pose is not theirs.

    By least squares with the weights of Cauchy's loss, as in `ransac`; residuals are linear in motions so small.
    """
    shifts = np.full((len(halves), 3), np.nan)
    x_in_camera = pose.inverse().apply(seen.x_in_world)
    residual = seen.camera.project(x_in_camera) - seen.pixels
    agrees: NDArray[np.bool_] = np.linalg.norm(residual, axis=1) < PNP.inlier_px
    in_half = halves[:, agrees]
    agreeing = in_half.sum(axis=1)
    chosen: NDArray[np.bool_] = (agreeing >= LEAST_AGREEING) & (agreeing > halves.sum(axis=1) / 2)
    if not chosen.any():
        return shifts
    (x, y), (right, down) = pose_jacobian(seen.camera, x_in_camera[agrees]), residual[agrees].T
    # Of each match what its squared residual |r + J m|^2 and its normal equations at any motion m are sums of.
    products = np.concatenate([x[ROW] * x[COLUMN] + y[ROW] * y[COLUMN], right * x + down * y])
    squared, in_half = right**2 + down**2, in_half[chosen].astype(np.float64)
    motion = np.zeros((len(in_half), 6))
    largest = LINEAR_SHARE * np.repeat([distance_m, 1.0], 3)
    for _ in range(LINEAR_STEPS):
        of_motion = np.concatenate([motion[:, ROW] * motion[:, COLUMN] * TWICE, 2 * motion], axis=1)
        weight = in_half * cauchy_weight(squared + of_motion @ products, LOSS_SCALE_PX)
        sums = weight @ products.T
        hessian = np.empty((len(sums), 6, 6))
        hessian[:, ROW, COLUMN] = hessian[:, COLUMN, ROW] = sums[:, :-6]
        gradient = sums[:, -6:, None] + hessian @ motion[:, :, None]
        hessian += LEAST_DAMPING * np.eye(6) * (hessian + 1)
        motion = np.clip(motion - np.linalg.solve(hessian, gradient)[:, :, 0], -largest, largest)
    sigma = np.sqrt(np.diagonal(np.linalg.inv(hessian), axis1=1, axis2=2))  # with a noise of one pixel
    is_small = np.asarray((np.maximum(np.abs(motion), sigma) < largest).all(axis=1))
    shifts[chosen] = np.where(is_small[:, None], -motion[:, :3] @ pose.rotation.T, np.nan)
    return shifts


@dataclass(frozen=True)
class Evidence:
    """The evidence for a pose.

    Attributes:
        inlier_count: number of inliers.
        match_count: number of 2D-3D matches.
        found_share: share of inliers among the points that project into the image, or among the photograph's features
            if they are fewer.
        expected_share: median of the same share over the references, which is small, too, where much is hidden or dark.
        hull_share: share of the image covered by the convex hull of the inliers.
        epipolar_share: share of the matches with a reference that lie on their epipolar lines, for the two references
            with the most inliers, multiplied. Most of these matches have no point, so they took no part in the pose.
        matches_apart: distance of the cameras that halves of the matches give, as a share of their distance from what
            they see.
        references_apart: the same distance for halves of the references.
    """

    inlier_count: int
    match_count: int
    found_share: float
    expected_share: float
    hull_share: float
    epipolar_share: float
    matches_apart: float
    references_apart: float

    @property
    def found_ratio(self) -> float:
        """Ratio of found to expected share, at most 1."""
        return min(1.0, self.found_share / max(self.expected_share, 1e-3))

    @property
    def disagreement(self) -> float:
        """How far apart the halves' cameras are, both kinds of halves together, at most 1."""
        return min(1.0, math.hypot(self.matches_apart, self.references_apart))

    @property
    def score(self) -> float:
        """ln(found ratio x hull share x epipolar share / disagreement); larger for better evidence."""
        found, hull = max(LEAST_SHARE, self.found_ratio), max(LEAST_HULL_SHARE, self.hull_share)
        epipolar = max(LEAST_EPIPOLAR_SHARE, self.epipolar_share)
        return math.log(found * hull * epipolar / max(LEAST_DISAGREEMENT, self.disagreement))


def evidence_of(support: PosedSupport, votes: Votes) -> Evidence:
    """Computes the evidence for the estimate of a support, and its matches carried to points.

    ValueError if the estimate has fewer than four inliers.
    """
    query, structure, matches = support.query, support.structure, support.matches
    inliers, pose = support.estimate.inliers, support.estimate.world_from_camera
    if inliers.sum() < MIN_INLIERS:
        raise ValueError("support.estimate must have at least 4 inliers")
    distance_m = support.distance_m()
    return Evidence(
        int(inliers.sum()),
        len(matches),
        min(1.0, float(inliers.sum() / max(1, findable_count(query, structure.x_in_world, pose)))),
        expected_share(structure, support.references),
        hull_share(query, matches, inliers),
        epipolar_share(query, support.references, support.query_matches, support.inliers_by_reference(), pose),
        disagreement_of_matches(support, distance_m),
        disagreement_of_references(support, votes, distance_m),
    )


def findable_count(view: View, x_in_world: Array, world_from_camera: RigidTransform) -> int:
    """Number of points (P, 3) that project into the image, occluded or not; at most the number of its features."""
    return min(int(_inside([view], [world_from_camera], x_in_world).sum()), len(view.features))


def hull_share(query: View, matches: PointMatches, inliers: NDArray[np.bool_]) -> float:
    """Share of the image covered by the convex hull of the inliers (M,), three or more."""
    pixels = query.features.keypoints[matches.keypoint[inliers]]
    return hull_px2(pixels) / (query.camera.width_px * query.camera.height_px)


def hull_px2(pixels: NDArray[np.floating]) -> float:
    """Area of the convex hull of pixels (N, 2), square pixels; 0 for fewer than three."""
    return float(cv2.contourArea(cv2.convexHull(pixels.astype(np.float32)))) if len(pixels) >= 3 else 0.0


def epipolar_share(
    query: View,
    references: Sequence[PosedView],
    query_matches: Sequence[Matches],
    inlier_counts: Sequence[int],
    world_from_query: RigidTransform,
) -> float:
    """Product, over the two references with the most inliers, of the shares of matches on their epipolar lines.

    Keypoints that an estimated lens model cannot undistort (NaN) do not count.
    """
    strongest = np.argsort(-np.array(inlier_counts), kind="stable")[:2]
    has_place = np.asarray(np.isfinite(query.features.keypoints).all(axis=1))
    chosen = [query_matches[i][has_place[query_matches[i][:, 0]]] for i in strongest]
    if len(chosen) < 2 or not all(map(len, chosen)):
        return 0.0
    matches = TwoViewMatches.of(query, [references[i] for i in strongest], chosen)
    # From the same place as a reference the photograph has no epipolar lines, and every match agrees.
    agreeing = np.nan_to_num(matches.sampson_px(world_from_query)) < EPIPOLAR_PX
    return float(np.prod([agreeing[matches.reference == i].mean() for i in (0, 1)]))


def _inside(views: Sequence[View], world_from_camera: Sequence[RigidTransform], x_in_world: Array) -> NDArray[np.bool_]:
    """Mask (V, P) of the points (P, 3) that project into each of V photographs."""
    poses = [it.inverse() for it in world_from_camera]
    rotations, translations = np.stack([it.rotation for it in poses]), np.stack([it.translation for it in poses])
    x, y, z = np.moveaxis(rotations @ x_in_world.T + translations[:, :, None], 1, 0)
    cameras = [it.camera for it in views]
    size = np.array([(it.width_px, it.height_px) for it in cameras], float).T[:, :, None]
    focal = np.array([(it.focal_x_px, it.focal_y_px) for it in cameras]).T[:, :, None]
    edge = np.array([(it.principal_x_px, it.principal_y_px) for it in cameras]).T[:, :, None] + 0.5
    right, below = focal[0] * x + edge[0] * z, focal[1] * y + edge[1] * z
    return np.asarray((z > 0) & (right >= 0) & (right < size[0] * z) & (below >= 0) & (below < size[1] * z))


def expected_share(structure: Structure, references: Sequence[PosedView]) -> float:
    """Median over the references of the share that each observes of the points that it should see."""
    observed = np.bincount(structure.tracks.view, minlength=len(references))
    step = max(1, -(-len(structure.x_in_world) // MOST_POINTS))
    views, poses = [it.view for it in references], [it.world_from_camera for it in references]
    inside = step * _inside(views, poses, structure.x_in_world[::step]).sum(axis=1)
    shares = observed / np.maximum(1, np.minimum(inside, [len(it.features) for it in views]))
    return min(1.0, float(np.median(shares)))
