"""Deleting what was made of scenes and references that are there no more, whichever server deleted them."""

from __future__ import annotations

from ..errors import DataLoss, NotFound, Unavailable
from ..store import SceneRecord, Store
from ..store.rows import time_us
from ..tenancy import SceneKey
from .folder import CaptureFolder, Held


class Staleness:
    """Remembers in which state a scene was looked at last; for one thread."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._checked: dict[SceneKey, tuple[int, int]] = {}

    def delete_stale(self, folder: CaptureFolder) -> int:
        """Deletes the calls of scenes that were deleted, and those that a deleted reference took part in.

        A store that is away says nothing of its scenes; what is to go then goes when it is back, or for its age.

        Returns:
            How many calls went.
        """
        of_scene: dict[SceneKey, list[Held]] = {}
        for held in folder.held():
            if not held.has_failed:
                of_scene.setdefault(held.scene_key, []).append(held)
        self._checked = {key: state for key, state in self._checked.items() if key in of_scene}
        return sum(self._check(folder, scene_key, calls) for scene_key, calls in of_scene.items())

    def _check(self, folder: CaptureFolder, scene_key: SceneKey, calls: list[Held]) -> int:
        try:
            scene = self._store.get_scene(scene_key)
            created_us = time_us(scene.create_time)
            stale = [it for it in calls if it.scene_created_us != created_us]
            stale += self._outdated(scene, [it for it in calls if it.scene_created_us == created_us])
        except NotFound:
            stale = calls
        except (Unavailable, DataLoss):
            return 0
        for held in stale:
            folder.remove(held)
        return len(stale)

    def _outdated(self, scene: SceneRecord, calls: list[Held]) -> list[Held]:
        """Those that a reference took part in which is there no more."""
        state = scene.generation, len(calls)
        if self._checked.get(scene.scene_key) == state:
            return []
        used = frozenset[tuple[str, str]]().union(*(it.references for it in calls))
        gone = {it for it in used if not self._is_there(scene.scene_key, *it)}
        if not gone:
            self._checked[scene.scene_key] = state
        return [it for it in calls if it.references & gone]

    def _is_there(self, scene_key: SceneKey, reference_id: str, key: str) -> bool:
        try:
            return self._store.get_reference(scene_key, reference_id).key == key
        except NotFound:
            return False
        except DataLoss:  # it is there, and cannot be read
            return True
