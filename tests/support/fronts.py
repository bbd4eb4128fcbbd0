"""What is in front of several servers lets their errors pass as they are."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from mapless import Client, InvalidArgument, MaplessError, NotFound
from support.servers import CAMERA, PHOTO

FAILING_CALLS: dict[str, tuple[type[MaplessError], Callable[[Client, str], Any]]] = {
    "unknown scene": (NotFound, lambda client, _: client.localize(PHOTO, CAMERA, "nowhere")),
    "unknown reference": (NotFound, lambda client, scene: client.localize(PHOTO, CAMERA, scene, ("r", "lost"))),
    "bad image": (InvalidArgument, lambda client, scene: client.localize(b"no image", CAMERA, scene)),
    "bad camera": (InvalidArgument, lambda client, it: client.localize(PHOTO, replace(CAMERA, width_px=97), it)),
    "bad name": (InvalidArgument, lambda client, _: client.get_scene("no name")),
}
"""On a scene that is there."""


def assert_fails_alike(what: str, scene: str, direct: Client, through: Client) -> MaplessError:
    """With the same details by both ways; the error of the second."""
    expected, call = FAILING_CALLS[what]
    with pytest.raises(expected) as here:
        call(direct, scene)
    with pytest.raises(expected) as there:
        call(through, scene)
    for name in ("code", "reason", "message", "field", "retry_after_s"):
        assert getattr(there.value, name) == getattr(here.value, name), what
    assert there.value.request_id
    return there.value
