"""Scenes and references: create, get, change, list, delete."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..errors import MaplessError
from ..exchange import Call, Exchange, Pages
from ..geodesy import Datum
from ..options import ConnectOptions
from ..requests import NewReference, create_request
from ..results import Reference, Scene, reference_from_message, scene_from_message
from ..scene_messages import calibration_to_message, datum_to_message
from ..scenes import UNCHANGED, Calibration, UnchangedType
from ..v1 import geometry_pb2
from ..v1 import reference_service_pb2 as pb
from . import repeats
from .naming import reference_name, scene_name
from .repeats import SERVICE


def create_scene(
    scene_id: str,
    *,
    datum: Datum | None = None,
    down_in_world: ArrayLike | None = None,
    timeout_s: float | None = None,
) -> Exchange[Scene]:
    """A new scene, without references.

    Args:
        scene_id: its id.
        datum: where its world is on the Earth, if that is known.
        down_in_world: (3,) to where things fall, of any length; None: what the datum says, if there is one.
        timeout_s: deadline of the call.
    """

    def found(error: MaplessError) -> Exchange[pb.CreateSceneResponse]:
        return pb.CreateSceneResponse(scene=(yield from repeats.created_scene(request, error)))

    request = pb.CreateSceneRequest(
        scene_id=scene_id,
        datum=None if datum is None else datum_to_message(datum),
        down_in_world=None if down_in_world is None else _direction(down_in_world),
    )
    response = yield Call(f"{SERVICE}/CreateScene", request, pb.CreateSceneResponse, timeout_s, on_repeat=found)
    return scene_from_message(response.scene)


def get_scene(scene: str, *, timeout_s: float | None = None) -> Exchange[Scene]:
    """A scene."""
    request = pb.GetSceneRequest(name=scene_name(scene))
    response = yield Call(f"{SERVICE}/GetScene", request, pb.GetSceneResponse, timeout_s)
    return scene_from_message(response.scene)


def update_scene(
    scene: str,
    *,
    datum: Datum | UnchangedType | None = UNCHANGED,
    down_in_world: ArrayLike | UnchangedType | None = UNCHANGED,
    calibration: Calibration | UnchangedType | None = UNCHANGED,
    timeout_s: float | None = None,
) -> Exchange[Scene]:
    """Changes what is known of a scene as a whole; what is not given stays as it is, and None forgets it.

    Args:
        scene: the scene.
        datum: where its world is on the Earth.
        down_in_world: (3,) to where things fall, of any length; without it, what the datum says, if there is one.
        calibration: how far off answers were found to be.
        timeout_s: deadline of the call.
    """
    request = pb.UpdateSceneRequest(scene=pb.Scene(name=scene_name(scene)))
    values = {"datum": datum, "down_in_world": down_in_world, "calibration": calibration}
    request.update_mask.paths.extend(name for name, value in values.items() if value is not UNCHANGED)
    if datum is not None and datum is not UNCHANGED:
        request.scene.datum.CopyFrom(datum_to_message(datum))
    if down_in_world is not None and down_in_world is not UNCHANGED:
        request.scene.down_in_world.CopyFrom(_direction(down_in_world))
    if calibration is not None and calibration is not UNCHANGED:
        request.scene.calibration.CopyFrom(calibration_to_message(calibration))
    response = yield Call(f"{SERVICE}/UpdateScene", request, pb.UpdateSceneResponse, timeout_s)
    return scene_from_message(response.scene)


def list_scenes(*, page_size: int = 0, timeout_s: float | None = None) -> Pages[Scene]:
    """All scenes by id, fetched page by page; the deadline is each page's."""

    def fetch(token: str) -> Exchange[tuple[list[Scene], str]]:
        request = pb.ListScenesRequest(page_size=page_size, page_token=token)
        page = yield Call(f"{SERVICE}/ListScenes", request, pb.ListScenesResponse, timeout_s)
        return list(map(scene_from_message, page.scenes)), page.next_page_token

    return Pages(fetch)


