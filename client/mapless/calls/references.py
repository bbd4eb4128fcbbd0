"""References: create, get, list, delete; retrieval, audit and coverage."""

import re
import warnings
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Iterator, Sequence
from contextlib import aclosing
from functools import partial
from typing import Any

from .. import wire
from ..connection import Connection
from ..depth import IgnoredDepth
from ..errors import AlreadyExists, MaplessError
from ..geometry import Camera, RigidTransform
from ..messages import read, reference_from_message
from ..names import reference_name, reference_names, scene_name, shown
from ..options import ConnectOptions
from ..priors import Priors, set_priors
from ..requests import ImageSource, NewReference, create_request, read_image, read_mask
from ..results import Coverage, Reference, ReferenceAudit, RetrievedReference
from ..v1 import reference_service_pb2 as pb
from . import repeats

PAGE_SIZE = 1000  # the server's maximum


def nothing(response: Any) -> None:
    """Reads a response without fields."""


async def add_reference(
    connection: Connection, scene: str, reference: NewReference, *, timeout_s: float | None = None
) -> Reference:
    """Stores a reference."""
    request = await connection.unblocked(create_request, scene_name(scene), reference)
    on_repeat = partial(repeats.stored_reference, request)
    stored = await connection.call("CreateReference", request, _reference, timeout_s, on_repeat=on_repeat)
    _check_depths([request], [stored])
    return stored


def _check_depths(requests: Iterable[pb.CreateReferenceRequest], stored: Iterable[Reference]) -> None:
    """Warns if a server has ignored depth because it is too old to know it."""
    both = zip(requests, stored, strict=True)
    if any(it.reference.HasField("depth") and not found.depth_sha256 for it, found in both):
        warnings.warn(IgnoredDepth(), stacklevel=2)


def _reference(response: Any) -> Reference:
    return reference_from_message(response.reference, getattr(response, "warnings", ()))


async def add_references(
    connection: Connection,
    scene: str,
    references: Iterable[NewReference],
    *,
    on_progress: Callable[[int], None] | None = None,
    timeout_s: float | None = None,
) -> list[Reference]:
    """Stores many references, in as many messages as needed.

    The next message is read and sent while the server computes the one before. A message is stored whole or not at all.
    When one fails, the references of other messages remain stored: call this again with all of them. Those that the
    scene has already, with the same photograph, intrinsics and pose, are not stored again, and are returned and counted
    like the others; AlreadyExists names one that the scene has with another photograph, intrinsics or pose.

    Args:
        scene: the scene.
        references: the references; files are read when they are sent. asyncio's client reads them in another thread.
        on_progress: called with the number stored so far, with those that were there, after each message.
        timeout_s: deadline of each message; None for `upload_timeout_s`.
    """
    stored: list[Reference] = []
    there: dict[str, Reference] = {}

    def add(batch: Sequence[pb.CreateReferenceRequest]) -> Coroutine[Any, Any, list[Reference]]:
        return add_batch(connection, scene, batch, timeout_s, there)

    async with aclosing(connection.pipelined(add, _batches(scene, references, connection.options))) as added:
        async for some in added:
            stored += some
            if on_progress is not None:
                on_progress(len(stored))
    return stored


async def add_batch(
    connection: Connection,
    scene: str,
    requests: Sequence[pb.CreateReferenceRequest],
    timeout_s: float | None,
    there: dict[str, Reference],
) -> list[Reference]:
    """Stores the references of one message that the scene does not have: either all of them or none.

    `there` are references that the scene is known to have, by name; they are listed into it if the server rejects a
    message because of one. AlreadyExists for one with the name of another photograph, camera or pose.
    """
    names = [reference_name(scene, it.reference_id) for it in requests]
    for name, wanted in zip(names, requests, strict=True):
        if what := name in there and repeats.difference(wanted.reference, there[name]):
            message = f"reference {shown(wanted.reference_id)} exists already, with another {what}"
            raise AlreadyExists("ALREADY_EXISTS", message, resource=name)
    new = [it for name, it in zip(names, requests, strict=True) if name not in there]
    request = pb.BatchCreateReferencesRequest(scene=scene_name(scene), requests=new)
    try:
        if new:
            there |= await connection.call("BatchCreateReferences", request, _by_name, timeout_s, is_upload=True)
    except AlreadyExists:  # an earlier upload, or an attempt whose answer was lost, has stored some
        known = {
            f"{scene_name(scene)}/references/{it.reference_id}": it
            async for it in list_references(connection, scene, page_size=PAGE_SIZE, timeout_s=timeout_s)
        }
        # Another message of this upload may have listed them meanwhile.
        if known.keys().isdisjoint(reference_name(scene, it.reference_id) for it in new):
            raise
        there |= known
        return await add_batch(connection, scene, requests, timeout_s, there)
    except MaplessError as error:
        _name_reference(error, new)
        raise
    stored = [there[name] for name in names]
    _check_depths(requests, stored)
    return stored


def _by_name(response: pb.BatchCreateReferencesResponse) -> dict[str, Reference]:
    return {it.name: reference_from_message(it, response.warnings) for it in response.references}


