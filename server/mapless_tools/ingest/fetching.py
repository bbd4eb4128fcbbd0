"""Fetches the references of a scene concurrently; damaged ones are named."""

import hashlib
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

from mapless import Client, DataLoss, Reference
from mapless_tools.progress import Progress

PARALLEL = 4

T = TypeVar("T")


@dataclass(frozen=True)
class Export:
    """The number of written references, and the server's messages about damaged ones by their ids, in their order.

    `without_depth` is the number of those whose depth the layout cannot have.
    """

    written: int
    damaged: Mapping[str, str]
    without_depth: int = 0

    @property
    def total(self) -> int:
        """Number of references of the scene."""
        return self.written + len(self.damaged)


def fetch_all(
    client: Client,
    scene: str,
    take: Callable[[Reference], T],
    progress: Progress,
    pictures: int | None = None,
    wanted: Collection[str] | None = None,
) -> tuple[list[T], dict[str, str]]:
    """Calls `take`, in threads, for each reference, or for each of the `wanted` ids.

    Returns its results in order, and messages about damaged ones by their ids. So many `pictures`, evenly spread, have
    their photographs; None for all. ValueError if the scene has no references.
    """
    references = [it for it in _reference_ids(client, scene) if wanted is None or it in wanted]
    if not references:
        raise ValueError(f"scene {scene} has no references")
    step = 1 if pictures is None else -(-len(references) // pictures)

    def fetch(position: int) -> tuple[T | None, str]:
        try:
            with_image = position % step == 0
            reference = client.get_reference(scene, references[position], include_image=with_image)
        except DataLoss as error:
            return None, error.message
        if with_image and hashlib.sha256(reference.image or b"").hexdigest() != reference.image_sha256:
            return None, f"reference {reference.reference_id!r}: the image received is not the one that was stored"
        if with_image and reference.mask_sha256 and not _is_mask_of(reference):
            return None, f"reference {reference.reference_id!r}: the mask received is not the one that was stored"
        if with_image and reference.depth_sha256 and not _is_depth_of(reference):
            return None, f"reference {reference.reference_id!r}: the depth received is not the one that was stored"
        return take(reference), ""

    progress("references", 0, len(references))
    taken: list[T] = []
    damaged: dict[str, str] = {}
    threads = ThreadPoolExecutor(PARALLEL, "export")
    try:
        for reference_id, (found, message) in zip(references, threads.map(fetch, range(len(references))), strict=True):
            if found is None:
                damaged[reference_id] = message
            else:
                taken.append(found)
            progress("references", len(taken) + len(damaged), len(references))
    finally:
        threads.shutdown(wait=True, cancel_futures=True)
    return taken, damaged


def _is_mask_of(reference: Reference) -> bool:
    return hashlib.sha256(reference.mask or b"").hexdigest() == reference.mask_sha256


def _is_depth_of(reference: Reference) -> bool:
    return reference.depth is not None and reference.depth.sha256 == reference.depth_sha256


def _reference_ids(client: Client, scene: str) -> list[str]:
    with suppress(DataLoss):
        return [reference.reference_id for reference in client.list_references(scene, page_size=1000)]
    # A list ends at a reference whose pose is damaged; an audit names it and continues, but examines each reference.
    return [audit.name.rpartition("/")[2] for audit in client.audit_scene(scene)]
