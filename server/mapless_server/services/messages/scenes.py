"""What requests say of a scene as a whole, and what is answered of it."""

from __future__ import annotations

from typing import Any

from mapless import names, wire
from mapless.scene_messages import (
    calibration_from_message,
    calibration_to_message,
    datum_from_message,
    datum_to_message,
    direction_from_message,
    direction_to_message,
)
from mapless.scenes import Calibration
from mapless.v1 import localization_service_pb2 as localization_pb
from mapless.v1 import reference_service_pb2 as pb
from mapless.wire import FieldError, joined
from mapless_server.store import ContradictingDown, SceneAttributes, SceneRecord


def scene_to_message(scene: SceneRecord) -> pb.Scene:
    """Message of a scene."""
    known = scene.attributes
    message = pb.Scene(
        name=names.scene_name(scene.scene_id),
        generation=scene.generation,
        reference_count=scene.reference_count,
        datum=datum_to_message(known.datum) if known.datum else None,
        down_in_world=direction_to_message(known.down_in_world) if known.down_in_world else None,
        calibration=calibration_to_message(known.calibration) if known.calibration else None,
    )
    message.create_time.FromDatetime(scene.create_time)
    return message


def attributes_from_message(request: pb.CreateSceneRequest) -> SceneAttributes:
    """What is known of a scene to be created; FieldError names what is none."""
    try:
        return SceneAttributes(
            datum_from_message(request.datum, "datum") if request.HasField("datum") else None,
            direction_from_message(request.down_in_world, "down_in_world")
            if request.HasField("down_in_world")
            else None,
        )
    except ContradictingDown as error:
        raise FieldError("down_in_world", str(error)) from None


def changes_from_message(request: pb.UpdateSceneRequest) -> dict[str, Any]:
    """Arguments of ``Store.update_scene``: what a request's mask names, None for what its scene lacks.

    Raises:
        FieldError: the mask is empty or names what cannot be changed, or a value is none.
    """
    paths = list(dict.fromkeys(request.update_mask.paths))
    if not paths:
        raise FieldError("update_mask", f"must name what to change: {', '.join(_READERS)}")
    for path in paths:
        if path not in _READERS:
            raise FieldError("update_mask", f"{names.shown(path)} is none of {', '.join(_READERS)}")
    scene = request.scene
    return {
        path: _READERS[path](getattr(scene, path), joined("scene", path)) if scene.HasField(path) else None
        for path in paths
    }


def _measured(message: pb.SceneCalibration, field: str) -> Calibration:
    """A calibration that says what it was measured with; when, the server says itself."""
    variants: wire.ProtoEnum = localization_pb.Variant
    if message.variant not in variants.values()[1:]:
        raise FieldError(joined(field, "variant"), f"must be one of Variant's values, is {message.variant}")
    measured = pb.SceneCalibration()
    measured.CopyFrom(message)
    measured.ClearField("create_time")  # ignored, so that it may be anything
    return calibration_from_message(measured, field)


_READERS: dict[str, Any] = {
    "datum": datum_from_message,
    "down_in_world": direction_from_message,
    "calibration": _measured,
}
