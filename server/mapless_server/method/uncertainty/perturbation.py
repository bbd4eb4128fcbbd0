"""Errors of a pose: their coordinates, and how a covariance changes from one to the other.

What we answer is the covariance of world_from_camera in ROS's order (x y z rx ry rz): the camera's centre c moves by
d = (x, y, z), and the camera turns by Exp(r), r = (rx, ry, rz), about the fixed axes of the world,

    c' = c + d,    R_wc' = Exp(r) R_wc.

Solvers perturb camera_from_world = [R | t] instead, with R = R_wc^T and t = -R c, in one of three ways that are easily
taken for one another. With a shift v and a turn w, to first order:

    SE3_LEFT          [R | t]' = Exp(v, w) [R | t]          d = -R_wc v                  r = -R_wc w
    DECOUPLED_LEFT    R' = Exp(w) R,  t' = t + v            d = -R_wc v - R_wc [t]x w    r = -R_wc w
    DECOUPLED_RIGHT   R' = R Exp(w),  t' = t + v            d = -R_wc v + [c]x w         r = -w

The first moves the camera about its own centre, so that no lever arm appears; it is the one used here throughout. In
the others the arm is as long as the camera is far from the world's origin, and leaving it out (or its sign) is an error
as large as the answer. (Sola, Deray, Atchuthan 2018, "A micro Lie theory", has the derivatives; the tests check all
three against drawn errors.)
"""

from __future__ import annotations

from enum import Enum

import numpy as np

from mapless.geometry import Array, Camera, RigidTransform, cross_matrix, normalize_jacobian


class Perturbation(str, Enum):
    """How an error (v, w), shift first, changes camera_from_world; see the module."""

    SE3_LEFT = "se3_left"
    DECOUPLED_LEFT = "decoupled_left"
    DECOUPLED_RIGHT = "decoupled_right"


def world_jacobian(world_from_camera: RigidTransform, perturbation: Perturbation = Perturbation.SE3_LEFT) -> Array:
    """Derivative (6, 6) of the error in the world (x y z rx ry rz) by an error (v, w) of camera_from_world."""
    rotation, centre = world_from_camera.rotation, world_from_camera.translation
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = -rotation
    if perturbation is Perturbation.DECOUPLED_LEFT:
        jacobian[:3, 3:] = -rotation @ cross_matrix(world_from_camera.inverse().translation)
    elif perturbation is Perturbation.DECOUPLED_RIGHT:
        jacobian[:3, 3:], jacobian[3:, 3:] = cross_matrix(centre), -np.eye(3)
    return jacobian


def world_covariance(
    information: Array, world_from_camera: RigidTransform, perturbation: Perturbation = Perturbation.SE3_LEFT
) -> Array:
    """Covariance (6, 6) of world_from_camera, order x y z rx ry rz about fixed world axes.

    Args:
        information: (6, 6) inverse covariance of an error (v, w) of camera_from_world. Directions of which it knows
            nothing are left out (pseudo-inverse).
        world_from_camera: the pose.
        perturbation: what the error is.
    """
    jacobian = world_jacobian(world_from_camera, perturbation)
    covariance = jacobian @ np.linalg.pinv(information, hermitian=True) @ jacobian.T
    return np.asarray((covariance + covariance.T) / 2)


def motion_jacobian(x_in_camera: Array) -> Array:
    """Derivative (..., 3, 6) of Exp(v, w) x by the perturbation at zero: [I | -[x]x]."""
    jacobian = np.zeros((*x_in_camera.shape, 6))
    x, y, z = np.moveaxis(x_in_camera, -1, 0)
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = jacobian[..., 2, 2] = 1
    jacobian[..., 0, 4], jacobian[..., 0, 5] = z, -y
    jacobian[..., 1, 3], jacobian[..., 1, 5] = -z, x
    jacobian[..., 2, 3], jacobian[..., 2, 4] = y, -x
    return jacobian


def pose_hessian(camera: Camera, world_from_camera: RigidTransform, x_in_world: Array) -> Array:
    """J^T J (6, 6) of the projections in pixels by a left perturbation (v, w) of camera_from_world."""
    x_in_camera = world_from_camera.inverse().apply(x_in_world)
    focal = np.array([camera.focal_x_px, camera.focal_y_px])
    jacobian = (normalize_jacobian(x_in_camera) * focal[:, None]) @ motion_jacobian(x_in_camera)
    return np.asarray(np.einsum("mia,mib->ab", jacobian, jacobian))