def delete_scene(scene: str, *, timeout_s: float | None = None) -> Exchange[None]:
    """Deletes a scene and all its references."""
    request = pb.DeleteSceneRequest(name=scene_name(scene))
    yield Call(f"{SERVICE}/DeleteScene", request, pb.DeleteSceneResponse, timeout_s, on_repeat=repeats.gone)


def add_reference(scene: str, reference: NewReference, *, timeout_s: float | None = None) -> Exchange[Reference]:
    """Stores a reference."""
    request = create_request(scene_name(scene), reference)

    def found(error: MaplessError) -> Exchange[pb.CreateReferenceResponse]:
        return pb.CreateReferenceResponse(reference=(yield from repeats.stored_reference(request, error)))

    response = yield Call(f"{SERVICE}/CreateReference", request, pb.CreateReferenceResponse, timeout_s, on_repeat=found)
    return reference_from_message(response.reference)


def add_batch(
    scene: str, requests: Sequence[pb.CreateReferenceRequest], timeout_s: float | None
) -> Exchange[list[Reference]]:
    """Stores the references of one message, all or none."""

    def found(error: MaplessError) -> Exchange[pb.BatchCreateReferencesResponse]:
        stored = yield from repeats.stored_references(request, error)
        return pb.BatchCreateReferencesResponse(references=stored)

    request = pb.BatchCreateReferencesRequest(scene=scene_name(scene), requests=requests)
    response = yield Call(
        f"{SERVICE}/BatchCreateReferences",
        request,
        pb.BatchCreateReferencesResponse,
        timeout_s,
        is_upload=True,
        on_repeat=found,
    )
    return list(map(reference_from_message, response.references))


def batches(
    scene: str, references: Iterable[NewReference], options: ConnectOptions
) -> Iterator[list[pb.CreateReferenceRequest]]:
    """Requests in the references' order, as many together as fit a message; one that is too large goes alone."""
    batch: list[pb.CreateReferenceRequest] = []
    batch_bytes = 0
    for reference in references:
        request = create_request(scene_name(scene), reference)
        size_bytes = request.ByteSize()
        full = batch_bytes + size_bytes > options.batch_mib * 2**20 or len(batch) == options.batch_count
        if batch and full:
            yield batch
            batch, batch_bytes = [], 0
        batch.append(request)
        batch_bytes += size_bytes
    if batch:
        yield batch


def get_reference(
    scene: str, reference: str, *, include_image: bool = False, timeout_s: float | None = None
) -> Exchange[Reference]:
    """A reference, with its photograph if asked for."""
    request = pb.GetReferenceRequest(name=reference_name(scene, reference), include_image=include_image)
    response = yield Call(f"{SERVICE}/GetReference", request, pb.GetReferenceResponse, timeout_s)
    return reference_from_message(response.reference)


def list_references(scene: str, *, page_size: int = 0, timeout_s: float | None = None) -> Pages[Reference]:
    """A scene's references by id, without photographs, fetched page by page; the deadline is each page's."""

    def fetch(token: str) -> Exchange[tuple[list[Reference], str]]:
        request = pb.ListReferencesRequest(scene=scene_name(scene), page_size=page_size, page_token=token)
        page = yield Call(f"{SERVICE}/ListReferences", request, pb.ListReferencesResponse, timeout_s)
        return list(map(reference_from_message, page.references)), page.next_page_token

    return Pages(fetch)


def delete_reference(scene: str, reference: str, *, timeout_s: float | None = None) -> Exchange[None]:
    """Deletes a reference."""
    request = pb.DeleteReferenceRequest(name=reference_name(scene, reference))
    yield Call(f"{SERVICE}/DeleteReference", request, pb.DeleteReferenceResponse, timeout_s, on_repeat=repeats.gone)


def _direction(direction: ArrayLike) -> geometry_pb2.Vector3:
    x, y, z = map(float, np.asarray(direction, float))
    return geometry_pb2.Vector3(x=x, y=y, z=z)
