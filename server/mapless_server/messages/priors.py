"""What requests say of the camera beforehand, checked."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mapless.v1 import localization_service_pb2 as localization_pb
from mapless.wire import FieldError, vector_from_message

from ..retrieval.narrowing import HeadingPrior, Narrowing, PositionPrior


def narrowing_from_message(
    request: Any,
) -> Narrowing:
    """What `position_prior` and `heading_prior` of a LocalizeRequest or RetrieveReferencesRequest say.

    Raises:
        FieldError: one of them says nothing sensible.
    """
    return Narrowing(
        _position_from_message(request.position_prior) if request.HasField("position_prior") else None,
        _heading_from_message(request.heading_prior) if request.HasField("heading_prior") else None,
    )


def _position_from_message(message: localization_pb.PositionPrior) -> PositionPrior:
    if not message.HasField("position_m"):
        raise FieldError("position_prior.position_m", "is required")
    position = vector_from_message(message.position_m, "position_prior.position_m")
    if not 0 < message.radius_m < math.inf:
        raise FieldError("position_prior.radius_m", f"must be finite and above 0, is {message.radius_m:g}")
    return PositionPrior(position, message.radius_m)


def _heading_from_message(message: localization_pb.HeadingPrior) -> HeadingPrior:
    if not message.HasField("direction"):
        raise FieldError("heading_prior.direction", "is required")
    direction = vector_from_message(message.direction, "heading_prior.direction")
    length = math.hypot(*direction)
    if not 0 < length < math.inf:
        raise FieldError("heading_prior.direction", "must have a finite length above 0")
    if not 0 < message.max_angle_deg <= 180:
        raise FieldError("heading_prior.max_angle_deg", f"must be above 0, at most 180, is {message.max_angle_deg:g}")
    return HeadingPrior(np.asarray(direction) / length, message.max_angle_deg)
