"""Finds the scenes that LocalizeRequests search, and keeps what is made of a group while none of its scenes changes."""

from collections.abc import Mapping

from mapless import names
from mapless_server.cache import LruCache
from mapless_server.errors import NotFound
from mapless_server.security import Principal, scene_id_of
from mapless_server.store import Store

from .messages.references import labels_from_message
from .messages.scenes import AnyRequest, FoundScenes, scene_keys_from_message
from .reach import Reach

CACHED_SCENES = 100_000
"""Scenes of all groups together that are kept, some 40 MB; the latest group is, however large."""


class SceneFinder:
    """Finds scenes by name or by label; from any thread."""

    def __init__(self, store: Store, reach: Reach) -> None:
        self._store = store
        self._reach = reach
        self._groups: LruCache[tuple[object, FoundScenes]] = LruCache(CACHED_SCENES, keeps_latest=True)

    def find(self, request: AnyRequest, principal: Principal) -> FoundScenes:
        """The scenes that a request lists, or those of its group that are within the caller's reach.

        FieldError names a wrong field; NotFound has the field scenes[i] of a scene that does not exist, or scene_group
        if no scene is in it.
        """
        if request.scenes:
            return self._named(request, principal)
        labels = labels_from_message(request.scene_group.labels, "scene_group.labels")
        found = self._group(labels, request.scene_group.with_datum, principal)
        if not found.scenes:
            having = [names.shown(", ".join(f"{name}={value}" for name, value in labels.items()))] if labels else []
            having += ["a datum"] if request.scene_group.with_datum else []
            raise NotFound(f"there is no scene{' with ' * bool(having)}{' and '.join(having)}", field="scene_group")
        return found

    def _named(self, request: AnyRequest, principal: Principal) -> FoundScenes:
        listed = scene_keys_from_message(request, principal.tenant)
        keys = self._reach.keys(principal, [scene_id_of(it) for it in listed])
        found = self._store.find_scenes_named(keys)
        if found.missing:
            missing = found.missing[0]
            scene_id, field = scene_id_of(missing), f"scenes[{keys.index(missing)}]"
            raise NotFound(f"there is no scene {scene_id!r}", field=field, resource=names.scene_name(scene_id))
        return FoundScenes(found.found)

    def _group(self, labels: Mapping[str, str], with_datum: bool, principal: Principal) -> FoundScenes:
        scenes = self._store.find_scenes(principal.tenant, labels, principal.limit)
        name = principal.tenant, frozenset(labels.items()), with_datum, principal.limit
        made_of, known = self._groups.get(name) or (None, None)
        if known is None or made_of is not scenes:
            known = FoundScenes(scenes)
            if with_datum:
                known = FoundScenes([it for it, its in zip(scenes, known.attributes, strict=True) if its.datum])
            if scenes:  # what is not there may be anything that a caller makes up
                self._groups.put(name, (scenes, known), 1 + len(scenes))
        return known