def _name_reference(error: MaplessError, requests: Sequence[pb.CreateReferenceRequest]) -> None:
    """Adds the reference's id to a batch's error; the index in the error counts within one of several messages."""
    place = re.match(r"requests\[(\d+)\]", error.field or "")
    if place is not None and int(place[1]) < len(requests):
        error.args = (f"{error.reason}: reference {shown(requests[int(place[1])].reference_id)}: {error.message}",)


def _batches(
    scene: str, references: Iterable[NewReference], options: ConnectOptions
) -> Iterator[list[pb.CreateReferenceRequest]]:
    """Yields requests in the references' order, in batches that fit a message; a larger request is sent alone."""
    batch: list[pb.CreateReferenceRequest] = []
    batch_bytes = 0
    for field, reference in wire.listed(references, NewReference, "references"):
        request = create_request(scene_name(scene), reference, field)
        size_bytes = request.ByteSize()
        full = batch_bytes + size_bytes > options.batch_mib * 2**20 or len(batch) == options.batch_count
        if batch and full:
            yield batch
            batch, batch_bytes = [], 0
        batch.append(request)
        batch_bytes += size_bytes
    if batch:
        yield batch


async def get_reference(
    connection: Connection, scene: str, reference: str, *, include_image: bool = False, timeout_s: float | None = None
) -> Reference:
    """Gets a reference, with its photograph if requested."""
    request = pb.GetReferenceRequest(name=reference_name(scene, reference), include_image=include_image)
    return await connection.call("GetReference", request, _reference, timeout_s)


async def list_references(
    connection: Connection,
    scene: str,
    *,
    only_adopted: bool = False,
    only_retired: bool = False,
    page_size: int = 0,
    timeout_s: float | None = None,
) -> AsyncIterator[Reference]:
    """Lists a scene's references, or some, by id, without photographs; the deadline holds for each page."""
    request = pb.ListReferencesRequest(
        scene=scene_name(scene), page_size=page_size, only_adopted=only_adopted, only_retired=only_retired
    )
    found = connection.listed(
        "ListReferences", request, lambda page: map(reference_from_message, page.references), timeout_s
    )
    async for reference in found:
        yield reference


async def delete_reference(
    connection: Connection, scene: str, reference: str, *, timeout_s: float | None = None
) -> None:
    """Deletes a reference."""
    request = pb.DeleteReferenceRequest(name=reference_name(scene, reference))
    await connection.call("DeleteReference", request, nothing, timeout_s, on_repeat=repeats.gone)


async def retrieve_references(
    connection: Connection,
    image: ImageSource,
    camera: Camera,
    scene: str,
    count: int = 0,
    *,
    priors: Priors | None = None,
    mask: ImageSource | None = None,
    timeout_s: float | None = None,
) -> list[RetrievedReference]:
    """Finds the references most similar to a photograph; `localize` chooses among twice as many by feature matches.

    Args:
        image: the photograph.
        camera: the camera that took it.
        scene: the scene to search.
        count: number of references, at most 1000; 0 for the server's default.
        priors: only references near the camera's prior position and heading are considered.
        mask: a PNG of the photograph's size, 0 at the pixels to ignore; None: all are used.
        timeout_s: deadline of the call.
    """
    request = pb.RetrieveReferencesRequest(
        scene=scene_name(scene),
        image=await connection.unblocked(read_image, image),
        mask=await connection.unblocked(read_mask, mask),
        intrinsics=wire.camera_to_message(camera),
    )
    wire.set_numbers(request, {"count": count})
    set_priors(request, priors or Priors())
    return await connection.call(
        "RetrieveReferences", request, lambda it: [read(RetrievedReference, each) for each in it.references], timeout_s
    )


async def audit_scene(
    connection: Connection,
    scene: str,
    references: Sequence[str] = (),
    *,
    page_size: int = 0,
    timeout_s: float | None = None,
) -> AsyncIterator[ReferenceAudit]:
    """Examines references of a scene against their neighbours, by id; results are yielded as they arrive.

    Args:
        scene: the scene.
        references: ids of references, at most 100; empty for all.
        page_size: references per call, about half a second of computation each; 0 for the server's default.
        timeout_s: deadline of each call.
    """
    named = reference_names(scene, references)
    request = pb.AuditSceneRequest(scene=scene_name(scene), references=named, page_size=page_size)
    audits = connection.listed(
        "AuditScene", request, lambda page: [read(ReferenceAudit, it) for it in page.audits], timeout_s
    )
    async for audit in audits:
        yield audit


async def check_coverage(
    connection: Connection,
    scene: str,
    world_from_camera: RigidTransform,
    camera: Camera,
    *,
    timeout_s: float | None = None,
) -> Coverage:
    """Predicts whether a photograph taken at a pose would be localized."""
    request = pb.CheckCoverageRequest(
        scene=scene_name(scene),
        world_from_camera=wire.transform_to_message(world_from_camera, "world_from_camera"),
        intrinsics=wire.camera_to_message(camera),
    )
    return await connection.call("CheckCoverage", request, partial(read, Coverage), timeout_s)
