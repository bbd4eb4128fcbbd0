"""What speaks for a pose, in a handful of numbers: the only ground that the judge (`judge`) has."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapless.geometry import Array

from ..results import Support
from ..uncertainty.accuracy import accuracy_from_covariance
from .gate import findable_count, hull_share, log10_false_alarms

FEATURES = ("significance", "inlier share", "found share", "hull share", "references", "fit", "precision")
"""What `Evidence.features` holds; more is better in each."""

LEAST_RADIUS_M, LARGEST_RADIUS_M = 0.005, 1.0
"""Between them a smaller claimed radius is evidence: right is what is off by 10 cm at most. Beyond a metre it does not
matter any more how much beyond, and a few millimetres more or less prove nothing."""


@dataclass(frozen=True)
class Evidence:
    """What speaks for a pose.

    Attributes:
        log10_false_alarms: expected number, as a power of ten, of poses that wrong matches would support as well.
        inlier_count: matches that agree with it.
        match_count: matches tried.
        findable_count: points of the structure that it has inside the image; no more than the photograph has features.
        hull_share: of the image that the inliers' convex hull covers.
        reference_count: effective number of references that support it, (sum n_i)^2 / sum n_i^2 over the inliers n_i
            on points of each: 1 if one has them all, K if all have as many.
        error_sigma: median error of the inliers, in standard deviations of their keypoints, where it exceeds one.
        position_95_m: radius claimed for the position.
    """

    log10_false_alarms: float
    inlier_count: int
    match_count: int
    findable_count: int
    hull_share: float
    reference_count: float
    error_sigma: float
    position_95_m: float

    @property
    def inlier_share(self) -> float:
        """Of the matches, those that agree."""
        return self.inlier_count / self.match_count

    @property
    def found_share(self) -> float:
        """Inliers over what should be found."""
        return min(1.0, self.inlier_count / max(1, self.findable_count))

    def features(self) -> Array:
        """Logarithms (7,) in the order of `FEATURES`, each the larger the better."""
        return np.log(
            [
                max(1.0, -self.log10_false_alarms),
                self.inlier_share,
                self.found_share,
                max(1e-4, self.hull_share),
                self.reference_count,
                1 / self.error_sigma,
                1 / min(max(self.position_95_m, LEAST_RADIUS_M), LARGEST_RADIUS_M),
            ]
        )


def evidence_of(support: Support, inlier_px: float, log10_chance: float = 0.0) -> Evidence:
    """What speaks for the estimate of a support.

    Args:
        support: with an estimate of four inliers or more.
        inlier_px: within which matches agree.
        log10_chance: how improbable it is that a pose found by chance agrees with what is known of it (see `priors`).
    """
    estimate, query, structure, matches = support.estimate, support.query, support.structure, support.matches
    if estimate is None or estimate.inliers.sum() < 4:
        raise ValueError("there is no pose to speak for")
    inliers, pose = estimate.inliers, estimate.world_from_camera
    by_reference = np.array(support.inliers_by_reference(), float)
    sigma_px = structure.noise.sigma_px(query.features.sizes_px[matches.keypoint[inliers]].astype(np.float64))
    return Evidence(
        log10_false_alarms(query.camera, matches, inliers, inlier_px) + log10_chance,
        int(inliers.sum()),
        len(matches),
        findable_count(query, structure, pose),
        hull_share(query, matches, inliers),
        float(by_reference.sum() ** 2 / max(1.0, (by_reference**2).sum())) or 1.0,
        max(1.0, float(np.median(estimate.errors_px[inliers] / sigma_px))),
        accuracy_from_covariance(estimate.covariance).position_95_m,
    )
