"""Deleting what was made of scenes and references that are there no more, whichever server deleted them."""

from __future__ import annotations

from itertools import groupby

from mapless_server.errors import DataLoss, NotFound, Unavailable
from mapless_server.security.tenancy import SceneKey
from mapless_server.store import SceneRecord, Store
from mapless_server.store.rows import time_us

from .folder import CaptureFolder
from .held import Held

References = frozenset[tuple[str, str]]
"""Ids and keys."""


class Staleness:
    """Remembers what was found out of a scene as long as it does not change; for one thread."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._known: dict[SceneKey, tuple[int, References]] = {}

    def delete_stale(self, folder: CaptureFolder) -> int:
        """Deletes the calls of scenes that were deleted, and those that a deleted reference took part in.

        Whatever is wrong with one scene or one file keeps nothing of another.

        Returns:
            How many calls went.

        Raises:
            Unavailable: the store is away and says nothing; what is to go then goes when it is back, or for its age.
            OSError: a file cannot be deleted.
            Exception: a scene cannot be asked for.
        """
        held = sorted(folder.held(), key=lambda it: it.scene_key)
        of_scene = {key: list(calls) for key, calls in groupby(held, lambda it: it.scene_key)}
        self._known = {key: known for key, known in self._known.items() if key in of_scene}
        stale: list[Held] = []
        faults: list[Exception] = []
        try:
            for scene_key, calls in of_scene.items():
                stale += self._stale_unless_faulty(scene_key, calls, faults)
        finally:
            folder.remove_all(stale)
        if faults:
            raise faults[0]
        return len(stale)

    def _stale_unless_faulty(self, scene_key: SceneKey, calls: list[Held], faults: list[Exception]) -> list[Held]:
        try:
            return self._stale(scene_key, calls)
        except Unavailable:  # and is so for the others
            raise
        except Exception as error:
            faults.append(error)
            return []

    def _stale(self, scene_key: SceneKey, calls: list[Held]) -> list[Held]:
        try:
            scene = self._store.get_scene(scene_key)
            created_us = time_us(scene.create_time)
            others = [it for it in calls if it.scene_created_us != created_us]
            its = [it for it in calls if it.scene_created_us == created_us]
            there = self._there(scene, References().union(*(it.references for it in its)))
        except NotFound:
            return calls
        except DataLoss:  # it is there, and cannot be read
            return []
        return [*others, *(it for it in its if not it.references <= there)]

    def _there(self, scene: SceneRecord, used: References) -> References:
        """Of the references, those that are still there, and maybe more; each is asked for once a generation."""
        generation, there = self._known.get(scene.scene_key, (scene.generation, References()))
        if generation != scene.generation:
            there = References()
        unknown = used - there
        if unknown:
            there |= unknown & self._store.find_keys(scene.scene_key, sorted({it for it, _ in unknown})).items()
        self._known[scene.scene_key] = scene.generation, there
        return there
