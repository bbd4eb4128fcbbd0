"""The covariance of a pose.

The answer's covariance is that of world_from_camera in ROS's order (see `perturbation`), and is the sum of

    references   the dispersion of the poses that leave out one reference each: errors of reference poses, lens models
                 and shutters, which all points of a reference share.
    regions      that of the regions of the photograph: noise of pixels, and whatever neighbouring matches share.
    scale        s^2 d d^T, d = camera centre - centroid of the references, s the relative uncertainty of the metric
                 scale, for poses that depend on the scale rather than on triangulated points: initial poses, and poses
                 from predicted points (`no_structure`). Otherwise the references' poses determine the scale, and their
                 errors are in the dispersion.
    offset       o o^T, o the Gauss-Newton step from the pose to its optimum, for an initial pose that is answered as it
                 is.

The first two are in `dispersion`. They measure the errors of this very photograph, so they hold in scenes that nobody
tuned: over twelve scenes and two kinds of features, the factor between radii and errors varies by a fifth (standard
deviation of its logarithm 0.21 for positions, 0.20 for angles), by as much as chance makes it from fifty answers. The
inverse of the normal equations, which contains the modelled errors of reference poses, varies by 0.77 and 0.62: where
references disagree because points move with the viewpoint, it takes this for errors of their poses.

What all matches share (one lens model, one survey) shows in neither, and what neighbouring references share in part.
With simulated noise of pixels and of reference poses, each its own, standard deviations are right within a third; where
the references' errors drift by twice the pixels' noise, errors are up to 1.8 times as large as stated (the tests).

What the references cannot say of themselves enlarges both: keypoints move with the viewpoint, for all references to the
same side. Within 11 of 12 scenes errors grow more than radii with the gap, the distance to the nearest reference by the
depth.

Three factors remain: on the standard deviations of positions and of angles, and on the radii of 95 %, because errors
have heavier tails than the normal distribution. `research.radii` measures them on scenes with known poses, each tested
on a scene that it was not measured on.
"""

from dataclasses import dataclass

import numpy as np

from mapless.geometry import Array, RigidTransform

from ..options import check_bounds
from ..perturbation import world_jacobian
from .dispersion import Dispersion
from .radii import gap_ratio


@dataclass(frozen=True)
class UncertaintyOptions:
    """Options of the covariance.

    Attributes:
        region_factor: factor on the standard deviations of the regions' part: the fit of the pose hides a part of the
            errors that a region shares. With 1 instead of 1.5 errors by radii vary more, within scenes and between.
        position_factor, rotation_factor: factors on standard deviations. Below 1, because noise of a single keypoint
            is both in the references' part and in that of the regions. Photographs of twelve places say 0.72 for
            positions; planted noise with correlated errors of references requires 0.76.
        gap_growth: exponent of the gap in the factor on standard deviations. Larger ones fit a scene's few references
            better, but make radii of the closest too small.
        max_matches: largest number of the photograph's matches, evenly thinned; the time is linear in it. Using all
            matches gives no better radii.
    """

    region_factor: float = 1.5
    position_factor: float = 0.76
    rotation_factor: float = 0.78
    gap_growth: float = 0.1
    max_matches: int = 500

    def __post_init__(self) -> None:
        check_bounds(self, "region_factor position_factor rotation_factor max_matches", above=0)
        check_bounds(self, "gap_growth", at_least=0)


def dispersed_covariance(
    dispersion: Dispersion, world_from_camera: RigidTransform, options: UncertaintyOptions, is_offset: bool = False
) -> Array:
    """Covariance (6, 6) of a pose without the parts of scale and intrinsics, with the factors.

    Args:
        dispersion: dispersion of the pose.
        world_from_camera: the pose.
        options: options of the covariance.
        is_offset: whether the pose is known not to be at the optimum.
    """
    grown = gap_ratio(dispersion.gap) ** (2 * options.gap_growth)
    covariance = grown * dispersion.covariance(options.region_factor)
    if is_offset:
        covariance = covariance + np.outer(dispersion.offset, dispersion.offset)
    factor = np.repeat([options.position_factor, options.rotation_factor], 3)
    to_world = factor[:, None] * world_jacobian(world_from_camera)
    covariance = to_world @ covariance @ to_world.T
    return np.asarray((covariance + covariance.T) / 2)


def scale_covariance(world_from_camera: RigidTransform, centroid: Array, relative_sigma: float) -> Array:
    """s^2 d d^T as (6, 6), for a pose whose distance d from the references' centroid (3,) depends on the scale."""
    covariance = np.zeros((6, 6))
    arm = world_from_camera.translation - centroid
    covariance[:3, :3] = relative_sigma**2 * np.outer(arm, arm)
    return covariance
