"""Finds references of a scene: near a pose, or similar to another reference.

The poses of a whole scene fit in memory, its features do not. A reference is judged by its neighbours and, if these are
in doubt, by theirs; so a scene of any size is audited page by page, and references are loaded as they are needed.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mapless.geometry import Array, RigidTransform
from mapless.names import parse_reference_name, reference_name
from mapless_server.method.features.views import PosedView
from mapless_server.store import LruCache

from ..retrieval.index import Entries, Rows

HEADING_DEG = 30.0
"""A turn by this much reduces the overlap of two photographs as much as the distance to the last of the nearest."""

Similar = Callable[[str, int], Sequence[str]]
"""Names of at most so many references that are similar to the one named, the most similar first."""


class ReferenceGone(Exception):
    """A reference has been deleted or damaged since the scene was read."""


class ReferenceFinder:
    """Finds and loads references of a scene, by their names.

    All poses that it takes and returns are in a world whose origin is the first reference's position, `origin` (3,) in
    the scene's world, metres.
    """

    def __init__(
        self,
        scene_id: str,
        entries: Entries,
        rows: Rows,
        load: Callable[[Sequence[str]], Sequence[PosedView]],
        similar: Similar,
        cached_views: int = 500,
    ) -> None:
        """Makes a finder of references among rows (N,) of a scene's entries, ascending.

        `load` returns references by name, in order, except those that have been deleted or damaged; the names are made
        of the scene's id. `cached_views` loaded references are kept, about 1.2 MB each.
        """
        self._scene_id, self._entries, self._rows = scene_id, entries, rows
        # World coordinates may be millions of metres (UTM, ECEF), which would cost digits of differences of squares.
        self._centres = entries.centres(rows)
        self.origin: Array = self._centres[0].copy() if len(rows) else np.zeros(3)
        self._load, self._similar = load, similar
        self._views: LruCache[PosedView] = LruCache(cached_views)
        self._gone: set[str] = set()

    def view(self, name: str) -> PosedView:
        """The reference of this name; raises ReferenceGone."""
        views = self.views([name])
        if not views:
            raise ReferenceGone(name)
        return views[0]

    def views(self, names: Sequence[str]) -> tuple[PosedView, ...]:
        """The references of these names, except those that cannot be loaded."""
        names = [name for name in names if name not in self._gone]
        found = {name: view for name in names if (view := self._views.get(name)) is not None}
        missing = [name for name in names if name not in found]
        if missing:
            for view in self._load(missing):
                found[view.name] = replace(view, world_from_camera=view.world_from_camera.shifted(-self.origin))
                self._views.put(view.name, found[view.name])
            self._gone.update(name for name in missing if name not in found)
        return tuple(found[name] for name in names if name in found)

    def near(self, name: str, count: int) -> list[str]:
        """Names of the references nearest to one by position and heading, the nearest first."""
        return self.near_pose(self.pose(name), count, name)

    def near_pose(self, world_from_camera: RigidTransform, count: int, excluded: str = "") -> list[str]:
        """Names of the references nearest to a pose by position and heading, the nearest first."""
        distance, index = self._nearest(world_from_camera, 4 * count + 1)
        others = np.array([self._name(i) != excluded for i in index.tolist()], bool)
        distance, index = distance[others], index[others]
        if not len(index):
            return []
        cosine = self._entries.axes(self._rows[index]) @ world_from_camera.rotation[:, 2]
        turn_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        reach_m = max(float(distance[min(count, len(distance)) - 1]), 1e-9)
        order = np.argsort(distance / reach_m + turn_deg / HEADING_DEG, kind="stable")
        return [self._name(i) for i in index[order[:count]].tolist()]

    def similar(self, name: str, count: int) -> list[str]:
        """Names of references that may show the same as this one, wherever they are."""
        return [other for other in self._similar(name, count + 1) if other != name][:count]

    def pose(self, name: str) -> RigidTransform:
        """The given pose of a reference, world_from_camera."""
        (row,) = self._entries.rows([parse_reference_name(name)[1]])
        return self._entries.reference(int(row))[2].shifted(-self.origin)

    def _name(self, index: int) -> str:
        return reference_name(self._scene_id, self._entries.reference(int(self._rows[index]))[0])

    def _nearest(self, world_from_camera: RigidTransform, count: int) -> tuple[Array, NDArray[np.intp]]:
        """Distances and indices of the nearest rows."""
        if not len(self._rows):
            return np.empty(0), np.empty(0, np.intp)
        distance, index = self._tree.query(world_from_camera.translation, k=min(count, len(self._rows)))
        return np.atleast_1d(distance), np.atleast_1d(index)

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self._centres - self.origin)
