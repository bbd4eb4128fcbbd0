"""The scenes that a call can reach: those of its tenant, and of them only those that its token is for.

This is the one place that decides it. A scene out of reach is looked up in `NOWHERE`, where no scene is: whatever the
services do with it ends as it does for a scene that does not exist, after the same work.
"""

import asyncio
from collections.abc import Mapping, Sequence

from mapless import wire
from mapless_server.errors import PermissionDenied
from mapless_server.rpc import Call
from mapless_server.security import NOWHERE, Principal, SceneKey, key_of
from mapless_server.store import Store


class Reach:
    """Finds the keys of scenes that calls name."""

    def __init__(self, store: Store) -> None:
        self._store = store

    async def scene_key(self, call: Call, name: str, field: str) -> SceneKey:
        """The key of a scene; FieldError if the name is not a scene's name."""
        return await self._key(call.principal, wire.scene_id_from_name(name, field))

    async def reference_key(self, call: Call, name: str, field: str) -> tuple[SceneKey, str]:
        """The key of a scene, and a reference's id within it; FieldError if the name is not a reference's."""
        scene_id, reference_id = wire.reference_ids_from_name(name, field)
        return await self._key(call.principal, scene_id), reference_id

    async def _key(self, caller: Principal, scene_id: str) -> SceneKey:
        tenant, limit = caller.tenant, caller.limit
        if limit is None:
            return key_of(tenant, scene_id)
        are_within = self._store.recall_within(tenant, [scene_id], limit)
        if are_within is None:
            are_within = await asyncio.to_thread(self._store.find_within, tenant, [scene_id], limit)
        return key_of(tenant if scene_id in are_within else NOWHERE, scene_id)

    def keys(self, caller: Principal, scene_ids: Sequence[str]) -> tuple[SceneKey, ...]:
        """The keys of up to 64 scenes, by ids, in their order; may read the database."""
        tenant, limit = caller.tenant, caller.limit
        are_within = scene_ids if limit is None else self._store.find_within(tenant, scene_ids, limit)
        return tuple(key_of(tenant if it in are_within else NOWHERE, it) for it in scene_ids)


def check_stays_in_reach(call: Call, scene_id: str, labels: Mapping[str, str], field: str) -> None:
    """Raises PermissionDenied if a scene with these labels would not be one of those that the call's token is for."""
    limit = call.principal.limit
    if limit is None or limit.holds(scene_id, labels):
        return
    needed = "be named in the token"
    if limit.labels:
        needed += f", or have the labels {', '.join(f'{name}={value}' for name, value in sorted(limit.labels))}"
    raise PermissionDenied(
        f"the token {call.principal.name!r} is for some scenes only, and scene {scene_id!r} would not be one of them: "
        f"it must {needed}",
        reason="SCENE_LIMIT",
        field=field,
    )
