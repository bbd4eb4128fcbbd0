"""Suggestions of existing scenes and references for a name that does not exist."""

import difflib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import islice

from ..client import Client
from ..errors import MaplessError, NotFound

_MAX_COMPARED = 10_000


@contextmanager
def suggesting(client: Client) -> Iterator[None]:
    """Adds to a NotFound of the block the existing scene or reference whose name resembles the given one."""
    try:
        yield
    except NotFound as error:
        nearest: list[str] = []
        with suppress(MaplessError):  # such as that of a token that may not list them
            nearest = difflib.get_close_matches(error.resource.rpartition("/")[2], _existing(client, error.resource), 1)
        if not nearest:
            raise
        message = f"{error.message}; did you mean {nearest[0]!r}?"
        raise NotFound(
            error.code, message, reason=error.reason, resource=error.resource, request_id=error.request_id
        ) from error


def _existing(client: Client, resource: str) -> list[str]:
    """Ids of the existing resources of the same kind and parent as a resource that does not exist."""
    parent, _, _ = resource.rpartition("/references/")
    if parent:
        return [it.reference_id for it in islice(client.list_references(parent), _MAX_COMPARED)]
    return [it.scene_id for it in islice(client.list_scenes(), _MAX_COMPARED)]
