"""Bundle adjustment of cameras and points.

    min  sum_obs rho(|r_o|^2 / sigma_o^2) + sum_i |xi_i|^2 / sigma_prior^2      (Cauchy's loss)

over the poses of all cameras and the points; xi_i is the motion of a reference away from its given pose. The last
camera is the query, whose pose may have priors. The points are eliminated (Schur complement), which leaves a dense
system of 6 unknowns per camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, rotation_from_vector

from .arrays import invert_symmetric
from .observations import Linearization, Observations, linearize
from .optimize import cauchy_cost, solve_step
from .priors.known import NO_PRIORS, Priors
from .results import Structure
from .structure import observe
from .tracks import Tracks
from .views import PosedView


@dataclass(frozen=True, eq=False)
class Poses:
    """Several camera_from_world: rotation (V, 3, 3), translation (V, 3)."""

    rotation: Array
    translation: Array

    @staticmethod
    def of(world_from_camera: Iterable[RigidTransform]) -> Poses:
        """From world_from_camera."""
        poses = [it.inverse() for it in world_from_camera]
        if not poses:
            return Poses(np.empty((0, 3, 3)), np.empty((0, 3)))
        return Poses(np.stack([it.rotation for it in poses]), np.stack([it.translation for it in poses]))

    def __getitem__(self, chosen: NDArray[np.intp] | slice) -> Poses:
        return Poses(self.rotation[chosen], self.translation[chosen])

    def and_last(self, camera_from_world: RigidTransform) -> Poses:
        """With another pose appended."""
        return Poses(
            np.concatenate([self.rotation, camera_from_world.rotation[None]]),
            np.concatenate([self.translation, camera_from_world.translation[None]]),
        )

    def moved(self, motion: Array) -> Poses:
        """After left perturbations (V, 6)."""
        turn = np.stack([rotation_from_vector(w) for w in motion[:, 3:]])
        return Poses(turn @ self.rotation, (turn @ self.translation[:, :, None])[..., 0] + motion[:, :3])

    def motion_from(self, given: Poses) -> Array:
        """(V, 6): the left perturbations from `given` to these poses, if small."""
        turn = self.rotation @ np.swapaxes(given.rotation, 1, 2)
        shift = self.translation - (turn @ given.translation[:, :, None])[..., 0]
        skew = (turn - np.swapaxes(turn, 1, 2)) / 2
        return np.asarray(np.concatenate([shift, skew[:, [2, 0, 1], [1, 2, 0]]], axis=1))


@dataclass(frozen=True, eq=False)
class Bundle:
    """Poses of the references, then the query, and points (P, 3)."""

    poses: Poses
    points: Array

    def moved(self, motion: Array, steps: Array) -> Bundle:
        """After left perturbations (V, 6) of the poses and steps (P, 3) of the points."""
        return Bundle(self.poses.moved(motion), self.points + steps)

    @property
    def world_from_query(self) -> RigidTransform:
        """The query's pose."""
        return RigidTransform(self.poses.rotation[-1], self.poses.translation[-1]).inverse()


