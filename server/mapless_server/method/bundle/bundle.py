"""Bundle adjustment of cameras and points.

    min  sum_obs rho(|r_o|^2 / sigma_o^2) + xi^T C^-1 xi      (Cauchy's loss)

over the poses of all cameras and the points; xi are the motions of the references away from their given poses. The last
camera is the query, whose pose may have priors. Its intrinsics may be unknowns too: four errors with a prior of mean 0
(see `intrinsics`). They move its keypoints, which is linear, so that derivatives by poses and points do not depend on
them. The points are eliminated (Schur complement), which leaves a dense system of 6 unknowns per camera and those 4.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform

from ..features.tracks import Tracks
from ..features.views import PosedView
from ..optim.optimize import cauchy_cost, solve_step, world_jacobian
from ..structure.model import Structure
from ..structure.observations import Observations
from ..structure.structure import observe
from .normal_equations import Bundle, Linearized, NormalEquations, Poses, ViewColumns
from .priors import NO_PRIORS, Priors


@dataclass(frozen=True, eq=False)
class BundleProblem:
    """The cost and its derivatives; see `optimize.Problem`.

    Attributes:
        observations: observations of the points in all views; the views' poses are not used.
        by_view: the same sorted by view, with the motion of the query's keypoints by errors of its intrinsics, if these
            are unknowns, and planes near which the points lie by stored depths, at the references' given poses.
        given: poses of the references.
        information: C^-1, (6 (V - 1), 6 (V - 1)), of the prior on the references' poses; 0 leaves them free.
        loss_scale_sigma: scale of the Cauchy loss, in standard deviations.
        priors: priors on the query's pose.
        prior_weight: factor on their cost, relative to that of the observations.
        intrinsics_information: (I,) inverse variances of the prior on these errors.
        intrinsics_offset: (I,) errors of the intrinsics that are removed already; the prior's mean is minus these.
        least_curvature: least curvature of the loss along a residual, as a share of its weight. Below 1 steps are
            longer and fewer (Triggs et al., Bundle adjustment: a modern synthesis, 2000); the minimum is the same.
    """

    observations: Observations
    by_view: ViewColumns
    given: Poses
    information: Array
    loss_scale_sigma: float
    priors: Priors = NO_PRIORS
    prior_weight: float = 1.0
    intrinsics_information: Array = field(default_factory=lambda: np.zeros(0))
    intrinsics_offset: Array = field(default_factory=lambda: np.zeros(0))
    least_curvature: float = 1.0

    @property
    def query_rows(self) -> slice:
        """The rows of the query's pose in the normal equations; those of its intrinsics follow."""
        count = 6 * len(self.given.rotation)
        return slice(count, count + 6)

    def reference_motion(self, bundle: Bundle) -> Array:
        """Motion (V - 1, 6) of each reference from its given pose."""
        return bundle.poses[:-1].motion_from(self.given)

    def at(self, bundle: Bundle) -> Linearized:
        """The values of a bundle, linearized: few are only compared by their cost."""
        return self.by_view.at(bundle)

    def cost(self, there: Linearized) -> float:
        """Cost of the values; NaN if a point is behind a camera."""
        bundle, squared = there.bundle, (there.residual**2).sum(axis=0)
        motion = self.reference_motion(bundle).ravel()
        prior = float(motion @ self.information @ motion)
        if bundle.intrinsics.size:
            prior += float(self.intrinsics_information @ (bundle.intrinsics + self.intrinsics_offset) ** 2)
        if self.priors:
            prior += self.prior_weight * self.priors.cost(bundle.world_from_query)
        if self.by_view.planes is not None:
            prior += self.by_view.planes.cost(bundle.points)
        return cauchy_cost(squared, self.loss_scale_sigma) + prior

    def linearize(self, there: Linearized) -> NormalEquations:
        """See `optimize.Problem`."""
        bundle, equations = there.bundle, self.by_view.equations(there, self.loss_scale_sigma, self.least_curvature)
        query = self.query_rows
        references, intrinsics = slice(query.start), slice(query.stop, None)
        equations.pose_block[references, references] += self.information
        equations.pose_gradient[references] += self.information @ self.reference_motion(bundle).ravel()
        if bundle.intrinsics.size:
            errors = bundle.intrinsics + self.intrinsics_offset
            equations.pose_block[intrinsics, intrinsics] += np.diag(self.intrinsics_information)
            equations.pose_gradient[intrinsics] += self.intrinsics_information * errors
        if self.priors:
            gradient, information = self.of_priors(bundle.world_from_query)
            equations.pose_gradient[query] += gradient
            equations.pose_block[query, query] += information
        return equations

    def of_priors(self, world_from_query: RigidTransform) -> tuple[Array, Array]:
        """Gradient (6,) and information (6, 6) of half the priors' cost by a left perturbation of camera_from_world."""
        gradient, information = self.priors.gradient_and_information(world_from_query)
        to_world = world_jacobian(world_from_query)
        return self.prior_weight * to_world.T @ gradient, self.prior_weight * to_world.T @ information @ to_world

    def step(self, there: Linearized, equations: NormalEquations, damping: float) -> Linearized | None:
        """See `optimize.Problem`."""
        matrix, gradient, points = equations.reduced(damping)
        motion = solve_step(matrix, gradient)
        if motion is None:
            return None
        cameras = self.query_rows.stop
        moved = there.bundle.moved(motion[:cameras].reshape(-1, 6), points.steps(motion), motion[cameras:])
        return self.at(moved)

    def query_motion_sigma(self, before: Linearized, after: Linearized, equations: NormalEquations) -> float:
        """Length of the query's motion, intrinsics included, in standard deviations by the residuals.

        These are as if points and references were known, so the motion is no longer than this.
        """
        old, new = before.bundle, after.bundle
        step = np.concatenate([new.poses[-1:].motion_from(old.poses[-1:]).ravel(), new.intrinsics - old.intrinsics])
        unknowns = slice(self.query_rows.start, None)
        return math.sqrt(step @ equations.pose_block[unknowns, unknowns] @ step)


def free_problem(
    tracks: Tracks,
    views: Sequence[PosedView],
    structure: Structure,
    chosen: NDArray[np.bool_] | NDArray[np.intp],
    loss_scale_sigma: float,
    *,
    times_used: Array | float = 1.0,
) -> tuple[BundleProblem, Bundle, float]:
    """Sets up an adjustment with free references: the problem, its start, and the median depth of the points, metres.

    The tracks of the chosen points of the structure are over the views: the references, then the query. A keypoint that
    is used in several problems of a sum is one measurement: its variance is multiplied by their number (O,).
    """
    observations = observe(tracks, views, structure.noise)
    observations = replace(observations, sigma_px=observations.sigma_px * np.sqrt(times_used))
    start = Bundle(Poses.of(view.world_from_camera for view in views), structure.x_in_world[chosen])
    planes = None if structure.planes is None else structure.planes[chosen]
    by_view, size = ViewColumns.of(observations, len(views), planes), 6 * len(views) - 6
    problem = BundleProblem(observations, by_view, start.poses[:-1], np.zeros((size, size)), loss_scale_sigma)
    return problem, start, float(np.median(observations.in_camera(start.points)[2]))
