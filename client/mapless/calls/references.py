"""Scenes and references: create, get, update, list, delete; retrieval, audit and coverage."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

from numpy.typing import ArrayLike

from .. import wire
from ..errors import AlreadyExists, MaplessError
from ..exchange import Call, Exchange, Pages
from ..geodesy import Datum
from ..geometry import Camera, RigidTransform
from ..names import reference_name, reference_names, scene_name, shown
from ..options import ConnectOptions
from ..priors import Priors, set_priors
from ..requests import ImageSource, NewReference, create_request, read_image
from ..results import (
    Coverage,
    Reference,
    ReferenceAudit,
    RetrievedReference,
    Scene,
    audit_from_message,
    coverage_from_message,
    reference_from_message,
    retrieved_from_message,
    scene_from_message,
)
from ..scenes import UNCHANGED, Calibration, UnchangedType, calibration_to_message, datum_to_message
from ..v1 import reference_service_pb2 as pb
from . import repeats
from .repeats import SERVICE


def create_scene(
    scene_id: str,
    *,
    datum: Datum | None = None,
    down_in_world: ArrayLike | None = None,
    arbitrary_unit: bool = False,
    timeout_s: float | None = None,
) -> Exchange[Scene]:
    """Creates a scene without references.

    Args:
        scene_id: id of the scene.
        datum: position of its world on the Earth, if known.
        down_in_world: (3,) direction of gravity, of any length; None for the direction that the datum gives, if any.
        arbitrary_unit: whether its references' poses are in an arbitrary unit instead of metres.
        timeout_s: deadline of the call.
    """

    def found(error: MaplessError) -> Exchange[pb.CreateSceneResponse]:
        return pb.CreateSceneResponse(scene=(yield from repeats.created_scene(request, error)))

    request = pb.CreateSceneRequest(
        scene_id=scene_id,
        datum=None if datum is None else datum_to_message(datum),
        down_in_world=None if down_in_world is None else wire.vector_to_message(down_in_world),
        arbitrary_unit=arbitrary_unit,
    )
    response = yield Call(f"{SERVICE}/CreateScene", request, pb.CreateSceneResponse, timeout_s, on_repeat=found)
    return scene_from_message(response.scene)


def get_scene(scene: str, *, timeout_s: float | None = None) -> Exchange[Scene]:
    """Gets a scene."""
    request = pb.GetSceneRequest(name=scene_name(scene))
    response = yield Call(f"{SERVICE}/GetScene", request, pb.GetSceneResponse, timeout_s)
    return scene_from_message(response.scene, response.warnings)


def update_scene(
    scene: str,
    *,
    datum: Datum | UnchangedType | None = UNCHANGED,
    down_in_world: ArrayLike | UnchangedType | None = UNCHANGED,
    calibration: Calibration | UnchangedType | None = UNCHANGED,
    arbitrary_unit: bool | UnchangedType | None = UNCHANGED,
    timeout_s: float | None = None,
) -> Exchange[Scene]:
    """Changes properties of a scene. A property that is not given keeps its value; None deletes it.

    Args:
        scene: the scene.
        datum: position of its world on the Earth.
        down_in_world: (3,) direction of gravity, of any length; if deleted, the datum gives it, if there is one.
        calibration: measured factors of the radii of answers.
        arbitrary_unit: whether the unit of length is arbitrary instead of the metre; None is False. No pose changes.
        timeout_s: deadline of the call.
    """
    request = pb.UpdateSceneRequest(scene=pb.Scene(name=scene_name(scene)))
    values = {
        "datum": datum,
        "down_in_world": down_in_world,
        "calibration": calibration,
        "arbitrary_unit": arbitrary_unit,
    }
    request.update_mask.paths.extend(name for name, value in values.items() if value is not UNCHANGED)
    if datum is not None and datum is not UNCHANGED:
        request.scene.datum.CopyFrom(datum_to_message(datum))
    if down_in_world is not None and down_in_world is not UNCHANGED:
        request.scene.down_in_world.CopyFrom(wire.vector_to_message(down_in_world))
    if calibration is not None and calibration is not UNCHANGED:
        request.scene.calibration.CopyFrom(calibration_to_message(calibration))
    request.scene.arbitrary_unit = arbitrary_unit is True
    response = yield Call(f"{SERVICE}/UpdateScene", request, pb.UpdateSceneResponse, timeout_s)
    return scene_from_message(response.scene, response.warnings)


def list_scenes(*, page_size: int = 0, timeout_s: float | None = None) -> Pages[Scene]:
    """Lists all scenes by id, fetched page by page; the deadline holds for each page."""

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
    return reference_from_message(response.reference, response.warnings)


def add_batch(
    scene: str, requests: Sequence[pb.CreateReferenceRequest], timeout_s: float | None, there: dict[str, pb.Reference]
) -> Exchange[list[Reference]]:
    """Stores the references of one message that the scene does not have: either all of them or none.

    `there` are references that the scene is known to have, by name; they are listed into it if the server rejects a
    message because of one. AlreadyExists for one with the name of another photograph, camera or pose.
    """
    names = [reference_name(scene, it.reference_id) for it in requests]
    _check_equal(requests, names, there)
    new = [it for it, name in zip(requests, names, strict=True) if name not in there]
    request = pb.BatchCreateReferencesRequest(scene=scene_name(scene), requests=new)
    call = Call(
        f"{SERVICE}/BatchCreateReferences", request, pb.BatchCreateReferencesResponse, timeout_s, is_upload=True
    )
    try:
        response = (yield call) if new else pb.BatchCreateReferencesResponse()
    except AlreadyExists:  # an earlier upload, or an attempt whose answer was lost, has stored some
        there |= yield from repeats.listed_references(scene_name(scene), timeout_s)
        if not any(reference_name(scene, it.reference_id) in there for it in new):
            raise
        return (yield from add_batch(scene, requests, timeout_s, there))
    except MaplessError as error:
        _name_reference(error, new)
        raise
    added = {it.name: reference_from_message(it, response.warnings) for it in response.references}
    return [added[name] if name in added else reference_from_message(there[name]) for name in names]


def _check_equal(
    requests: Sequence[pb.CreateReferenceRequest], names: Sequence[str], there: Mapping[str, pb.Reference]
) -> None:
    """Raises AlreadyExists for a reference whose name another one has."""
    for request, name in zip(requests, names, strict=True):
        if what := name in there and repeats.difference(request.reference, there[name]):
            message = f"reference {shown(request.reference_id)} exists already, with another {what}"
            raise AlreadyExists("ALREADY_EXISTS", message, resource=name)


def _name_reference(error: MaplessError, requests: Sequence[pb.CreateReferenceRequest]) -> None:
    """Adds the reference's id to a batch's error; the index in the error counts within one of several messages."""
    place = re.match(r"requests\[(\d+)\]", error.field or "")
    if place is not None and int(place[1]) < len(requests):
        error.args = (f"{error.reason}: reference {shown(requests[int(place[1])].reference_id)}: {error.message}",)


def batches(
    scene: str, references: Iterable[NewReference], options: ConnectOptions
) -> Iterator[list[pb.CreateReferenceRequest]]:
    """Yields requests in the references' order, in batches that fit a message; a larger request is sent alone."""
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
    """Gets a reference, with its photograph if requested."""
    request = pb.GetReferenceRequest(name=reference_name(scene, reference), include_image=include_image)
    response = yield Call(f"{SERVICE}/GetReference", request, pb.GetReferenceResponse, timeout_s)
    return reference_from_message(response.reference)