@dataclass(frozen=True, eq=False)
class BundleProblem:
    """The cost and its derivatives; see `optimize.Problem`.

    Attributes:
        observations: of the points in all views; their poses are not used.
        view: (O,) of each.
        given: poses of the references.
        information: (V - 1, 6) of the prior that holds them there; 0 leaves them free.
        loss_scale_sigma: of the Cauchy loss.
        priors: on the query's pose.
        prior_weight: factor on their cost, relative to that of the observations.
    """

    observations: Observations
    view: NDArray[np.intp]
    given: Poses
    information: Array
    loss_scale_sigma: float
    priors: Priors = NO_PRIORS
    prior_weight: float = 1.0

    @cached_property
    def pick(self) -> Array:
        """(V, O): row v picks camera v's observations, so that sums over cameras become one matrix product."""
        return np.asarray((self.view == np.arange(len(self.information) + 1)[:, None]).astype(float))

    def at(self, bundle: Bundle) -> Observations:
        """The observations by cameras at these poses."""
        return self.observations.moved(bundle.poses.rotation[self.view], bundle.poses.translation[self.view])

    def reference_motion(self, bundle: Bundle) -> Array:
        """(V - 1, 6): the motion of each reference away from its given pose."""
        return bundle.poses[:-1].motion_from(self.given)

    def cost(self, bundle: Bundle) -> float:
        """NaN for a point behind a camera."""
        squared = (self.at(bundle).residuals(bundle.points) ** 2).sum(axis=1)
        prior = float((self.reference_motion(bundle) ** 2 * self.information).sum())
        if self.priors:
            prior += self.prior_weight * self.priors.cost(bundle.world_from_query)
        return cauchy_cost(squared, self.loss_scale_sigma) + prior

    def rows(self, bundle: Bundle) -> Linearization:
        """The observations linearized."""
        return linearize(self.at(bundle), bundle.points, self.loss_scale_sigma)

    def linearize(self, bundle: Bundle) -> NormalEquations:
        """See optimize.Problem."""
        rows = self.rows(bundle)
        weight, by_point, by_pose = rows.weight, rows.by_point, rows.by_pose
        weighted_point = np.swapaxes(by_point * weight[:, None, None], 1, 2)
        weighted_pose = np.swapaxes(by_pose * weight[:, None, None], 1, 2)
        error = rows.residual[:, :, None]

        pose_block = (self.pick @ (weighted_pose @ by_pose).reshape(-1, 36)).reshape(-1, 6, 6)
        pose_gradient = self.pick @ (weighted_pose @ error)[..., 0]
        pose_block[:-1] += self.information[:, :, None] * np.eye(6)
        pose_gradient[:-1] += self.information * self.reference_motion(bundle)
        if self.priors:
            known_gradient, known = self._query_terms(bundle.world_from_query)
            pose_gradient[-1] += known_gradient
            pose_block[-1] += known
        cross = np.zeros((len(bundle.points), len(pose_block), 6, 3))
        cross[self.observations.point, self.view] = weighted_pose @ by_point  # one observation per point and view
        return NormalEquations(
            pose_block,
            pose_gradient.ravel(),
            self.observations.sum_by_point(weighted_point @ by_point),
            self.observations.sum_by_point((weighted_point @ error)[..., 0]),
            cross.reshape(len(bundle.points), -1, 3),
        )

    def step(self, bundle: Bundle, equations: NormalEquations, damping: float) -> Bundle | None:
        """See optimize.Problem."""
        matrix, gradient, inverse = equations.reduced(damping)
        motion = solve_step(matrix, gradient)
        if motion is None:
            return None
        return bundle.moved(motion.reshape(-1, 6), equations.point_steps(motion, inverse))

    def _query_terms(self, world_from_query: RigidTransform) -> tuple[Array, Array]:
        """Gradient (6,) and information (6, 6) of the query's priors, by a left perturbation of camera_from_world.

        That moves the centre by -R v and turns the camera by -R w about fixed axes (see `world_covariance`).
        """
        gradient, information = self.priors.gradient_and_information(world_from_query)
        turn = -np.kron(np.eye(2), world_from_query.rotation)
        return self.prior_weight * turn.T @ gradient, self.prior_weight * turn.T @ information @ turn


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """[B E; E^T C] [d_pose; d_point] = -[g; h], where B and C are block-diagonal.

    Attributes:
        pose_block: B, (V, 6, 6).
        pose_gradient: g, (6 V,).
        point_block: C, (P, 3, 3).
        point_gradient: h, (P, 3).
        cross: E, (P, 6 V, 3).
    """

    pose_block: Array
    pose_gradient: Array
    point_block: Array
    point_gradient: Array
    cross: Array

    def reduced(self, damping: float) -> tuple[Array, Array, Array]:
        """B - E C^-1 E^T (6 V, 6 V), g - E C^-1 h (6 V,) and C^-1 (P, 3, 3), diagonals enlarged by `damping`."""
        damped_points = self.point_block * (1 + damping * np.eye(3))
        inverse = invert_symmetric(damped_points)
        size = self.cross.shape[1]
        wide = np.swapaxes(self.cross, 0, 1).reshape(size, -1)  # (6 V, 3 P)
        gained = np.swapaxes(self.cross @ inverse, 0, 1).reshape(size, -1)
        matrix = -gained @ wide.T
        for v, block in enumerate(self.pose_block * (1 + damping * np.eye(6))):
            matrix[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] += block
        return matrix, self.pose_gradient - gained @ self.point_gradient.ravel(), inverse

    def point_steps(self, motion: Array, inverse: Array) -> Array:
        """Steps (P, 3) of the points after a motion (6 V,) of the cameras; `inverse` as from `reduced`."""
        back = self.point_gradient + np.swapaxes(self.cross, 1, 2) @ motion
        return np.asarray(-(inverse @ back[:, :, None])[..., 0])


def bundle_of(
    tracks: Tracks, views: Sequence[PosedView], structure: Structure, chosen: NDArray[np.bool_] | NDArray[np.intp]
) -> tuple[Observations, Bundle, float]:
    """The observations of points of a structure, the initial bundle, and the points' median depth in metres.

    Args:
        tracks: of these points over the views.
        views: the references, then the query.
        structure: the points.
        chosen: mask or indices of the points to use.
    """
    observations = observe(tracks, views, structure.noise)
    bundle = Bundle(Poses.of(view.world_from_camera for view in views), structure.x_in_world[chosen])
    return observations, bundle, float(np.median(observations.in_camera(bundle.points)[:, 2]))


def reference_information(level_px: float, focal_px: float, depth_m: float) -> Array:
    """(6,): inverse variance of a left perturbation, each component of which moves the image by `level_px`.

    A pixel is a rotation of 1 / f, or a shift of depth / f.
    """
    angle = level_px / focal_px
    return np.repeat([angle * depth_m, angle], 3) ** -2.0
