"""Localizes photographs a second time, from surveyed references alone: all that were not adopted."""

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapless.geometry import Array, RigidTransform
from mapless_server.engine.query import Caller, Query, Result
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.method.bundle.priors import NO_PRIORS
from mapless_server.method.options import StageContext
from mapless_server.scenes import ANYWHERE
from mapless_server.scenes.adoption import policy as rules
from mapless_server.scenes.adoption.policy import AdoptionOptions, Evidence
from mapless_server.scenes.adoption.viewpoints import Viewpoints, surveyed_viewpoints
from mapless_server.scenes.retrieval.index import Entries, Rows
from mapless_server.scheduling import Flow
from mapless_server.security import SceneKey, tenant_of
from mapless_server.store import Store, adoption

from .evidence import distance_shown, evidence_of, shares_compared

MOST_CHOSEN_AMONG = 1000
"""Surveyed references that a photograph is localized from again: the nearest, as many as a request may name."""
MOST_COMPARED, MOST_SUPPORTING = 6, 4
"""References that are compared with a photograph only to learn whether it contradicts them, and those beside them."""
LIMIT_S = 120.0
"""For each localization; the server is idle."""
OWN_CALLER = "adoption"
"""Jobs are the scene's tenant's, from whose share of computing time they are, by a caller of their own."""


@dataclass(frozen=True, eq=False)
class Place:
    """The references of a scene around a candidate.

    Attributes:
        surveyed_ids, surveyed_keys, centres, axes: those that were not adopted; centres (N, 3) and axes (N, 3), world.
        around: indices of those that stand around the candidate, the nearest first, whose place it is.
    """

    surveyed_ids: Sequence[str]
    surveyed_keys: Sequence[str]
    centres: Array
    axes: Array
    around: Sequence[int]

    @property
    def key(self) -> str:
        """The key of the reference whose place it is."""
        return self.surveyed_keys[self.around[0]]

    @property
    def reference_id(self) -> str:
        """The id of that reference."""
        return self.surveyed_ids[self.around[0]]

    @property
    def key_of(self) -> dict[str, str]:
        """Keys of all the surveyed references, by id."""
        return dict(zip(self.surveyed_ids, self.surveyed_keys, strict=True))

    @property
    def id_of(self) -> dict[str, str]:
        """Ids of the references around, by key."""
        return {self.surveyed_keys[i]: self.surveyed_ids[i] for i in self.around}


class SurveyedLocalizer:
    """Localizes photographs of scenes from what was surveyed of them."""

    def __init__(self, engine: QueueEngine, store: Store) -> None:
        """Makes the object."""
        self._engine = engine
        self._store = store

    def place(
        self, scene_key: SceneKey, pose: RigidTransform, distance_m: float, options: AdoptionOptions
    ) -> Place | None:
        """The references around a pose at which a photograph shows what is so far away; None without surveyed ones."""
        entries = self._entries(scene_key)
        rows, viewpoints = self._surveyed(scene_key, entries)
        if not len(rows):
            return None
        around = viewpoints.around(pose.translation, pose.rotation[:, 2], options.places, distance_m)
        nearest = viewpoints.nearest(pose.translation, MOST_CHOSEN_AMONG).tolist()
        chosen = list(dict.fromkeys([*nearest, *around]))  # those around may be further away
        ids, keys = zip(*(entries.reference(row)[:2] for row in rows[chosen].tolist()), strict=True)
        return Place(
            ids, keys, viewpoints.centres[chosen], viewpoints.axes[chosen], [chosen.index(it) for it in around]
        )

    def place_keys(self, scene_key: SceneKey, poses: Mapping[str, RigidTransform]) -> dict[str, str]:
        """Keys of the surveyed references whose places poses are at, by the names of these; none without surveyed."""
        entries = self._entries(scene_key)
        rows, viewpoints = self._surveyed(scene_key, entries)
        if not len(rows):
            return {}
        nearest = {name: viewpoints.place(it.translation, it.rotation[:, 2]) for name, it in poses.items()}
        return {name: entries.reference(int(rows[it]))[1] for name, it in nearest.items()}

    def surveyed_again(self, scene_key: SceneKey, new_keys: Collection[str], options: AdoptionOptions) -> set[str]:
        """Keys of the surveyed references around which new ones stand."""
        entries = self._entries(scene_key)
        new = list(entries.rows_of_keys(new_keys).values())
        old = np.setdiff1d(self._surveyed(scene_key, entries)[0], new, assume_unique=True)
        if not len(old):
            return set()
        viewpoints, found = Viewpoints(entries.centres(old), entries.axes(old)), set[int]()
        for centre, axis in zip(entries.centres(np.array(new)), entries.axes(np.array(new)), strict=True):
            found |= set(viewpoints.around(centre, axis, options.places))
        return {entries.reference(int(old[i]))[1] for i in found}

    def _entries(self, scene_key: SceneKey) -> Entries:
        context = StageContext(lambda: None)
        return self._engine.references.retrievals[0].indexes.entries(scene_key, context, waits=False)

    def _surveyed(self, scene_key: SceneKey, entries: Entries) -> tuple[Rows, Viewpoints]:
        def adopted() -> list[str]:
            return [it.key for it in adoption.list_adopted(self._store.database, scene_key)]

        return surveyed_viewpoints(entries, adopted)

    async def localized(
        self, query: Query, reference_ids: Sequence[str], mask: bytes, *, rerank: bool = True
    ) -> Result:
        """The photograph localized from surveyed references alone, without its priors and with another mask.

        Of these references the most similar are used, as usual; all of them without `rerank`.
        """
        again = replace(
            query,
            reference_ids=tuple(reference_ids),
            rerank=rerank,
            photo=replace(query.photo, mask=mask),
            priors=NO_PRIORS,
            narrowing=ANYWHERE,
            attributes=None,
            allow_coarse=False,
        )
        engine = self._engine
        return await engine.run(engine.query_job(again, self.caller(query.scene_key), gives_way=True))

    @staticmethod
    def caller(scene_key: SceneKey) -> Caller:
        """Who computes for a scene that adopts."""
        return Caller(Flow(tenant_of(scene_key), OWN_CALLER), time.monotonic() + LIMIT_S)

    @staticmethod
    def evidence(query: Query, result: Result) -> Evidence | None:
        """The evidence of a result; None for a rejection, or a pose without radii."""
        return evidence_of(query, result)

    async def shares(
        self, query: Query, place: Place, surveyed: Evidence, result: Result, options: AdoptionOptions
    ) -> dict[str, float]:
        """Share of a photograph's matches with references that should show what it shows, by key.

        Only of references that it was compared with. The nearest of those that were not chosen for its answer are
        compared now, together with the best of those that were.
        """
        pose = surveyed.world_from_camera
        expected = rules.should_show(place.centres, place.axes, pose, distance_shown(result), options)
        key_of = {place.surveyed_ids[i]: place.surveyed_keys[i] for i in expected.tolist()}
        shares = shares_compared(surveyed, result)
        if left := [it for it in key_of if it not in shares][:MOST_COMPARED]:  # the nearest come first
            supporting = sorted(surveyed.inliers_of, key=lambda it: -surveyed.inliers_of[it])[:MOST_SUPPORTING]
            compared = await self.localized(query, [*supporting, *left], query.photo.mask, rerank=False)
            found = self.evidence(query, compared)
            if found is not None and found.agrees_with(surveyed):
                shares = shares_compared(found, compared) | shares
        return {key: shares[it] for it, key in key_of.items() if it in shares}
