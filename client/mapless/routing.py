"""Metadata by which load balancers keep the calls of a scene at the server that has it in memory."""

from typing import Any
from urllib.parse import urlencode

from google.protobuf.message import Message

from . import names
from .v1.localization_service_pb2 import LocalizeRequest, LocalizeRigRequest, LocalizeSequenceRequest

SCENE_KEY = "x-mapless-scene"
_FIELDS = ("scene", "name", "scene_id")
"""Fields of requests that contain it: the scene's name, the name of a scene or reference, or the id of a new scene."""
_AMONG_SEVERAL = (LocalizeRequest, LocalizeRigRequest, LocalizeSequenceRequest)
"""Requests that may name several scenes."""
_MAX_LABELS = 200
"""Characters of a group's labels; metadata is limited to some KB, and a call without a scene goes anywhere."""


def scene_metadata(request: Message) -> tuple[tuple[str, str], ...]:
    """("x-mapless-scene", "scenes/{scene}") of a request that concerns one scene, for load balancers; else empty.

    Of several scenes it is the first by name, and of a group "scenes?" with its labels as a query string, so that
    calls for the same scenes come to one server. Also empty for an invalid name, which may be unfit for metadata and
    which the server reports. A valid name is visible ASCII of at most 135 bytes.
    """
    several: Any = request if isinstance(request, _AMONG_SEVERAL) else None
    if several is not None and several.HasField("scene_group"):
        labels = urlencode(sorted(several.scene_group.labels.items()))
        return ((SCENE_KEY, f"scenes?{labels}"),) if len(labels) <= _MAX_LABELS else ()
    descriptor: Any = request.DESCRIPTOR
    name_field = next((field for field in _FIELDS if field in descriptor.fields_by_name), None)
    if name_field is None:
        return ()
    value = getattr(request, name_field)
    if not value and several is not None:
        value = min(several.scenes, default="")
    if isinstance(value, Message):  # the scene itself
        value = getattr(value, "name", "")
    try:
        if name_field == "scene_id":
            return ((SCENE_KEY, names.scene_name(names.check_id(value))),)
        is_reference = "/references/" in value
        scene_id = names.parse_reference_name(value)[0] if is_reference else names.parse_scene_name(value)
    except ValueError:
        return ()
    return ((SCENE_KEY, names.scene_name(scene_id)),)
