"""Small motions of poses, and the coordinates in which errors and covariances are given.

A pose error is given as d = (x, y, z), the shift of the camera's centre c, and r = (rx, ry, rz), a rotation about the
fixed axes of the world (ROS's order):

    c' = c + d,    R_wc' = Exp(r) R_wc.

Solvers perturb camera_from_world = [R | t] from the left instead, with a shift v and a rotation w,

    [R | t]' = Exp(v, w) [R | t],    so that to first order    d = -R_wc v,    r = -R_wc w.

This moves the camera about its own centre, so no lever arm appears. Other conventions (t' = t + v with R' = Exp(w) R,
or with R' = R Exp(w)) have a lever arm as long as the camera is far from the world's origin. Derivatives: Sola, Deray,
Atchuthan 2018, "A micro Lie theory".
"""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from mapless.geometry import Array, Camera, RigidTransform, rotation_from_vector


def perturbed(target_from_source: RigidTransform, step: Array) -> RigidTransform:
    """The pose after a left perturbation (v, w) (6,): a rotation by w about the target's origin, then a shift by v."""
    rotation = rotation_from_vector(step[3:])
    return RigidTransform(rotation @ target_from_source.rotation, rotation @ target_from_source.translation + step[:3])


def moved(world_from_camera: RigidTransform, error: Array) -> RigidTransform:
    """Returns the pose after an error (6,), order x y z rx ry rz, about fixed world axes."""
    return RigidTransform(
        rotation_from_vector(error[3:]) @ world_from_camera.rotation, world_from_camera.translation + error[:3]
    )


def rotation_vector(rotation: Array) -> Array:
    """Inverse of `rotation_from_vector`: axis (3,) times angle, 0 to pi radians."""
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    cosine, sine = (float(np.trace(rotation)) - 1) / 2, float(np.linalg.norm(axis)) / 2
    if cosine < -0.5:  # near a half turn the axis vanishes from the differences
        return np.asarray(Rotation.from_matrix(rotation).as_rotvec())
    angle = math.atan2(sine, cosine)
    return np.asarray(axis / 2 * (angle / sine if sine > 1e-9 else 1.0))


def world_jacobian(world_from_camera: RigidTransform) -> Array:
    """Derivative (6, 6) of the world error (x y z rx ry rz) by a left perturbation (v, w) of camera_from_world."""
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = -world_from_camera.rotation
    return jacobian


def covariance_in_world(covariance: Array, world_from_camera: RigidTransform) -> Array:
    """Covariance (6, 6) of world_from_camera, order x y z rx ry rz, from that of a left perturbation (v, w)."""
    jacobian = world_jacobian(world_from_camera)
    turned = jacobian @ covariance @ jacobian.T
    return np.asarray((turned + turned.T) / 2)


def world_covariance(information: Array, world_from_camera: RigidTransform) -> Array:
    """The same from the information (6, 6), the inverse covariance, of a left perturbation (v, w) of camera_from_world.

    Directions without information are left out (pseudo-inverse).
    """
    covariance = np.asarray(np.linalg.pinv(information, hermitian=True), np.float64)
    return covariance_in_world(covariance, world_from_camera)


def motion_jacobian(x_in_camera: Array) -> Array:
    """Derivative (..., 3, 6) of Exp(v, w) x by the perturbation at zero: [I | -[x]x]."""
    jacobian = np.zeros((*x_in_camera.shape, 6))
    x, y, z = np.moveaxis(x_in_camera, -1, 0)
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = jacobian[..., 2, 2] = 1
    jacobian[..., 0, 4], jacobian[..., 0, 5] = z, -y
    jacobian[..., 1, 3], jacobian[..., 1, 5] = -z, x
    jacobian[..., 2, 3], jacobian[..., 2, 4] = y, -x
    return jacobian


def pose_columns(ideal: Array, focal: Array, inverse_depth: Array) -> Array:
    """Derivative (2, 6, M) of projections by a left perturbation of camera_from_world, in the unit of focal lengths.

    Of points that are seen at x / z, y / z (2, M), of inverse depths (M,); `focal` is (2, M) or (2, 1).
    """
    (u, v), (fx, fy) = ideal, focal
    jacobian = np.empty((2, 6, len(u)))
    jacobian[0, 0], jacobian[0, 1], jacobian[0, 3], jacobian[0, 5] = fx * inverse_depth, 0, -fx * u * v, -fx * v
    jacobian[1, 0], jacobian[1, 1], jacobian[1, 4], jacobian[1, 5] = 0, fy * inverse_depth, fy * u * v, fy * u
    jacobian[0, 2], jacobian[0, 4] = -jacobian[0, 0] * u, fx * (1 + u * u)
    jacobian[1, 2], jacobian[1, 3] = -jacobian[1, 1] * v, -fy * (1 + v * v)
    return jacobian


def pose_jacobian(camera: Camera, x_in_camera: Array) -> Array:
    """Derivative (2, 6, M) of the projections of points (M, 3), in pixels; NaN behind the camera."""
    x, y, z = np.where(x_in_camera[:, 2] > 0, x_in_camera.T, np.nan)
    return pose_columns(np.stack([x / z, y / z]), np.array([[camera.focal_x_px], [camera.focal_y_px]]), 1 / z)


def pose_hessian(camera: Camera, world_from_camera: RigidTransform, x_in_world: Array) -> Array:
    """J^T J (6, 6) of the projections in pixels by a left perturbation (v, w) of camera_from_world."""
    x, y = pose_jacobian(camera, world_from_camera.inverse().apply(x_in_world))
    return np.asarray(x @ x.T + y @ y.T)
