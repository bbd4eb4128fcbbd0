"""Drift of a device's tracking: relative poses of consecutive frames, with their noise.

The noise of a step between two frames grows with its length and angle, and has a floor. Steps have independent errors,
so that they add up to drift. Each step has a switch (see `optimize`), so that one with an error far beyond its noise
loses its weight; those at which the tracking jumps are cut (see `jumps`). If the unit of the session is unknown
(monocular tracking), all steps share one more unknown, the scale.
"""

import itertools
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapless.geometry import Array, RigidTransform, Similarity, cross_matrix

from ..optim.optimize import median_chi_square, perturbed, switched_cost, switched_weight
from ..optim.rotations import rotation_vector

SHARE, FLOOR_M = 0.012, 0.002
"""Noise of a step's position along each axis, as a share of the distance travelled, and what is added without motion.
Evidence: group-sequences."""

DEG_PER_M, TURN_SHARE, FLOOR_DEG = 0.3, 0.01, 0.05
"""Noise of its direction about each axis: per metre travelled, as a share of the angle turned, and what is added."""

LOSS_SCALE = math.sqrt(6) * 2.0
"""Scale of the switched loss, for the squared norm of a step's six numbers, in standard deviations."""


def step_size(step: RigidTransform) -> tuple[float, float]:
    """Length of a step, in the session's unit, and its angle, degrees."""
    return float(np.linalg.norm(step.translation)), math.degrees(float(np.linalg.norm(rotation_vector(step.rotation))))


def step_sigma(length_m: Array, turn_deg: Array) -> tuple[Array, Array]:
    """Standard deviations (N,) of steps of these lengths and angles along, and about, each axis: metres and radians."""
    return FLOOR_M + SHARE * length_m, np.radians(FLOOR_DEG + DEG_PER_M * length_m + TURN_SHARE * turn_deg)


@dataclass(frozen=True, eq=False)
class SequenceState:
    """The poses of a sequence; its cost is the difference of its steps from the session's. See `problem.GroupState`.

    The parameters are left perturbations (v, w) of every frame's camera_from_world, in order, and, if the unit of the
    session is unknown, the logarithm of the scale.

    Attributes:
        frames: camera_from_world of every frame, metric.
        steps: from each frame to the next as the session has them: camera i from camera i + 1, in its unit.
        scale: metres per unit of the session.
        scale_is_free: whether it is estimated.
        sigma: (F - 1, 6) standard deviations of the steps; infinite for steps that are cut.
    """

    frames: tuple[RigidTransform, ...]
    steps: tuple[RigidTransform, ...]
    scale: float
    scale_is_free: bool
    sigma: Array

    @staticmethod
    def of(
        world_from_camera: Sequence[RigidTransform],
        session_from_camera: Sequence[RigidTransform],
        scale: float,
        scale_is_free: bool,
        cut: Collection[int] = (),
    ) -> "SequenceState":
        """Makes the state of frames at these poses, without the steps `cut`; step i is from frame i to frame i + 1."""
        neighbours = itertools.pairwise(session_from_camera)
        steps = tuple(first.inverse().compose(second) for first, second in neighbours)
        length, turn_deg = np.array([step_size(step) for step in steps]).reshape(-1, 2).T
        sigma = np.repeat(np.stack(step_sigma(scale * length, turn_deg), axis=1), 3, axis=1)
        sigma[list(cut)] = np.inf
        frames = tuple(pose.inverse() for pose in world_from_camera)
        return SequenceState(frames, steps, scale, scale_is_free, sigma)

    @property
    def size(self) -> int:
        """See GroupState."""
        return 6 * len(self.frames) + self.scale_is_free

    def camera_from_world(self, image: int) -> RigidTransform:
        """See GroupState."""
        return self.frames[image]

    def jacobian(self, image: int) -> Array:
        """See GroupState."""
        jacobian = np.zeros((6, self.size))
        jacobian[:, 6 * image : 6 * image + 6] = np.eye(6)
        return jacobian

    def moved(self, step: Array) -> "SequenceState":
        """See GroupState."""
        motions = step[: 6 * len(self.frames)].reshape(-1, 6)
        frames = tuple(perturbed(frame, motion) for frame, motion in zip(self.frames, motions, strict=True))
        scale = self.scale * math.exp(step[-1]) if self.scale_is_free else self.scale
        return replace(self, frames=frames, scale=scale)

    def relaxed(self) -> "SequenceState":
        """The same state with the noise of the steps enlarged to that observed.

        One factor for the whole session is estimated by the median over the steps, which jumps do not affect.
        """
        kept = np.isfinite(self.sigma[:, 0])
        if not kept.any():
            return self
        found = float(np.median((self.residuals()[kept] ** 2).sum(axis=1)))
        return replace(self, sigma=self.sigma * math.sqrt(max(1.0, found / median_chi_square(6))))

    def cost(self) -> float:
        """See GroupState."""
        return switched_cost((self.residuals() ** 2).sum(axis=1), LOSS_SCALE)

    def residuals(self) -> Array:
        """Difference (F - 1, 6) of each step from the session's, in standard deviations."""
        return np.array([self._error(i) for i in range(len(self.steps))]).reshape(-1, 6) / self.sigma

    def equations(self) -> tuple[Array, Array]:
        """See GroupState."""
        matrix, gradient = np.zeros((self.size, self.size)), np.zeros(self.size)
        residuals = self.residuals()
        weights = switched_weight((residuals**2).sum(axis=1), LOSS_SCALE)
        for i, (residual, weight) in enumerate(zip(residuals, weights, strict=True)):
            jacobian = self._jacobian_of_error(i) / self.sigma[i][:, None]
            matrix += weight * jacobian.T @ jacobian
            gradient += weight * jacobian.T @ residual
        return matrix, gradient

    def _step(self, i: int) -> RigidTransform:
        """Pose of camera i + 1 in camera i, from the frames' poses."""
        return self.frames[i].compose(self.frames[i + 1].inverse())

    def _error(self, i: int) -> Array:
        """Difference (6,) of a step from the session's: shift, then rotation, in the axes of camera i."""
        step, tracked = self._step(i), self.steps[i]
        shift = step.translation - self.scale * tracked.translation
        return np.concatenate([shift, rotation_vector(step.rotation @ tracked.rotation.T)])

    def _jacobian_of_error(self, i: int) -> Array:
        """Derivative (6, N) of `_error` by the parameters, if the rotation between the steps is small."""
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
    """Similarity that maps one frame of a session to its pose in the world."""
    rotation = world_from_camera.rotation @ session_from_camera.rotation.T
    translation = world_from_camera.translation - scale * rotation @ session_from_camera.translation
    return Similarity(scale, rotation, translation)
