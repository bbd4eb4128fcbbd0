"""The references around one: near by pose, or similar by looks.

Poses of the whole scene fit in memory, features do not. A reference is judged from its neighbours and, if these are in
doubt, from theirs; so a scene of any size is audited page by page, and references are loaded as they are needed.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mapless.geometry import Array, RigidTransform
from mapless_server.method.views import PosedView

HEADING_DEG = 30.0
"""A turn by so much costs two photographs as much in common as a step to the last of the nearest references."""

Similar = Callable[[str, int], Sequence[str]]
"""Names of at most so many references that look like the one named, the most similar first."""


@dataclass(frozen=True)
class PosedName:
    """A reference without its features.

    Attributes:
        name: unique in the scene.
        world_from_camera: its given pose, metric.
    """

    name: str
    world_from_camera: RigidTransform


@dataclass(frozen=True, eq=False)
class Places:
    """Where the references of a scene are; names and whole poses are made for those that are asked for.

    Attributes:
        centres: (N, 3) camera centres, world, metres.
        axes: (N, 3) optical axes, unit length, world.
        name_of: name of a row.
        row_of: row of a name.
        pose_of: world_from_camera of a row.
    """

    centres: Array
    axes: Array
    name_of: Callable[[int], str]
    row_of: Callable[[str], int]
    pose_of: Callable[[int], RigidTransform]


def places_of(poses: Sequence[PosedName]) -> Places:
    """Of references that are all listed."""
    centres = np.array([pose.world_from_camera.translation for pose in poses]).reshape(-1, 3)
    axes = np.array([pose.world_from_camera.rotation[:, 2] for pose in poses]).reshape(-1, 3)
    row_of = {pose.name: row for row, pose in enumerate(poses)}
    return Places(
        centres,
        axes,
        lambda row: poses[row].name,
        lambda name: row_of[name],
        lambda row: poses[row].world_from_camera,
    )


class Gone(Exception):
    """A reference cannot be loaded any more that could be before."""


class Surroundings:
    """The references of a scene, found by pose or by looks.

    All poses that it gives and takes are in a world whose origin is the first reference's position.

    Attributes:
        origin: (3,) where that is in the caller's world, metres.
    """

    def __init__(
        self,
        places: Places,
        load: Callable[[Sequence[str]], Sequence[PosedView]],
        similar: Similar | None = None,
        remembered_views: int = 500,
    ) -> None:
        """Takes the places of a scene and how to load references of it.

        Args:
            places: of all references.
            load: the references of these names, in order, less those that cannot be had any more.
            similar: how to find similar ones; None looks at the nearest by position instead.
            remembered_views: loaded references that are kept, about 1.2 MB each.
        """
        # World coordinates may be millions of metres (UTM, ECEF), too long for the digits of differences of squares.
        self.origin: Array = places.centres[0].copy() if len(places.centres) else np.zeros(3)
        self._places = places
        self._load, self._similar = load, similar
        self._remembered_views = remembered_views
        self._views: OrderedDict[str, PosedView] = OrderedDict()
        self._missing: set[str] = set()

    def view(self, name: str) -> PosedView:
        """The reference of this name. Raises Gone if it cannot be loaded any more."""
        views = self.views([name])
        if not views:
            raise Gone(name)
        return views[0]

    def views(self, names: Sequence[str]) -> tuple[PosedView, ...]:
        """The references of these names, less those that cannot be loaded."""
        names = [name for name in names if name not in self._missing]
        missing = [name for name in names if name not in self._views]
        found = {name: self._views[name] for name in names if name in self._views}
        if missing:
            loaded = self._load(missing)
            shifted = [replace(v, world_from_camera=v.world_from_camera.shifted(-self.origin)) for v in loaded]
            found |= {view.name: view for view in shifted}
            self._missing.update(name for name in missing if name not in found)
            names = [name for name in names if name in found]
        for name in names:
            self._views[name] = found[name]
            self._views.move_to_end(name)
        while len(self._views) > self._remembered_views:
            self._views.popitem(last=False)
        return tuple(found[name] for name in names)

    def near(self, name: str, count: int) -> list[str]:
        """Names of the references nearest to one by position and heading, the nearest first."""
        return self.near_pose(self.pose(name), count, name)

    def near_pose(self, world_from_camera: RigidTransform, count: int, but: str = "") -> list[str]:
        """Names of the references nearest to a pose by position and heading, the nearest first."""
        distance, index = self._nearest(world_from_camera, 4 * count + 1)
        others = np.array([self._places.name_of(i) != but for i in index.tolist()], bool)
        distance, index = distance[others], index[others]
        if not len(index):
            return []
        cosine = self._places.axes[index] @ world_from_camera.rotation[:, 2]
        turn_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        reach_m = max(float(distance[min(count, len(distance)) - 1]), 1e-9)
        order = np.argsort(distance / reach_m + turn_deg / HEADING_DEG, kind="stable")
        return [self._places.name_of(i) for i in index[order[:count]].tolist()]

    def alike(self, name: str, count: int) -> list[str]:
        """Names of references that may show the same as one, wherever they are said to stand."""
        if self._similar is not None:
            return [other for other in self._similar(name, count + 1) if other != name][:count]
        _, index = self._nearest(self.pose(name), count + 1)
        return [other for other in map(self._places.name_of, index.tolist()) if other != name][:count]

    def pose(self, name: str) -> RigidTransform:
        """The given pose of a reference."""
        return self._places.pose_of(self._places.row_of(name)).shifted(-self.origin)

    def _nearest(self, world_from_camera: RigidTransform, count: int) -> tuple[Array, NDArray[np.intp]]:
        if not len(self._places.centres):
            return np.empty(0), np.empty(0, np.intp)
        count = min(count, len(self._places.centres))
        distance, index = self._tree.query(world_from_camera.translation, k=count)
        return np.atleast_1d(distance), np.atleast_1d(index)

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self._places.centres - self.origin)


def surroundings_of(references: Sequence[PosedView]) -> Surroundings:
    """Of references that are all in memory."""
    by_name = {reference.name: reference for reference in references}
    poses = [PosedName(r.name, r.world_from_camera) for r in references]
    return Surroundings(
        places_of(poses), lambda names: [by_name[name] for name in names], remembered_views=len(references)
    )
