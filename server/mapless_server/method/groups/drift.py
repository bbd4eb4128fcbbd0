"""A device's tracking: poses in a session's frame that drift, and what they say of each other all the same.

Between two frames the device says how it moved. That is wrong by so much for each metre and each degree, and by a
little where it stood still; errors of different steps have nothing to do with each other, so that they add up to drift.
Now and then a device loses itself and jumps, and some are worse than others: a step that turns out to be far wronger
than it should be is forgotten little by little (Cauchy's loss), not obeyed.

With an unknown unit of the session (its tracking has one camera and no other sensor), all steps share one scale more.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mapless.geometry import Array, RigidTransform, Similarity, cross_matrix

from ..options import check_bounds
from ..perturbation import perturbed, rotation_vector
from ..robust import cauchy_cost, cauchy_weight

_MEDIAN_SQUARE = 5.35
"""Median of a chi-square of six degrees of freedom."""


@dataclass(frozen=True)
class DriftOptions:
    """How wrong the steps of a session are: standard deviations of each axis.

    Attributes:
        share: of the distance travelled. What visual-inertial tracking of phones and headsets loses is about 1 % of it;
            twice that costs little where it is better, and much is lost where it is worse and believed.
        floor_m: and at least this, standing still.
        deg_per_m: of direction, for a metre travelled.
        turn_share: of direction, of the angle turned.
        floor_deg: and at least this.
        loss_scale: of Cauchy's loss, in standard deviations of a step of six numbers.
    """

    share: float = 0.02
    floor_m: float = 0.002
    deg_per_m: float = 0.3
    turn_share: float = 0.01
    floor_deg: float = 0.05
    loss_scale: float = 2.0

    def __post_init__(self) -> None:
        check_bounds(self, "share floor_m floor_deg loss_scale", above=0)
        check_bounds(self, "deg_per_m turn_share", at_least=0)

    def sigma(self, step: RigidTransform) -> Array:
        """(6,) of a metric step: metres, then radians."""
        length_m = float(np.linalg.norm(step.translation))
        turn_deg = math.degrees(float(np.linalg.norm(rotation_vector(step.rotation))))
        angle = math.radians(self.floor_deg + self.deg_per_m * length_m + self.turn_share * turn_deg)
        return np.repeat([self.floor_m + self.share * length_m, angle], 3)


@dataclass(frozen=True, eq=False)
class SequenceFreedom:
    """Frames move freely, but their steps are held to those of the session; see `joint.Freedom`.

    Its parameters are left perturbations (v, w) of every frame's camera_from_world, in order, and, if the unit of the
    session is unknown, the logarithm of the scale.

    Attributes:
        frames: camera_from_world of every frame, metric.
        steps: from each frame to the next as the session has them: camera i from camera i + 1, in its unit.
        scale: metres per unit of the session.
        scale_is_free: whether it is to be found.
        sigma: (F - 1, 6) of the steps.
        options: see there.
    """

    frames: tuple[RigidTransform, ...]
    steps: tuple[RigidTransform, ...]
    scale: float
    scale_is_free: bool
    sigma: Array
    options: DriftOptions = field(default_factory=DriftOptions)

    @staticmethod
    def of(
        world_from_camera: Sequence[RigidTransform],
        session_from_camera: Sequence[RigidTransform],
        scale: float,
        scale_is_free: bool,
        options: DriftOptions,
    ) -> SequenceFreedom:
        """Frames at these poses, in a session."""
        neighbours = itertools.pairwise(session_from_camera)
        steps = tuple(first.inverse().compose(second) for first, second in neighbours)
        metric = (replace(step, translation=scale * step.translation) for step in steps)
        sigma = np.array([options.sigma(step) for step in metric]).reshape(-1, 6)
        frames = tuple(pose.inverse() for pose in world_from_camera)
        return SequenceFreedom(frames, steps, scale, scale_is_free, sigma, options)

    @property
    def size(self) -> int:
        """See Freedom."""
        return 6 * len(self.frames) + self.scale_is_free

    def camera_from_world(self, image: int) -> RigidTransform:
        """See Freedom."""
        return self.frames[image]

    def jacobian(self, image: int) -> Array:
        """See Freedom."""
        jacobian = np.zeros((6, self.size))
        jacobian[:, 6 * image : 6 * image + 6] = np.eye(6)
        return jacobian

    def moved(self, step: Array) -> SequenceFreedom:
        """See Freedom."""
        motions = step[: 6 * len(self.frames)].reshape(-1, 6)
        frames = tuple(perturbed(frame, motion) for frame, motion in zip(self.frames, motions, strict=True))
        scale = self.scale * math.exp(step[-1]) if self.scale_is_free else self.scale
        return replace(self, frames=frames, scale=scale)

    def relaxed(self) -> SequenceFreedom:
        """With steps as uncertain as they have turned out to be, if that is more than before.

        A session is good or bad as a whole: its median step tells, which some that jump do not spoil.
        """
        if not self.steps:
            return self
        found = float(np.median((self.residuals() ** 2).sum(axis=1)))
        return replace(self, sigma=self.sigma * math.sqrt(max(1.0, found / _MEDIAN_SQUARE)))

    def cost(self) -> float:
        """See Freedom."""
        return cauchy_cost((self.residuals() ** 2).sum(axis=1), self._loss_scale)

    def residuals(self) -> Array:
        """(F - 1, 6): by how many standard deviations each step differs from the session's."""
        return np.array([self._error(i) for i in range(len(self.steps))]).reshape(-1, 6) / self.sigma

    def weights(self) -> Array:
        """(F - 1,) how much of each step is still believed, 0 to 1."""
        return cauchy_weight((self.residuals() ** 2).sum(axis=1), self._loss_scale)

    def equations(self) -> tuple[Array, Array]:
        """See Freedom."""
        matrix, gradient = np.zeros((self.size, self.size)), np.zeros(self.size)
        residuals, weights = self.residuals(), self.weights()
        for i, (residual, weight) in enumerate(zip(residuals, weights, strict=True)):
            jacobian = self._jacobian_of_error(i) / self.sigma[i][:, None]
            matrix += weight * jacobian.T @ jacobian
            gradient += weight * jacobian.T @ residual
        return matrix, gradient

    @property
    def _loss_scale(self) -> float:
        """Of the squares of six numbers."""
        return math.sqrt(6) * self.options.loss_scale

    def _step(self, i: int) -> RigidTransform:
        """Camera i from camera i + 1, as the poses have it."""
        return self.frames[i].compose(self.frames[i + 1].inverse())

    def _error(self, i: int) -> Array:
        """(6,): the step's shift less the session's, and the turn between them, in the axes of camera i."""
        step, said = self._step(i), self.steps[i]
        shift = step.translation - self.scale * said.translation
        return np.concatenate([shift, rotation_vector(step.rotation @ said.rotation.T)])

    def _jacobian_of_error(self, i: int) -> Array:
        """(6, N), for a small turn between the steps."""
        step, jacobian = self._step(i), np.zeros((6, self.size))
        jacobian[:3, 6 * i : 6 * i + 3] = np.eye(3)
        jacobian[:3, 6 * i + 3 : 6 * i + 6] = -cross_matrix(step.translation)
        jacobian[:3, 6 * i + 6 : 6 * i + 9] = -step.rotation
        jacobian[3:, 6 * i + 3 : 6 * i + 6] = np.eye(3)
        jacobian[3:, 6 * i + 9 : 6 * i + 12] = -step.rotation
        if self.scale_is_free:
            jacobian[:3, -1] = -self.scale * self.steps[i].translation
        return jacobian


def world_from_session_at(
    world_from_camera: RigidTransform, session_from_camera: RigidTransform, scale: float
) -> Similarity:
    """What puts a session into the world so that one of its frames is where it should be."""
    rotation = world_from_camera.rotation @ session_from_camera.rotation.T
    translation = world_from_camera.translation - scale * rotation @ session_from_camera.translation
    return Similarity(scale, rotation, translation)
