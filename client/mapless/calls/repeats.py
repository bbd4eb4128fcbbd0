"""Retries of changes whose first answer was lost: they determine whether the lost attempt made the existing state.

The calls made here share the deadline of the change.
"""

import hashlib
from typing import Any

import numpy as np

from .. import wire
from ..connection import Connection
from ..depth import depth_from_message
from ..errors import MaplessError, NotFound
from ..geometry import Array
from ..messages import reference_from_message, scene_from_message
from ..names import reference_name, scene_name
from ..provenance import UNKNOWN, provenance_from_message
from ..results import Reference, Scene
from ..scenes import AdoptionPolicy, adoption_from_message, datum_from_message, direction_from_message
from ..v1 import reference_service_pb2 as pb

_SAME = 1e-9  # metres, degrees, entries of a rotation or direction: rounding errors of normalization


async def gone(connection: Connection, error: MaplessError) -> None:
    """Success if an earlier attempt has deleted the resource (the error is NOT_FOUND); any other error is raised."""
    if error.code != "NOT_FOUND":
        raise error


async def created_scene(wanted: pb.CreateSceneRequest, connection: Connection, error: MaplessError) -> Scene:
    """Returns the existing scene if it is unchanged since creation and equals the wanted one; else raises the error."""
    if error.code != "ALREADY_EXISTS":
        raise error

    def read(response: pb.GetSceneResponse) -> Scene:
        there = response.scene
        ours, theirs = _of_world(wanted), _of_world(there)
        is_alike = ours.shape == theirs.shape and np.allclose(ours, theirs, rtol=0, atol=_SAME)
        is_alike = is_alike and dict(wanted.labels) == dict(there.labels) and _adoption(wanted) == _adoption(there)
        if there.generation != 1 or not is_alike:
            raise error
        return scene_from_message(there)

    return await connection.call("GetScene", pb.GetSceneRequest(name=scene_name(wanted.scene_id)), read)


def _adoption(message: Any) -> AdoptionPolicy | None:
    return adoption_from_message(message.adoption, "adoption") if message.HasField("adoption") else None


async def stored_reference(wanted: pb.CreateReferenceRequest, connection: Connection, error: MaplessError) -> Reference:
    """Returns the stored reference if it equals the wanted one; else raises the error."""
    if error.code != "ALREADY_EXISTS":
        raise error
    request = pb.GetReferenceRequest(name=reference_name(wanted.scene, wanted.reference_id))
    try:
        there = await connection.call("GetReference", request, lambda it: reference_from_message(it.reference))
    except NotFound:  # another client has deleted it
        raise error from None
    if difference(wanted.reference, there):
        raise error
    return there


def difference(wanted: pb.Reference, stored: Reference) -> str:
    """First difference between references of one name, "photograph" or "pose" for instance; empty if none."""
    if stored.image_sha256 != hashlib.sha256(wanted.image).hexdigest():
        return "photograph"
    if stored.mask_sha256 != (hashlib.sha256(wanted.mask).hexdigest() if wanted.HasField("mask") else ""):
        return "mask"
    is_kept = stored.provenance.source != UNKNOWN  # by servers that know depth, too
    if is_kept and stored.depth_sha256 != (
        depth_from_message(wanted.depth, "depth").sha256 if wanted.HasField("depth") else ""
    ):
        return "depth"
    if wire.camera_to_message(stored.camera) != wanted.intrinsics:
        return "intrinsics"
    ours = wire.transform_from_message(wanted.world_from_camera, "").matrix()
    if not np.allclose(ours, stored.world_from_camera.matrix(), rtol=0, atol=_SAME):
        return "pose"
    return "provenance" if is_kept and provenance_from_message(wanted.provenance, "") != stored.provenance else ""


def _of_world(message: Any) -> Array:
    """Properties of a message's world as an array: unit, 12 numbers of the datum, if any, 3 of gravity's direction."""
    numbers: list[float] = [float(message.arbitrary_unit)]
    if message.HasField("datum"):
        datum = datum_from_message(message.datum, "datum")
        numbers += [datum.latitude_deg, datum.longitude_deg, datum.height_m, *datum.enu_from_world.matrix().flat]
    if message.HasField("down_in_world"):
        numbers += direction_from_message(message.down_in_world, "down_in_world")
    return np.array(numbers)
