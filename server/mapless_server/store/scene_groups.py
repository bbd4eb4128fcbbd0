"""The scenes that one query searches: those of a tenant with some labels, or some by their keys.

Each look-up is one statement. Where only this process writes, it is executed again only after a change.
"""

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from functools import partial
from typing import Any

from sqlalchemy import Row, Select

from mapless_server.cache import LruCache
from mapless_server.security import SceneKey, SceneLimit, key_of, scene_id_of

from . import queries, rows
from .database import Database
from .records import GroupedScene, NamedScenes
from .tables import scene, scene_generation

MAX_NAMED_SCENES = 64
"""Scenes that can be looked up by their keys at once."""
SCENE_BYTES = 1400
"""About the size of a GroupedScene with a datum in memory."""

NAME_BYTES = 300
"""About the size of a scene's key and id in memory."""

_COLUMNS = (
    scene.c.scene_id,
    scene.c.create_time_us,
    scene.c.attributes,
    scene.c.attributes_sha256,
    scene_generation.c.generation,
)


class SceneGroups:
    """Looks up scenes in a database, and remembers what was found; thread-safe.

    The `state` of each method is an object that the store replaces with every change.
    """

    def __init__(self, database: Database, cache_bytes: int) -> None:
        self._database = database
        # The latest group stays however large it is: each query of a tenant may search all of its scenes.
        self._found: LruCache[tuple[object, tuple[GroupedScene, ...]]] = LruCache(cache_bytes, cache_bytes > 0)
        self._labelled: LruCache[tuple[object, frozenset[str]]] = LruCache(cache_bytes)

    def find(
        self, tenant: str, labels: Mapping[str, str], limit: SceneLimit | None, state: object
    ) -> tuple[GroupedScene, ...]:
        """Scenes of a tenant with all these labels, within the limit if there is one; ordered by id."""
        return self._look_up(
            (tenant, frozenset(labels.items()), limit),
            lambda: queries.select_scenes_of(tenant, "", labels, limit),
            state,
        )

    def find_named(self, keys: Sequence[SceneKey], state: object) -> NamedScenes:
        """Scenes by their keys; ValueError for more than `MAX_NAMED_SCENES` keys, or one that occurs twice."""
        names = tuple(keys)
        if len(names) > MAX_NAMED_SCENES:
            raise ValueError(f"keys must have at most {MAX_NAMED_SCENES} items, has {len(names)}")
        if len(set(names)) < len(names):
            raise ValueError("keys must not have the same item twice")
        found = self._look_up(names, lambda: queries.select_scenes().where(scene.c.scene_id.in_(names)), state)
        by_key = {it.scene_key: it for it in found}
        return NamedScenes(
            tuple(by_key[it] for it in names if it in by_key), tuple(it for it in names if it not in by_key)
        )

    def find_within(self, tenant: str, scene_ids: Collection[str], limit: SceneLimit, state: object) -> frozenset[str]:
        """Those of some ids, at most `MAX_NAMED_SCENES`, that the limit names, or whose scenes have its labels.

        A scene that does not exist and one without the labels take the same time.
        """
        known = self.recall_within(tenant, scene_ids, limit, state)
        if known is not None:
            return known
        keys = _unnamed(tenant, scene_ids, limit)
        with self._database.read() as connection:
            found = connection.execute(queries.select_labelled(keys, limit.labels)).scalars()
            labelled = frozenset(map(scene_id_of, found))
        if labelled:
            self._labelled.put((keys, limit.labels), (state, labelled), NAME_BYTES * (1 + len(keys)))
        return labelled | limit.scene_ids.intersection(scene_ids)

    def recall_within(
        self, tenant: str, scene_ids: Collection[str], limit: SceneLimit, state: object
    ) -> frozenset[str] | None:
        """The same without asking the database; None if it must be asked."""
        named, keys = limit.scene_ids.intersection(scene_ids), _unnamed(tenant, scene_ids, limit)
        if not keys:
            return named
        before = None if self._database.is_shared else self._labelled.get((keys, limit.labels))
        return named | before[1] if before is not None and before[0] is state else None

    def _look_up(
        self, name: tuple[Hashable, ...], statement: Callable[[], Select[Any]], state: object
    ) -> tuple[GroupedScene, ...]:
        before = self._found.get(name)
        if before is not None and before[0] is state and not self._database.is_shared:
            return before[1]
        known: dict[str, GroupedScene] = {it.scene_key: it for it in before[1]} if before is not None else {}
        wanted: Select[Any] = statement().with_only_columns(*_COLUMNS)
        with self._database.read() as connection:
            stored = connection.execute(wanted).all()
        found = tuple(_same_or_new(known.get(row.scene_id), row) for row in stored)
        if before is not None and found == before[1]:  # scenes are equal only to themselves
            found = before[1]
        if found:  # what is not there may be anything that a caller makes up
            self._found.put(name, (state, found), SCENE_BYTES * (1 + len(found)) + NAME_BYTES * len(name))
        return found


def _unnamed(tenant: str, scene_ids: Collection[str], limit: SceneLimit) -> tuple[SceneKey, ...]:
    """Keys of the scenes whose labels decide whether they are within a limit."""
    if not limit.labels:
        return ()
    return tuple(sorted(key_of(tenant, it) for it in scene_ids if it not in limit.scene_ids))


def _same_or_new(known: GroupedScene | None, row: Row[Any]) -> GroupedScene:
    """The scene of a row: the known one, if it has not changed since."""
    if known is not None and (known.generation, known.create_time_us) == (row.generation, row.create_time_us):
        return known
    return GroupedScene(row.generation, row.create_time_us, partial(rows.scene_attributes, row), SceneKey(row.scene_id))
