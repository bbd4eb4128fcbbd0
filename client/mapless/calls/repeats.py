"""Retries of changes whose first answer was lost: they determine whether the lost attempt made the existing state.

The calls made here share the deadline of the change.
"""

import hashlib
from typing import Any

import numpy as np

from .. import wire
from ..errors import MaplessError, NotFound
from ..exchange import Call, Exchange
from ..geometry import Array
from ..names import reference_name, scene_name
from ..scenes import datum_from_message, direction_from_message
from ..v1 import reference_service_pb2 as pb

SERVICE = "mapless.v1.ReferenceService"
_SAME = 1e-9  # metres, degrees, entries of a rotation or direction: rounding errors of normalization
_PAGE_SIZE = 1000  # the server's maximum


def gone(error: MaplessError) -> Exchange[None]:
    """Success if an earlier attempt has deleted the resource (the error is NOT_FOUND); any other error is raised."""
    if error.code != "NOT_FOUND":
        raise error
    yield from ()


def created_scene(wanted: pb.CreateSceneRequest, error: MaplessError) -> Exchange[pb.Scene]:
    """Returns the existing scene if it is unchanged since creation and equals the wanted one; else raises the error."""
    if error.code != "ALREADY_EXISTS":
        raise error
    get = pb.GetSceneRequest(name=scene_name(wanted.scene_id))
    there: pb.Scene = (yield Call(f"{SERVICE}/GetScene", get, pb.GetSceneResponse)).scene
    ours, theirs = _of_world(wanted), _of_world(there)
    if there.generation != 1 or ours.shape != theirs.shape or not np.allclose(ours, theirs, rtol=0, atol=_SAME):
        raise error
    return there


def stored_reference(wanted: pb.CreateReferenceRequest, error: MaplessError) -> Exchange[pb.Reference]:
    """Returns the stored reference if it equals the wanted one; else raises the error."""
    if error.code != "ALREADY_EXISTS":
        raise error
    get = pb.GetReferenceRequest(name=reference_name(wanted.scene, wanted.reference_id))
    try:
        there: pb.Reference = (yield Call(f"{SERVICE}/GetReference", get, pb.GetReferenceResponse)).reference
    except NotFound:  # another client has deleted it
        raise error from None
    if difference(wanted.reference, there):
        raise error
    return there


def listed_references(scene: str, timeout_s: float | None) -> Exchange[dict[str, pb.Reference]]:
    """Lists all references of a scene, by name."""
    listed: dict[str, pb.Reference] = {}
    token = ""
    while True:
        request = pb.ListReferencesRequest(scene=scene, page_size=_PAGE_SIZE, page_token=token)
        page = yield Call(f"{SERVICE}/ListReferences", request, pb.ListReferencesResponse, timeout_s)
        listed |= {it.name: it for it in page.references}
        token = page.next_page_token
        if not token:
            return listed


def difference(wanted: pb.Reference, stored: pb.Reference) -> str:
    """What distinguishes two references of one name: "photograph", "intrinsics", "pose"; empty if they are equal."""
    if stored.image_sha256 != hashlib.sha256(wanted.image).hexdigest():
        return "photograph"
    if stored.intrinsics != wanted.intrinsics:
        return "intrinsics"
    ours, theirs = (wire.transform_from_message(it.world_from_camera, "").matrix() for it in (wanted, stored))
    return "" if np.allclose(ours, theirs, rtol=0, atol=_SAME) else "pose"


def _of_world(message: Any) -> Array:
    """Properties of a message's world as an array: unit, 12 numbers of the datum, if any, 3 of gravity's direction."""
    numbers: list[float] = [float(message.arbitrary_unit)]
    if message.HasField("datum"):
        datum = datum_from_message(message.datum, "datum")
        numbers += [datum.latitude_deg, datum.longitude_deg, datum.height_m, *datum.enu_from_world.matrix().flat]
    if message.HasField("down_in_world"):
        numbers += direction_from_message(message.down_in_world, "down_in_world")
    return np.array(numbers)