def list_references(scene: str, *, page_size: int = 0, timeout_s: float | None = None) -> Pages[Reference]:
    """Lists a scene's references by id, without photographs, page by page; the deadline holds for each page."""

    def fetch(token: str) -> Exchange[tuple[list[Reference], str]]:
        request = pb.ListReferencesRequest(scene=scene_name(scene), page_size=page_size, page_token=token)
        page = yield Call(f"{SERVICE}/ListReferences", request, pb.ListReferencesResponse, timeout_s)
        return list(map(reference_from_message, page.references)), page.next_page_token

    return Pages(fetch)


def delete_reference(scene: str, reference: str, *, timeout_s: float | None = None) -> Exchange[None]:
    """Deletes a reference."""
    request = pb.DeleteReferenceRequest(name=reference_name(scene, reference))
    yield Call(f"{SERVICE}/DeleteReference", request, pb.DeleteReferenceResponse, timeout_s, on_repeat=repeats.gone)


def retrieve_references(
    image: ImageSource,
    camera: Camera,
    scene: str,
    count: int = 0,
    *,
    priors: Priors | None = None,
    timeout_s: float | None = None,
) -> Exchange[list[RetrievedReference]]:
    """Finds the references most similar to a photograph; `localize` chooses among twice as many by feature matches.

    Args:
        image: the photograph.
        camera: the camera that took it.
        scene: the scene to search.
        count: number of references, at most 1000; 0 for the server's default.
        priors: only references near the camera's prior position and heading are considered.
        timeout_s: deadline of the call.
    """
    request = pb.RetrieveReferencesRequest(
        scene=scene_name(scene), image=read_image(image), intrinsics=wire.camera_to_message(camera), count=count
    )
    set_priors(request, priors or Priors())
    response = yield Call(f"{SERVICE}/RetrieveReferences", request, pb.RetrieveReferencesResponse, timeout_s)
    return list(map(retrieved_from_message, response.references))


def audit_scene(
    scene: str, references: Sequence[str] = (), *, page_size: int = 0, timeout_s: float | None = None
) -> Pages[ReferenceAudit]:
    """Examines references of a scene against their neighbours, by id; results are yielded as they arrive.

    Args:
        scene: the scene.
        references: which references, at most 100; empty for all.
        page_size: references per call, about half a second of computation each; 0 for the server's default.
        timeout_s: deadline of each call.
    """
    named = reference_names(scene, references)

    def fetch(token: str) -> Exchange[tuple[list[ReferenceAudit], str]]:
        request = pb.AuditSceneRequest(scene=scene_name(scene), references=named, page_size=page_size, page_token=token)
        page = yield Call(f"{SERVICE}/AuditScene", request, pb.AuditSceneResponse, timeout_s)
        return list(map(audit_from_message, page.audits)), page.next_page_token

    return Pages(fetch)


def check_coverage(
    scene: str, world_from_camera: RigidTransform, camera: Camera, *, timeout_s: float | None = None
) -> Exchange[Coverage]:
    """Predicts whether a photograph taken at a pose would be localized."""
    request = pb.CheckCoverageRequest(
        scene=scene_name(scene),
        world_from_camera=wire.transform_to_message(world_from_camera),
        intrinsics=wire.camera_to_message(camera),
    )
    response = yield Call(f"{SERVICE}/CheckCoverage", request, pb.CheckCoverageResponse, timeout_s)
    return coverage_from_message(response)
