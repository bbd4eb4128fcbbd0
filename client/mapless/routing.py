"""The scene of a call as metadata, for load balancers.

A load balancer does not read messages. With this metadata it can route all calls of a scene to one server, which then
has the scene's references in memory. Servers ignore it and use the request.
"""

from typing import Any

from google.protobuf.message import Message

from . import names

SCENE_KEY = "x-mapless-scene"
_FIELDS = ("scene", "name", "scene_id")
"""Fields of requests that contain it: the scene's name, the name of a scene or reference, or the id of a new scene."""


def scene_metadata(request: Message) -> tuple[tuple[str, str], ...]:
    """("x-mapless-scene", "scenes/{scene}") of a request that concerns one scene; else empty.

    Also empty for an invalid name, which may be unfit for metadata and which the server reports. A valid name is
    visible ASCII of at most 135 bytes.
    """
    descriptor: Any = request.DESCRIPTOR
    name_field = next((field for field in _FIELDS if field in descriptor.fields_by_name), None)
    if name_field is None:
        return ()
    value = getattr(request, name_field)
    if isinstance(value, Message):  # the scene itself
        value = getattr(value, "name", "")
    try:
        scene_id = names.check_id(value) if name_field == "scene_id" else _scene_of(value)
    except ValueError:
        return ()
    return ((SCENE_KEY, names.scene_name(scene_id)),)


def _scene_of(name: str) -> str:
    """The scene's id in the name of a scene or a reference."""
    return names.parse_reference_name(name)[0] if "/references/" in name else names.parse_scene_name(name)
