"""The report on photographs that were placed, for people and for programs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from mapless.provenance import PLACED, Provenance, provenance_to_json
from mapless_tools.ingest.report import ImportReport
from mapless_tools.reconstruct.pictures import Omitted

from .run import ALREADY, Extension


def lines(extension: Extension) -> Iterator[str]:
    """Lines for a terminal: what was placed and how accurately, what was not and why."""
    unit = "units" if extension.scene.arbitrary_unit else "m"
    yield from (f"note: {it}" for it in extension.notes)
    for it in extension.placement.placed:
        accuracy = it.accuracy
        yield (
            f"{it.name}: placed, position within {accuracy.position_95_m:.2g} {unit}, rotation within "
            f"{accuracy.rotation_95_deg:.2g} degrees (95 %), by {it.observations} points"
        )
    for other in extension.omitted:
        name = other.name if other.count == 1 else f"{other.count} of {other.name}"
        yield f"{name}: {other.reason}" if is_there(other) else f"{name}: not placed, {other.reason}"
    for unknown, factors in extension.placement.factors.items():
        cameras = "unknown" if unknown else "known"
        yield (
            f"radii for {cameras} cameras are measured on {factors.count} references that were placed by the others: "
            f"errors are {factors.position:.1f} times what residuals say, {factors.rotation:.1f} times for rotations"
        )
    total = len(extension.placement.placed) + len(extension.placement.omitted)
    scene = extension.scene.scene_id
    if total:
        yield f"{len(extension.placement.placed)} of {total} photographs are placed in scene {scene}"
    else:
        yield f"nothing to place: all photographs are in scene {scene} already"


def is_there(omitted: Omitted) -> bool:
    """Whether a photograph was not placed because it is a reference already."""
    return omitted.reason.startswith(ALREADY)


def went_well(extension: Extension) -> bool:
    """Whether at least one photograph is placed, or none was tried because those chosen are in the scene already."""
    if extension.placement.placed or extension.placement.omitted:
        return bool(extension.placement.placed)
    return any(map(is_there, extension.omitted))


def to_json(extension: Extension, stored: ImportReport | None) -> dict[str, Any]:
    """The whole result as JSON values; `stored` is None after a dry run."""
    return {
        "scene": extension.scene.scene_id,
        "arbitrary_unit": extension.scene.arbitrary_unit,
        "placed": [
            {
                "name": it.name,
                "world_from_camera": it.world_from_camera.matrix().tolist(),
                "points": it.observations,
                "provenance": provenance_to_json(Provenance(PLACED, it.accuracy)),
            }
            for it in extension.placement.placed
        ],
        "omitted": [vars(it) for it in extension.omitted],
        "notes": list(extension.notes),
        "stored": None if stored is None else list(stored.added),
        "stopped": "" if stored is None else stored.stopped,
    }
