"""What operators do about adopted and retired references."""

from contextlib import suppress
from datetime import datetime
from typing import Any

from .. import wire
from ..connection import Connection
from ..errors import NotFound
from ..messages import reference_from_message
from ..names import parse_reference_name, reference_name, scene_name
from ..results import Reference, RestoredReferences
from ..v1 import reference_service_pb2 as pb
from .references import delete_reference, list_references

_NO_REFERENCE = "adopted-none"
"""An id that no photograph has, whose deletion changes nothing and requires the role."""


async def retire_reference(
    connection: Connection, scene: str, reference: str, *, timeout_s: float | None = None
) -> Reference:
    """Has a reference not chosen for photographs any more; it stays stored, and `restore_reference` undoes it."""
    request = pb.RetireReferenceRequest(name=reference_name(scene, reference))
    return await connection.call("RetireReference", request, _reference, timeout_s)


async def restore_references(
    connection: Connection,
    scene: str,
    *,
    since: datetime | None = None,
    place: str = "",
    timeout_s: float | None = None,
) -> RestoredReferences:
    """Has the retired references of a scene chosen again, as one change, but those that would not last.

    Args:
        scene: the scene.
        since: only those that were retired at this time, with time zone, by the server's clock, or later.
        place: only those of the place of this surveyed reference: itself, and what was adopted there.
        timeout_s: deadline of the call.
    """
    request = pb.RestoreReferencesRequest(scene=scene_name(scene), place=reference_name(scene, place) if place else "")
    if since is not None:
        _check_time(since)
        wire.set_time(request.since, since, "since")
    return await connection.call("RestoreReferences", request, _restored, timeout_s)


def _restored(response: Any) -> RestoredReferences:
    return RestoredReferences(
        tuple(parse_reference_name(it)[1] for it in response.references),
        {parse_reference_name(it.name)[1]: it.reason for it in response.still_retired},
    )


async def restore_reference(
    connection: Connection, scene: str, reference: str, *, timeout_s: float | None = None
) -> Reference:
    """Has a retired reference chosen again, and forgets what was held against it; one that is not retired is kept."""
    request = pb.RestoreReferenceRequest(name=reference_name(scene, reference))
    return await connection.call("RestoreReference", request, _reference, timeout_s)


def _check_time(since: datetime) -> None:
    wire.require(since, datetime, "since", "such as datetime.now(timezone.utc)")
    if since.tzinfo is None:
        raise ValueError("since must have a time zone")


def _reference(response: Any) -> Reference:
    return reference_from_message(response.reference)


async def undo_adoption(
    connection: Connection, scene: str, since: datetime, *, timeout_s: float | None = None
) -> list[Reference]:
    """Deletes the references that a scene has adopted since a time, one by one, and returns them.

    A token of a lower role than `write` is refused (PermissionDenied), also where there is nothing to delete.

    Args:
        scene: the scene.
        since: the time, with time zone, by the server's clock.
        timeout_s: deadline of each call.
    """
    _check_time(since)
    adopted = [it async for it in list_references(connection, scene, only_adopted=True, timeout_s=timeout_s)]
    chosen = [it for it in adopted if (it.provenance.adopt_time or it.create_time) >= since]
    for it in chosen:
        await delete_reference(connection, it.scene_id, it.reference_id, timeout_s=timeout_s)
    if not chosen:  # the interface has no method of its own, which would refuse the token
        with suppress(NotFound):
            await delete_reference(connection, scene, _NO_REFERENCE, timeout_s=timeout_s)
    return chosen
