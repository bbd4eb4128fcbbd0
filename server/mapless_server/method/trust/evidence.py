"""Evidence for a pose: quantities that mean the same for every scene, unit and kind of feature."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from mapless.geometry import Array, RigidTransform

from ..results import PointMatches, Support
from ..views import View
from .agreement import AgreementOptions, disagreement_of_matches, disagreement_of_references
from .votes import Votes

MOST_POINTS = 2000
"""The shares that references find are computed from so many points, evenly thinned."""

LEAST_SHARE, LEAST_HULL_SHARE, LEAST_DISAGREEMENT = 0.01, 0.002, 0.001
"""Below these evidence is not better or worse. A right pose's halves are apart by a thousandth of the distance."""


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
        matches_apart: distance of the cameras that halves of the matches give, as a share of their distance from what
            they see.
        references_apart: the same for halves of the references.
    """

    inlier_count: int
    match_count: int
    found_share: float
    expected_share: float
    hull_share: float
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
        """ln(found ratio x hull share / disagreement); larger for better evidence.

        Fitted weights of the three logarithms were 0.67, 0.72 and 0.67, so they have none.
        """
        found = max(LEAST_SHARE, self.found_ratio)
        return math.log(found * max(LEAST_HULL_SHARE, self.hull_share) / max(LEAST_DISAGREEMENT, self.disagreement))


def evidence_of(support: Support, votes: Votes, options: AgreementOptions) -> Evidence:
    """The evidence for the estimate of a support.

    Args:
        support: with an estimate of four inliers or more.
        votes: of the query's matches.
        options: of the agreement of halves.

    Raises:
        ValueError: there is no such estimate.
    """
    estimate, query, structure, matches = support.estimate, support.query, support.structure, support.matches
    if estimate is None or estimate.inliers.sum() < 4:
        raise ValueError("support.estimate must have at least 4 inliers")
    inliers, pose = estimate.inliers, estimate.world_from_camera
    x_in_camera = pose.inverse().apply(structure.x_in_world[matches.point[inliers]])
    distance_m = max(float(np.median(x_in_camera[:, 2])), np.finfo(float).tiny)
    return Evidence(
        int(inliers.sum()),
        len(matches),
        min(1.0, float(inliers.sum() / max(1, findable_count(query, structure.x_in_world, pose)))),
        _expected_share(support),
        hull_share(query, matches, inliers),
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


def _inside(view: View, x_in_world: Array, world_from_camera: RigidTransform) -> NDArray[np.bool_]:
    """Which of the points (P, 3) project into the image."""
    size = np.array([view.camera.width_px, view.camera.height_px])
    projected = view.camera.project(world_from_camera.inverse().apply(x_in_world))
    return np.asarray(((projected >= -0.5) & (projected < size - 0.5)).all(axis=1))


def _expected_share(support: Support) -> float:
    """Median over the references of the share that each observes of the points that it should see."""
    structure, shares = support.structure, []
    observed = np.bincount(structure.tracks.view, minlength=len(support.references))
    step = max(1, -(-len(structure.x_in_world) // MOST_POINTS))
    for reference, count in zip(support.references, observed, strict=True):
        inside = step * _inside(reference.view, structure.x_in_world[::step], reference.world_from_camera).sum()
        shares.append(count / max(1, min(inside, len(reference.view.features))))
    return min(1.0, float(np.median(shares)))
