"""Evidence for a pose: quantities that mean the same for every scene, unit and kind of feature."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from mapless.geometry import Array, RigidTransform

from ..results import PointMatches, Structure, Support
from ..two_view.matches import TwoViewMatches
from ..views import Matches, PosedView, View
from .agreement import AgreementOptions, disagreement_of_matches, disagreement_of_references
from .votes import Votes

MOST_POINTS = 2000
"""The shares that references find are computed from so many points, evenly thinned."""

LEAST_SHARE, LEAST_HULL_SHARE, LEAST_EPIPOLAR_SHARE, LEAST_DISAGREEMENT = 0.01, 0.002, 0.0004, 0.001
"""Below these evidence is not better or worse. A right pose's halves are apart by a thousandth of the distance."""

EPIPOLAR_PX = 2.0
"""Largest Sampson distance of a match that agrees with a pose; keypoints are accurate to about a pixel."""


@dataclass(frozen=True)
class Evidence:
    """The evidence for a pose.

    Attributes:
        inlier_count: number of inliers.
        match_count: number of 2D-3D matches.
        found_share: share of inliers among the points that project into the image, or among the photograph's features
            if they are fewer.
        expected_share: the same of the references, the median: in the dark, between distant references, or where much
            is hidden, a reference finds few of the points that it should see, too.
        hull_share: share of the image covered by the convex hull of the inliers.
        epipolar_share: share of the matches with a reference that lie on their epipolar lines, for the two references
            with the most inliers, multiplied. Most of these matches have no point, so they took no part in the pose.
        matches_apart: distance of the cameras that halves of the matches give, as a share of their distance from what
            they see.
        references_apart: the same for halves of the references.
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
        """Found over expected share, at most one."""
        return min(1.0, self.found_share / max(self.expected_share, 1e-3))

    @property
    def disagreement(self) -> float:
        """How far apart the halves are, both kinds together, at most one."""
        return min(1.0, math.hypot(self.matches_apart, self.references_apart))

    @property
    def score(self) -> float:
        """ln(found ratio x hull share x epipolar share / disagreement); larger for better evidence.

        Fitted weights of the logarithms were alike, so they have none.
        """
        found, hull = max(LEAST_SHARE, self.found_ratio), max(LEAST_HULL_SHARE, self.hull_share)
        epipolar = max(LEAST_EPIPOLAR_SHARE, self.epipolar_share)
        return math.log(found * hull * epipolar / max(LEAST_DISAGREEMENT, self.disagreement))


def evidence_of(
    support: Support, votes: Votes, query_matches: Sequence[Matches], options: AgreementOptions
) -> Evidence:
    """The evidence for the estimate of a support.

    Args:
        support: with an estimate of four inliers or more.
        votes: of the query's matches.
        query_matches: of the query with each reference.
        options: of the agreement of halves.

    Raises:
        ValueError: there is no such estimate.
    """
    estimate, query, structure, matches = support.estimate, support.query, support.structure, support.matches
    if estimate is None or estimate.inliers.sum() < 4:
        raise ValueError("support.estimate must have at least 4 inliers")
    inliers, pose = estimate.inliers, estimate.world_from_camera
    distance_m = support.distance_m()
    return Evidence(
        int(inliers.sum()),
        len(matches),
        min(1.0, float(inliers.sum() / max(1, findable_count(query, structure.x_in_world, pose)))),
        expected_share(structure, support.references),
        hull_share(query, matches, inliers),
        epipolar_share(query, support.references, query_matches, support.inliers_by_reference(), pose),
        disagreement_of_matches(support, distance_m, options),
        disagreement_of_references(support, votes, distance_m, options),
    )


def findable_count(view: View, x_in_world: Array, world_from_camera: RigidTransform) -> int:
    """Number of points (P, 3) that project into the image, occluded or not; at most the number of its features."""
    return min(int(_inside(view, x_in_world, world_from_camera).sum()), len(view.features))


def hull_share(query: View, matches: PointMatches, inliers: NDArray[np.bool_]) -> float:
    """Share of the image covered by the convex hull of the inliers (M,), three or more."""
    pixels = query.features.keypoints[matches.keypoint[inliers]]
    return float(ConvexHull(pixels, qhull_options="QJ").volume) / (query.camera.width_px * query.camera.height_px)


def epipolar_share(
    query: View,
    references: Sequence[PosedView],
    query_matches: Sequence[Matches],
    inlier_counts: Sequence[int],
    world_from_query: RigidTransform,
) -> float:
    """Share of the matches on their epipolar lines, of the two references with the most inliers, multiplied.

    Keypoints that have no place in an estimated lens, NaN, do not count.
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


def _inside(view: View, x_in_world: Array, world_from_camera: RigidTransform) -> NDArray[np.bool_]:
    """Which of the points (P, 3) project into the image."""
    size = np.array([view.camera.width_px, view.camera.height_px])
    projected = view.camera.project(world_from_camera.inverse().apply(x_in_world))
    return np.asarray(((projected >= -0.5) & (projected < size - 0.5)).all(axis=1))


def expected_share(structure: Structure, references: Sequence[PosedView]) -> float:
    """Median over the references of the share that each observes of the points that it should see."""
    shares = []
    observed = np.bincount(structure.tracks.view, minlength=len(references))
    step = max(1, -(-len(structure.x_in_world) // MOST_POINTS))
    for reference, count in zip(references, observed, strict=True):
        inside = step * _inside(reference.view, structure.x_in_world[::step], reference.world_from_camera).sum()
        shares.append(count / max(1, min(inside, len(reference.view.features))))
    return min(1.0, float(np.median(shares)))
