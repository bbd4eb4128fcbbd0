"""Laws of accepted values, shared by the targets."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from google.protobuf.message import Message

from mapless import wire
from mapless.geometry import MAX_COORDINATE_M, Camera, RigidTransform
from mapless.wire import FieldError
from mapless_server.errors import InvalidArgument, RequestError
from mapless_server.rpc import to_status
from mapless_tools.ingest.formats.collecting import check_camera

_TRAILER_BYTES = 8192
"""The bytes that gRPC gives all of a call's trailers; base64 makes four bytes of three."""


def check_pose(pose: RigidTransform, max_coordinate_m: float = MAX_COORDINATE_M) -> None:
    """It is a finite rigid motion, and the one that it is after it went over the wire."""
    assert pose.rotation.shape == (3, 3)
    assert pose.translation.shape == (3,)
    assert np.isfinite(pose.translation).all()
    assert np.abs(pose.translation).max() <= max_coordinate_m
    assert np.abs(pose.rotation @ pose.rotation.T - np.eye(3)).max() < 1e-9
    assert np.linalg.det(pose.rotation) > 0
    again = wire.transform_from_message(wire.transform_to_message(pose), "pose", max_coordinate_m)
    assert np.abs(again.rotation - pose.rotation).max() < 1e-9
    assert (again.translation == pose.translation).all()


def check_received_camera(camera: Camera) -> None:
    """It is a camera, and the one that it is after it went over the wire."""
    check_camera(camera)
    assert wire.camera_from_message(wire.camera_to_message(camera), "camera") == camera


def check_covariance(covariance: np.ndarray, size: int) -> None:
    """It is finite, symmetric and of full rank, so that it can be divided by."""
    assert covariance.shape == (size, size)
    assert np.isfinite(covariance).all()
    assert (covariance == covariance.T).all()
    assert np.isfinite(np.linalg.inv(covariance)).all()
    np.linalg.cholesky(covariance)


def check_unit(direction: np.ndarray) -> None:
    """It has unit length."""
    assert direction.shape == (3,)
    assert abs(math.hypot(*direction) - 1) < 1e-9


def answered(request: Message, answer: Callable[[], object]) -> bool:
    """Whether a request was accepted; what refuses it names a field of it, and fits into a call's trailers."""
    try:
        answer()
    except FieldError as error:
        _check_refusal(request, InvalidArgument(str(error), field=error.field))
    except RequestError as error:
        _check_refusal(request, error)
    else:
        return True
    return False


def _check_refusal(request: Message, error: RequestError) -> None:
    status = to_status(error)
    assert len(status.SerializeToString()) * 4 / 3 < _TRAILER_BYTES, str(error)[:200]
    assert error.code != "INTERNAL"
    if isinstance(error, InvalidArgument):
        assert error.field, str(error)
        _check_path(request, error.field)


def _check_path(message: Message, path: str) -> None:
    """A program that reads the answer must find the field."""
    name, _, rest = path.partition(".")
    name, _, index = name.partition("[")
    kind: Any = message.DESCRIPTOR
    assert name in kind.fields_by_name, path
    value = getattr(message, name)
    if index:
        value = value[int(index.removesuffix("]"))]
    if rest:
        assert isinstance(value, Message), path
        _check_path(value, rest)
