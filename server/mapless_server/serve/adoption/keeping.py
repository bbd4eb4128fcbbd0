"""Keeps what photographs say of references, retires references by it, and deletes adopted ones that are too old."""

import asyncio
import logging
from collections import Counter
from collections.abc import Awaitable, Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timedelta

from mapless.scenes import AdoptionPolicy
from mapless_server.engine.query import Result
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.errors import NotFound, RequestError
from mapless_server.scenes.adoption import policy as rules
from mapless_server.scenes.adoption.policy import AdoptionOptions, Evidence
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.security import SceneKey
from mapless_server.store import RetirementReason, Store, adoption, time_us
from mapless_server.store.records import Standing
from mapless_server.store.reporting import find_references

from .surveyed import Place, SurveyedLocalizer
from .waiting import Candidate

log = logging.getLogger(__name__)


async def guarded(work: Awaitable[object], fault: str, observer: BackgroundObserver) -> bool:
    """Awaits work, of which a failure is logged as this fault, counted, and ends nothing else; whether it succeeded."""
    try:
        await work
    except RequestError as error:  # the scene is gone, the store is away or damaged, the server ends
        log.warning("%s: %s", fault, error)
    except Exception as error:
        log.error("%s", fault, exc_info=error)
    else:
        return True
    observer.count("adoptions", 1, "failed")
    return False


