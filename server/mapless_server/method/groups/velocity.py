"""How cameras moved while they read their photographs, by the poses that the device tracked.

Between two poses the device moved with a mean velocity: shift and rotation vector by their time. A velocity is taken
for a Gaussian process of the correlation exp(-|t| / `CORRELATION_S`), observed in the middle of each step: at the time
of a photograph it has a mean, and the poses leave a share of its standard deviation.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from mapless.geometry import Array, RigidTransform

from ..bundle.readout import RollingShutter, TrackedMotion
from ..optim.rotations import rotation_vector

CORRELATION_S = 0.5
"""Time after which the velocity of a hand or a robot has changed by most of itself. Evidence: rolling-shutter."""

LEAST_LEFT = 0.1
"""Least share of the standard deviation that is left: tracked velocities are off, too.

Of the usual 90 degrees/s it is 9: the error of two poses 0.1 s apart that are each off by 0.6 degrees. Not measured.
"""


def tracked_motions(
    session_from_camera: Sequence[RigidTransform],
    times_s: Sequence[float],
    shutters: Sequence[RollingShutter | None],
    scale_is_free: bool,
) -> list[TrackedMotion | None]:
    """The motion during each read-out; None without a rolling shutter, or where poses say nothing.

    Args:
        session_from_camera: tracked poses, in the order they were taken.
        times_s: their times, seconds; NaN where one is not known.
        shutters: the read-out of each photograph.
        scale_is_free: whether the session's unit is unknown: then the shifts are, too.
    """
    steps, motions = _steps(session_from_camera, times_s), list[TrackedMotion | None]()
    for pose, at_s, shutter in zip(session_from_camera, times_s, shutters, strict=True):
        is_known = shutter is not None and len(steps[0]) > 0 and not np.isnan(at_s)
        motions.append(_motion(pose, at_s, shutter, *steps, scale_is_free) if shutter and is_known else None)
    return motions


def _steps(poses: Sequence[RigidTransform], times_s: Sequence[float]) -> tuple[Array, Array]:
    """Middles of the steps between poses of known times, seconds (S,), and velocities (S, 6) in the session's axes."""
    known = [(time, pose) for time, pose in zip(times_s, poses, strict=True) if not np.isnan(time)]
    middles, velocities = list[float](), list[Array]()
    for (begin, first), (end, second) in pairwise(known):
        if end > begin:
            turn = rotation_vector(second.rotation @ first.rotation.T)
            velocities.append(np.concatenate([second.translation - first.translation, turn]) / (end - begin))
            middles.append((begin + end) / 2)
    return np.array(middles), np.array(velocities).reshape(-1, 6)


def _motion(
    pose: RigidTransform, at_s: float, shutter: RollingShutter, middles: Array, velocities: Array, scale_is_free: bool
) -> TrackedMotion:
    among = np.exp(-np.abs(middles[:, None] - middles) / CORRELATION_S)
    to_all = np.exp(-np.abs(middles - at_s) / CORRELATION_S)
    weight = np.asarray(np.linalg.lstsq(among, to_all, rcond=None)[0], float)
    left = max(LEAST_LEFT, math.sqrt(max(0.0, 1 - float(weight @ to_all))))
    # The camera goes through the world as the world goes past it, the other way.
    motion = np.asarray(-shutter.readout_s * (weight @ velocities), float)
    motion = np.concatenate([motion[:3] @ pose.rotation, motion[3:] @ pose.rotation])
    motion[:3] *= not scale_is_free
    return TrackedMotion(tuple(motion.tolist()), 1.0 if scale_is_free else left, left)
