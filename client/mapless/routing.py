"""Which scene a call concerns, where those between client and server see it.

A load balancer reads no messages. By this metadata it can send all calls of one scene to one server, which then has the
scene's references in memory. Servers ignore it: what counts is the request.
"""

from __future__ import annotations

from typing import Any

from google.protobuf.message import Message

from . import names

SCENE_KEY = "x-mapless-scene"
_FIELDS = ("scene", "name", "scene_id")
"""Where requests say it: by name, in the name of what they ask for, or, of a new one, by its id."""


def scene_metadata(request: Message) -> tuple[tuple[str, str], ...]:
    """("x-mapless-scene", "scenes/{scene}") of a request that concerns one scene; else nothing.

    What is no name gives nothing either: it might not travel, and the server says what is wrong with it. What is one
    is visible ASCII, at most 135 bytes long.
    """
    descriptor: Any = request.DESCRIPTOR
    told = next((field for field in _FIELDS if field in descriptor.fields_by_name), None)
    if told is None:
        return ()
    value = getattr(request, told)
    if isinstance(value, Message):  # the scene itself
        value = getattr(value, "name", "")
    try:
        scene_id = names.check_id(value) if told == "scene_id" else _scene_of(value)
    except ValueError:
        return ()
    return ((SCENE_KEY, names.scene_name(scene_id)),)


def _scene_of(name: str) -> str:
    """The id of the scene that a name is of, or is in."""
    return names.parse_reference_name(name)[0] if "/references/" in name else names.parse_scene_name(name)