class Keeper:
    """Changes what is known of references, and which are chosen."""

    def __init__(
        self,
        engine: QueueEngine,
        store: Store,
        observer: BackgroundObserver,
        localizer: SurveyedLocalizer,
        hours: float,
    ) -> None:
        """Makes the object. Adopted references are deleted when they are `hours` old."""
        self._engine = engine
        self._store = store
        self._observer = observer
        self._localizer = localizer
        self._hours = hours
        self._checked: dict[SceneKey, int] = {}
        """Generations of the scenes at which their adopted references were looked up."""

    async def maintain(self, now: datetime, options: AdoptionOptions) -> None:
        """Deletes adopted references that are too old, and retires those whose vouching references are gone.

        Those whose place is not known get one, and those that this has no room for are retired. Places that were
        surveyed again are not outdated any more. What fails for a reference or a scene is logged and counted, and ends
        nothing.
        """
        before = now - timedelta(hours=self._hours)
        await self._guarded(self._delete_expired(before), "adopted references are not looked up by their age")
        await self._guarded(self._look_after(), "adopted references are not looked up by scene")
        await self._guarded(self._end_all_outdated(options), "places that need a new survey are not looked up")

    def _guarded(self, work: Awaitable[object], fault: str) -> Awaitable[bool]:
        return guarded(work, fault, self._observer)

    async def _delete_expired(self, before: datetime) -> None:
        for scene_key, reference_id in await asyncio.to_thread(adoption.list_expired, self._store.database, before):
            deletion = asyncio.to_thread(self._delete, scene_key, reference_id)
            if await self._guarded(deletion, f"{reference_id} of scene {scene_key}, which is too old, is not deleted"):
                self._observer.count("adopted_expired")

    async def _look_after(self) -> None:
        scenes = await asyncio.to_thread(adoption.list_adopting_scenes, self._store.database)
        for scene_key, generation in scenes.items():
            if self._checked.get(scene_key) == generation:
                continue
            fault = f"adopted references of scene {scene_key} are not looked up"
            if await self._guarded(self._look_after_scene(scene_key), fault):
                self._checked[scene_key] = generation
        self._checked = {it: generation for it, generation in self._checked.items() if it in scenes}

    async def _look_after_scene(self, scene_key: SceneKey) -> None:
        gone = await asyncio.to_thread(adoption.unvouched, self._store.database, scene_key)
        await self._retire(scene_key, gone, RetirementReason.VOUCHERS_GONE)
        if unplaced := await asyncio.to_thread(adoption.list_unplaced, self._store.database, scene_key):
            await asyncio.to_thread(self._find_places, scene_key, unplaced)

    def _find_places(self, scene_key: SceneKey, keys: Sequence[str]) -> None:
        """Gives adopted references whose place is not known that of the surveyed reference that is nearest now.

        Those that it has no room for are retired.
        """
        with self._store.database.read() as connection:
            records = find_references(connection, scene_key, keys)
        places = self._localizer.place_keys(scene_key, {key: it.world_from_camera for key, it in records.items()})
        if not places:
            return
        retired = adoption.set_places(self._store, scene_key, places)
        for reason, count in Counter(retired.values()).items():
            self._observer.count_in_scene(scene_key, "retirements", count, reason.value)

    async def _end_all_outdated(self, options: AdoptionOptions) -> None:
        outdated_in = await asyncio.to_thread(adoption.list_outdated_scenes, self._store.database)
        for scene_key, outdated in outdated_in.items():
            ending = asyncio.to_thread(self._end_outdated, scene_key, outdated, options)
            await self._guarded(ending, f"places of scene {scene_key} are not compared with its new references")

    def _end_outdated(self, scene_key: SceneKey, since_us: Mapping[str, int], options: AdoptionOptions) -> None:
        """Ends what is said of outdated places, given since when, where surveyed references were added later."""
        database, ended = self._store.database, list[str]()
        created_us = adoption.list_surveyed_since(database, scene_key, min(since_us.values()))
        for key, outdate_time_us in since_us.items():
            later = [it for it, time_us in created_us.items() if time_us > outdate_time_us]
            if later and key in self._localizer.surveyed_again(scene_key, later, options):
                ended.append(key)
        adoption.change_standings(database, ended, lambda _, known: adoption.surveyed_again(known))

    async def learn(
        self,
        candidate: Candidate,
        place: Place,
        share: float,
        policy: AdoptionPolicy,
        now: datetime,
        options: AdoptionOptions,
    ) -> bool:
        """Counts what a photograph says of the places around it, and of the adopted references at its own.

        `share` is that of `policy.surveyed_share`. Returns whether its own place is outdated.
        """
        database, answered, scene_key = self._store.database, candidate.answered, candidate.query.scene_key
        counted, now_us = set[str](), time_us(now)

        def learned(key: str, known: Standing) -> Standing:
            # Once outdated it stays so until a new survey: answers by what is left of the old one say nothing.
            # A masked photograph shows what its mask has left.
            if candidate.query.photo.mask or known.outdate_time_us is not None:
                return known
            made = rules.with_share(known, share, now_us, candidate.holder, options)
            if made is not known:
                counted.add(key)
            if not rules.needs_survey(made, policy, options):
                return made
            log.warning("scene %s: the place of %s needs a new survey", scene_key, place.id_of[key])
            return adoption.outdated(made)

        made = await asyncio.to_thread(adoption.change_standings, database, place.id_of, learned)
        outdated = [key for key, it in made.items() if it.outdate_time_us is not None]
        adopted = [
            it for it in await asyncio.to_thread(adoption.list_adopted_at, database, place.id_of) if not it.is_retired
        ]
        leaving = [it.key for it in adopted if it.place_key in outdated]
        await self._retire(scene_key, leaving, RetirementReason.SURVEY_OUTDATED)
        if place.key in outdated:
            return True
        if candidate.holder and place.key not in counted:  # else one token could have useful ones leave
            return False
        useful, total = dict[str, float](), max(answered.inlier_count, 1)
        for it in adopted:
            if it.place_key == place.key:
                is_own = rules.is_adopted_for(it.adopted_by, candidate.holder)
                given = answered.inliers_of.get(it.reference_id, 0) / total
                useful[it.key] = rules.with_usefulness(it.usefulness, given, options, is_own=is_own)
        await asyncio.to_thread(adoption.set_usefulness, database, useful)
        return False

    async def count_contradictions(
        self,
        candidate: Candidate,
        place: Place,
        surveyed: Evidence,
        result: Result,
        now: datetime,
        options: AdoptionOptions,
    ) -> None:
        """Counts what a photograph says of the surveyed references that should show what it shows, and retires some."""
        if candidate.query.photo.mask:  # what does not show a reference may be all that the mask has left
            return
        scene_key, now_us = candidate.query.scene_key, time_us(now)
        shares = await self._localizer.shares(candidate.query, place, surveyed, result, options)
        standings = await asyncio.to_thread(
            adoption.change_standings,
            self._store.database,
            shares,
            lambda key, it: rules.with_photograph(it, shares[key], now_us, candidate.holder, options),
        )
        contradicted = [key for key, it in standings.items() if rules.is_contradicted(it, options)]
        await self._retire(scene_key, contradicted, RetirementReason.CONTRADICTED)

    def _delete(self, scene_key: SceneKey, reference_id: str) -> None:
        with suppress(NotFound):  # another server was first
            self._engine.forget_references({self._store.delete_reference(scene_key, reference_id)})

    async def _retire(self, scene_key: SceneKey, keys: Sequence[str], reason: RetirementReason) -> Sequence[str]:
        """Retires references; returns the keys of those that were not retired before."""
        if not keys:
            return []
        retired = await asyncio.to_thread(adoption.retire, self._store, scene_key, keys, reason)
        self._observer.count_in_scene(scene_key, "retirements", len(retired), reason.value)
        return retired
