"""An answer's pose in the axes of whoever asked, and on the Earth."""

from __future__ import annotations

from mapless import wire
from mapless.axes import Axes, covariance_to, pose_to, world_from_session_in
from mapless.geodesy import Datum, geopose
from mapless.geometry import Array, RigidTransform
from mapless.v1 import localization_service_pb2 as pb

from .enums import enum_from_message, enum_to_message

MAX_SESSION_COORDINATE_M = 1e7
"""Where no device has tracked itself to; what is further is a mistake, and long sums of squares would lose digits."""


def axes_from_message(options: pb.LocalizeOptions) -> Axes:
    """The axes that a request speaks of its camera in; FieldError if there are no such axes."""
    return enum_from_message(options.axes, pb.Axes, Axes.OPENCV, "options.axes")


def session_from_message(request: pb.LocalizeRequest) -> RigidTransform | None:
    """Where the device believed its camera to be, in the request's axes; FieldError if it is no pose."""
    if not request.HasField("session_from_camera"):
        return None
    return wire.transform_from_message(request.session_from_camera, "session_from_camera", MAX_SESSION_COORDINATE_M)


def set_frames(
    message: pb.Localization,
    world_from_camera: RigidTransform,
    covariance: Array | None,
    axes: Axes,
    session_from_camera: RigidTransform | None,
    datum: Datum | None,
) -> None:
    """Puts a pose into an answer as its caller wants it, too: `in_axes`, and `geo_pose` where there is a datum.

    Args:
        message: the answer, changed.
        world_from_camera: OpenCV.
        covariance: (6, 6) as it is answered, so with the scene's calibration if there is one; None if there is none.
        axes: the caller's.
        session_from_camera: of the moment of capture, in these axes; None if the caller has said nothing of it.
        datum: the scene's.
    """
    message.in_axes.CopyFrom(framed_to_message(axes, world_from_camera, covariance, session_from_camera))
    if datum is not None:
        message.geo_pose.CopyFrom(geo_pose_to_message(world_from_camera, datum))


def framed_to_message(
    axes: Axes, world_from_camera: RigidTransform, covariance: Array | None, session_from_camera: RigidTransform | None
) -> pb.FramedPose:
    """Message of a pose in other axes; arguments as of `set_frames`."""
    message = pb.FramedPose(
        axes=enum_to_message(axes, pb.Axes),
        world_from_camera=wire.transform_to_message(pose_to(axes, world_from_camera)),
    )
    if covariance is not None:
        message.covariance.row_major.extend(covariance_to(axes, covariance).ravel().tolist())
    if session_from_camera is not None:
        world_from_session = world_from_session_in(axes, world_from_camera, session_from_camera)
        message.world_from_session.CopyFrom(wire.transform_to_message(world_from_session))
    return message


def geo_pose_to_message(world_from_camera: RigidTransform, datum: Datum) -> pb.GeoPose:
    """Message of a pose on the Earth, its zeros written."""
    found = geopose(world_from_camera, datum)
    q = found.quaternion
    return pb.GeoPose(
        position=pb.GeoPosition(lat=found.lat, lon=found.lon, h=found.h),
        quaternion=pb.GeoQuaternion(x=q.x, y=q.y, z=q.z, w=q.w),
    )
