"""The scene that an import fills: a new one, or an existing one whose unit of length must be the same."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapless import AlreadyExists, Client, Reference
from mapless_tools.dataset import Dataset, Frame

from .existing import SAME_POSITION_M

NO_METRES = "its unit of length is arbitrary: --scale, --distance or --align gives metres"


class WrongUnit(Exception):
    """References and their scene have different units."""


def open_scene(client: Client, scene: str, dataset: Dataset, chosen: Sequence[Frame]) -> list[Reference]:
    """Returns the references of a scene, which is created with the dataset's datum, down and unit if missing.

    A scene without references gets the dataset's unit. WrongUnit if its references are in metres and the dataset is
    not, or vice versa.
    """
    is_arbitrary = not dataset.metric
    try:
        client.create_scene(
            scene, datum=dataset.datum, down_in_world=dataset.down_in_world, arbitrary_unit=is_arbitrary
        )
    except AlreadyExists:
        pass
    else:
        return []
    there = client.get_scene(scene)
    existing = list(client.list_references(scene, page_size=1000))
    if there.arbitrary_unit == is_arbitrary or (is_arbitrary and _share_positions(existing, chosen)):
        return existing
    if not existing:
        client.update_scene(scene, arbitrary_unit=is_arbitrary)
        return []
    count = f"scene {scene} has {len(existing)} references in"
    if is_arbitrary:
        raise WrongUnit(f"{count} metres, and this folder is not: {NO_METRES} (--scale 1 if it is the metre)")
    raise WrongUnit(f"{count} an arbitrary unit, and these are in metres: import them into a new scene")


def _share_positions(existing: Sequence[Reference], chosen: Sequence[Frame]) -> bool:
    """Whether both have two distant references with the same ids and positions, so that the unit is the same."""
    there = {reference.reference_id: reference.world_from_camera.translation for reference in existing}
    shared = [
        frame.world_from_camera.translation
        for frame in chosen
        if frame.name in there
        and np.linalg.norm(frame.world_from_camera.translation - there[frame.name]) <= SAME_POSITION_M
    ]
    return len(shared) >= 2 and float(np.ptp(shared, axis=0).max()) > 10 * SAME_POSITION_M
