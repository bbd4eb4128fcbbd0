"""Priors in another world than the one that they were given in, for photographs that may be of several scenes."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from mapless.geometry import Array, RigidTransform

from .priors import DirectionPrior, PosePrior, PositionPrior, Priors

MIN_SIGMA_RATIO = 1e-5
"""Ratio of standard deviations that rounding leaves of a covariance when its axes are turned."""

Direction = TypeVar("Direction", bound=DirectionPrior)


def moved_priors(priors: Priors, other_from_world: RigidTransform) -> Priors:
    """The priors in another world, in which the world that they are given in has a pose.

    A position p becomes R p + t, a direction R d, and each three axes of a covariance C become R C R^T, with the
    variance of `MIN_SIGMA_RATIO` of the largest one added in all directions.
    """
    it = priors
    return Priors(
        it.position and _moved_position(it.position, other_from_world),
        it.heading and _moved_direction(it.heading, other_from_world),
        it.gravity and _moved_direction(it.gravity, other_from_world),
        it.pose and _moved_pose(it.pose, other_from_world),
    )


def _moved_position(prior: PositionPrior, other_from_world: RigidTransform) -> PositionPrior:
    return PositionPrior(other_from_world.apply(prior.position), _turned(prior.covariance, other_from_world))


def _moved_direction(prior: Direction, other_from_world: RigidTransform) -> Direction:
    return replace(prior, in_world=other_from_world.rotation @ prior.in_world)


def _moved_pose(prior: PosePrior, other_from_world: RigidTransform) -> PosePrior:
    pose = other_from_world.compose(prior.world_from_camera)
    return PosePrior(pose, _turned(prior.covariance, other_from_world))


def _turned(covariance: Array, other_from_world: RigidTransform) -> Array:
    turn = np.kron(np.eye(len(covariance) // 3), other_from_world.rotation)
    largest = np.repeat(np.diag(covariance).reshape(-1, 3).max(axis=1), 3)
    turned = turn @ covariance @ turn.T + np.diag(MIN_SIGMA_RATIO**2 * largest)
    return np.asarray((turned + turned.T) / 2)
