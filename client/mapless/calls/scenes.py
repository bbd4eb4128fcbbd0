"""Scenes: create, get, update, list, delete."""

from collections.abc import AsyncIterator, Mapping
from functools import partial
from typing import Any

from numpy.typing import ArrayLike

from .. import wire
from ..connection import Connection
from ..geodesy import Datum
from ..messages import scene_from_message
from ..names import scene_name
from ..results import Scene
from ..scenes import (
    UNCHANGED,
    AdoptionPolicy,
    Calibration,
    UnchangedType,
    adoption_to_message,
    calibration_to_message,
    datum_to_message,
)
from ..v1 import reference_service_pb2 as pb
from . import repeats
from .references import nothing


async def create_scene(
    connection: Connection,
    scene_id: str,
    *,
    datum: Datum | None = None,
    down_in_world: ArrayLike | None = None,
    arbitrary_unit: bool = False,
    labels: Mapping[str, str] | None = None,
    adoption: AdoptionPolicy | None = None,
    timeout_s: float | None = None,
) -> Scene:
    """Creates a scene without references.

    Args:
        scene_id: id of the scene.
        datum: position of its world on the Earth, if known.
        down_in_world: (3,) direction of gravity, of any length; None for the direction that the datum gives, if any.
        arbitrary_unit: whether its references' poses are in an arbitrary unit instead of metres.
        labels: what groups it with other scenes, such as {"site": "a", "floor": "2"}.
        adoption: which localized photographs become references; None for none.
        timeout_s: deadline of the call.
    """
    request = pb.CreateSceneRequest(
        scene_id=scene_id,
        datum=None if datum is None else datum_to_message(datum),
        down_in_world=None if down_in_world is None else wire.vector_to_message(down_in_world, "down_in_world"),
        arbitrary_unit=arbitrary_unit,
        labels=_labels(labels),
        adoption=None if adoption is None else adoption_to_message(adoption),
    )
    on_repeat = partial(repeats.created_scene, request)
    return await connection.call("CreateScene", request, _scene, timeout_s, on_repeat=on_repeat)


def _labels(labels: Mapping[str, str] | None) -> Mapping[str, str]:
    if labels is None:
        return {}
    wire.require(labels, Mapping, "labels", 'such as {"site": "a"}')
    for name, value in labels.items():
        wire.require(name, str, "a name in labels")
        wire.require(value, str, f"labels[{name!r}]")
    return labels


def _scene(response: Any) -> Scene:
    return scene_from_message(response.scene, response)


async def get_scene(connection: Connection, scene: str, *, timeout_s: float | None = None) -> Scene:
    """Gets a scene."""
    request = pb.GetSceneRequest(name=scene_name(scene))
    return await connection.call("GetScene", request, _scene, timeout_s)


async def update_scene(
    connection: Connection,
    scene: str,
    *,
    datum: Datum | UnchangedType | None = UNCHANGED,
    down_in_world: ArrayLike | UnchangedType | None = UNCHANGED,
    calibration: Calibration | UnchangedType | None = UNCHANGED,
    arbitrary_unit: bool | UnchangedType | None = UNCHANGED,
    labels: Mapping[str, str] | UnchangedType | None = UNCHANGED,
    adoption: AdoptionPolicy | UnchangedType | None = UNCHANGED,
    timeout_s: float | None = None,
) -> Scene:
    """Changes properties of a scene. A property that is not given keeps its value; None deletes it.

    Args:
        scene: the scene.
        datum: position of its world on the Earth.
        down_in_world: (3,) direction of gravity, of any length; if deleted, the datum gives it, if there is one.
        calibration: measured factors of the radii of answers.
        arbitrary_unit: whether the unit of length is arbitrary instead of the metre; None is False. No pose changes.
        labels: what groups it with other scenes, in place of all labels before.
        adoption: which localized photographs become references; None for none from now on, and keeps those adopted.
        timeout_s: deadline of the call.
    """
    request = pb.UpdateSceneRequest(scene=pb.Scene(name=scene_name(scene)))
    values = {
        "datum": datum,
        "down_in_world": down_in_world,
        "calibration": calibration,
        "arbitrary_unit": arbitrary_unit,
        "labels": labels,
        "adoption": adoption,
    }
    request.update_mask.paths.extend(name for name, value in values.items() if value is not UNCHANGED)
    if datum is not None and datum is not UNCHANGED:
        request.scene.datum.CopyFrom(datum_to_message(datum))
    if down_in_world is not None and down_in_world is not UNCHANGED:
        request.scene.down_in_world.CopyFrom(wire.vector_to_message(down_in_world, "down_in_world"))
    if calibration is not None and calibration is not UNCHANGED:
        request.scene.calibration.CopyFrom(calibration_to_message(calibration))
    if adoption is not None and adoption is not UNCHANGED:
        request.scene.adoption.CopyFrom(adoption_to_message(adoption))
    request.scene.arbitrary_unit = arbitrary_unit is True
    if labels is not UNCHANGED:
        request.scene.labels.update(_labels(labels))
    return await connection.call("UpdateScene", request, _scene, timeout_s)


async def list_scenes(
    connection: Connection,
    *,
    labels: Mapping[str, str] | None = None,
    page_size: int = 0,
    timeout_s: float | None = None,
) -> AsyncIterator[Scene]:
    """Lists the scenes with all of these labels by id, fetched page by page; the deadline holds for each page."""
    request = pb.ListScenesRequest(page_size=page_size, labels=_labels(labels))
    scenes = connection.listed("ListScenes", request, lambda page: map(scene_from_message, page.scenes), timeout_s)
    async for scene in scenes:
        yield scene


async def delete_scene(connection: Connection, scene: str, *, timeout_s: float | None = None) -> None:
    """Deletes a scene and all its references."""
    request = pb.DeleteSceneRequest(name=scene_name(scene))
    await connection.call("DeleteScene", request, nothing, timeout_s, on_repeat=repeats.gone)
