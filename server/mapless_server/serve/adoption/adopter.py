"""Has localized photographs become references of scenes that adopt, after they were answered, while the server is idle.

An answer is offered on the event loop, which takes microseconds; one task then takes one photograph after another, when
nothing has been computed for callers for a while. What is decided, and why, is in `scenes.adoption.policy`. Photographs
wait in memory, in a queue that is bounded in number and bytes, and those that wait when the server stops are forgotten.
"""

import asyncio
import hashlib
import logging
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone

import numpy as np

from mapless.answers import Accuracy
from mapless.axes import Axes
from mapless.geometry import Array, RigidTransform
from mapless.provenance import ADOPTED, MOST_VOUCHERS, Provenance, Voucher
from mapless.scenes import AdoptionPolicy
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.engine.query import Caller, Photo, Query, Result
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.errors import AlreadyExists, NotFound, RequestError
from mapless_server.method.bundle.priors import NO_PRIORS
from mapless_server.method.options import StageContext
from mapless_server.scenes import ANYWHERE
from mapless_server.scenes.adoption import policy as rules
from mapless_server.scenes.adoption.policy import AdoptionOptions, Evidence, Refusal
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.scheduling import Flow
from mapless_server.security import Principal, SceneKey, tenant_of
from mapless_server.services.messages.answers import AnswerFrames, outcome_to_message
from mapless_server.store import NewReference, RetirementReason, Store, adoption, time_us
from mapless_server.store.records import Adopted, Standing

from .evidence import distance_shown, evidence_of, inliers_px, keypoints_px, shares_compared
from .waiting import Candidate, Waiting

log = logging.getLogger(__name__)

MOST_CHOSEN_AMONG = 1000
"""Surveyed references that a photograph is localized from again: the nearest, as many as a request may name."""
MOST_COMPARED, MOST_SUPPORTING = 6, 4
"""References that are compared with a photograph only to learn whether it contradicts them, and those beside them."""
LIMIT_S = 120.0
"""For each localization; the server is idle."""
QUIET_S = 1.0
LOOK_S = 0.02
MAINTAINED_S = 60.0
MOST_LOST_SHARE = 0.5
"""Share of the vouching matches of an adopted reference whose references may be gone."""
OWN_CALLER = "adoption"
"""Jobs are the scene's tenant's, from whose share of computing time they are, by a caller of their own."""


@dataclass(frozen=True, eq=False)
class Place:
    """The references of a scene around a candidate.

    Attributes:
        surveyed_ids, surveyed_keys, centres, axes: those that were not adopted; centres (N, 3) and axes (N, 3), world.
        key: of the surveyed one that stands nearest, whose place it is.
        reference_id: id of that one.
    """

    surveyed_ids: Sequence[str]
    surveyed_keys: Sequence[str]
    centres: Array
    axes: Array
    key: str
    reference_id: str


class Adopter:
    """Considers answered photographs, one after another, and deletes adopted ones that are too old."""

    def __init__(
        self,
        engine: QueueEngine,
        store: Store,
        observer: BackgroundObserver,
        hours: float,
        options: AdoptionOptions | None = None,
        *,
        quiet_s: float = QUIET_S,
        now: Callable[[], datetime] = lambda: datetime.now(timezone.utc),
    ) -> None:
        """Makes the object; nothing is considered before `run`, or `consider`.

        Adopted references are deleted when they are `hours` old. The server counts as idle when nothing was computed
        for callers for `quiet_s`.
        """
        self._engine = engine
        self._store = store
        self._observer = observer
        self._hours = hours
        self._options = options
        self._quiet_s = quiet_s
        self._now = now
        self._waiting = Waiting()
        self._checked: dict[SceneKey, int] = {}
        """Generations of the scenes at which all that vouches for their adopted references was looked up."""

    def offer(
        self,
        request: pb.LocalizeRequest,
        response: pb.LocalizeResponse,
        query: Query,
        result: Result,
        principal: Principal,
    ) -> None:
        """Remembers an answered photograph that may be adopted; called on the event loop, after the answer is made."""
        policy, asked = result.attributes.adoption, request.options
        if policy is None or not asked.allow_adoption or asked.confidential or query.reference_ids or query.scenes:
            return
        if query.photo.exif is not None:  # its camera is a guess
            return
        evidence = evidence_of(response, result)
        if evidence is None or evidence.trust < policy.min_trust or evidence.position_68_m > policy.max_radius_m:
            self._observer.count("adoptions", 1, "uncertain")
            return
        kept = replace(query, photo=replace(query.photo, depth=None))
        holder, now_s = rules.holder_of(principal), time.monotonic()
        left = self._waiting.add(Candidate(kept, evidence, inliers_px(result), holder, now_s))
        self._observer.count("adoptions", left, "queue")

    async def run(self) -> None:
        """Considers what is offered until it is cancelled; each failure is logged and counted, and ends nothing.

        What is too old is deleted meanwhile, also while the server is never idle.
        """
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._maintain_always())
            while True:
                await self._waiting.arrived(MAINTAINED_S)
                await self._until_idle()
                if (candidate := self._waiting.pop()) is not None:
                    await self._guarded(self.consider(candidate), "a photograph could not be considered as a reference")

    async def _maintain_always(self) -> None:
        while True:
            self._observer.count("adoptions", self._waiting.drop_old(), "queue")
            await self._guarded(self.maintain(), "adopted references could not be looked after")
            await asyncio.sleep(MAINTAINED_S)

    async def _guarded(self, work: Awaitable[object], fault: str) -> None:
        try:
            await work
        except RequestError as error:  # the scene is gone, the store is away, the server ends
            self._observer.count("adoptions", 1, "failed")
            log.warning("%s: %s", fault, error)
        except Exception as error:
            self._observer.count("adoptions", 1, "failed")
            log.error("%s", fault, exc_info=error)

    async def _until_idle(self) -> None:
        queue, since_s = self._engine.queue, time.monotonic()
        busy_s = queue.busy_s
        while time.monotonic() - since_s < self._quiet_s:
            await asyncio.sleep(LOOK_S)
            if queue.job_count or queue.busy_s > busy_s:
                busy_s, since_s = queue.busy_s, time.monotonic()

    async def maintain(self) -> None:
        """Deletes adopted references that are too old, and retires those whose vouching references are gone."""
        before = self._now() - timedelta(hours=self._hours)
        for scene_key, reference_id in await asyncio.to_thread(adoption.list_expired, self._store.database, before):
            await asyncio.to_thread(self._delete, scene_key, reference_id)
            self._observer.count("adopted_expired")
        scenes = await asyncio.to_thread(adoption.list_adopting_scenes, self._store.database)
        for scene_key, generation in scenes.items():
            if self._checked.get(scene_key) != generation:
                lost = await asyncio.to_thread(adoption.missing_vouchers, self._store.database, scene_key)
                gone = [key for key, share in lost.items() if share > MOST_LOST_SHARE]
                await self._retire(scene_key, gone, RetirementReason.VOUCHERS_GONE)
        self._checked = scenes

    async def consider(self, candidate: Candidate) -> Refusal | None:
        """Adopts a photograph, or says why not; also counts what it says of the references around.

        RequestError if the scene is gone or the store is away.
        """
        options, scene_key = self._options or rules.AdoptionOptions(), candidate.query.scene_key
        policy = (await asyncio.to_thread(self._store.get_attributes, scene_key)).adoption
        if policy is None:
            return self._counted(rules.Refusal.CHANGED)
        place = await asyncio.to_thread(self._place, scene_key, candidate.answered.world_from_camera)
        if place is None:
            return self._counted(rules.Refusal.CHANGED)
        result = await self._localized(candidate.query, place.surveyed_ids, candidate.query.photo.mask)
        surveyed = self._evidence(candidate.query, result)
        is_outdated = await self._learn(candidate, place, surveyed, policy, options)
        refused = rules.refusal(policy, candidate.answered, surveyed, options)
        if refused is None and is_outdated:
            refused = rules.Refusal.LITTLE_SURVEYED
        if refused is None and surveyed is not None:
            refused = await self._refusal_by_pixels(candidate, place, surveyed, result, options)
        if refused is None and surveyed is not None:
            refused = await self._adopt(candidate, place, surveyed, policy, options)
        if surveyed is not None and rules.is_certain(policy, surveyed):
            await self._count_contradictions(candidate, place, surveyed, result, options)
        return self._counted(refused)

    def _counted(self, refused: Refusal | None) -> Refusal | None:
        self._observer.count("adoptions", 1, "adopted" if refused is None else refused.value)
        return refused

    def _place(self, scene_key: SceneKey, pose: RigidTransform) -> Place | None:
        """The references around a pose; None without surveyed ones."""
        context = StageContext(lambda: None)
        entries = self._engine.references.retrievals[0].indexes.entries(scene_key, context, waits=False)
        adopted = [it.key for it in adoption.list_adopted(self._store.database, scene_key)]
        rows = np.setdiff1d(entries.rows(), list(entries.rows_of_keys(adopted).values()), assume_unique=True)
        distance = np.linalg.norm(entries.centres(rows) - pose.translation, axis=1)
        if len(rows) > MOST_CHOSEN_AMONG:
            some = np.argpartition(distance, MOST_CHOSEN_AMONG)[:MOST_CHOSEN_AMONG]
            rows, distance = rows[some], distance[some]
        chosen = rows[np.argsort(distance, kind="stable")]
        if not len(chosen):
            return None
        centres, axes = entries.centres(chosen), entries.axes(chosen)
        ids, keys = zip(*(entries.reference(row)[:2] for row in chosen.tolist()), strict=True)
        nearest = rules.nearest_viewpoint(centres, axes, pose)
        return Place(ids, keys, centres, axes, keys[nearest], ids[nearest])

    async def _localized(
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
        return await engine.run(engine.query_job(again, self._caller(query.scene_key)))

    @staticmethod
    def _caller(scene_key: SceneKey) -> Caller:
        return Caller(Flow(tenant_of(scene_key), OWN_CALLER), time.monotonic() + LIMIT_S)

    @staticmethod
    def _evidence(query: Query, result: Result) -> Evidence | None:
        response = outcome_to_message(result, query.options, AnswerFrames(Axes.OPENCV, None), query.photo)
        return evidence_of(response, result)

    async def _refusal_by_pixels(
        self, candidate: Candidate, place: Place, surveyed: Evidence, result: Result, options: AdoptionOptions
    ) -> Refusal | None:
        """Why a photograph is not adopted by what the matches leave unexplained; None if it may be."""
        photo = candidate.query.photo
        size_px = photo.camera.width_px, photo.camera.height_px
        by_all = await asyncio.to_thread(rules.explained, size_px, candidate.inliers_px, options)
        if rules.novelty(keypoints_px(result), by_all) < options.min_novelty:
            return rules.Refusal.NOTHING_NEW
        ignored = await asyncio.to_thread(self._explained_by, photo, size_px, inliers_px(result), options)
        other = self._evidence(candidate.query, await self._localized(candidate.query, place.surveyed_ids, ignored))
        return None if other is None or other.agrees_with(surveyed) else rules.Refusal.ELSEWHERE

    def _explained_by(self, photo: Photo, size_px: tuple[int, int], inliers: Array, options: AdoptionOptions) -> bytes:
        """A mask of what matches explain, and of what the photograph's own mask ignores."""
        explained = rules.explained(size_px, inliers, options)
        own = photo.read_ignored(self._engine.options.image_limits)
        return rules.mask_of(explained if own is None else explained | own)

    async def _learn(
        self,
        candidate: Candidate,
        place: Place,
        surveyed: Evidence | None,
        policy: AdoptionPolicy,
        options: AdoptionOptions,
    ) -> bool:
        """Counts what a photograph says of its place, and of the adopted references there; whether it is outdated."""
        database, answered, scene_key = self._store.database, candidate.answered, candidate.query.scene_key
        share = rules.surveyed_share(answered, surveyed)

        def learned(_: str, known: Standing) -> Standing:
            # Once outdated it stays so until a new survey: answers by what is left of the old one say nothing.
            # A masked photograph shows what its mask has left.
            is_left = bool(candidate.query.photo.mask) or rules.is_outdated(known, policy, options)
            return known if is_left else rules.with_share(known, share, options)

        made = await asyncio.to_thread(adoption.change_standings, database, [place.key], learned)
        here = [it for it in await self._adopted(candidate) if it.place_key == place.key and not it.is_retired]
        if any(rules.is_outdated(it, policy, options) for it in made.values()):
            if await self._retire(scene_key, [it.key for it in here], RetirementReason.SURVEY_OUTDATED):
                log.warning("scene %s: the place of %s needs a new survey", scene_key, place.reference_id)
            return True
        total = max(answered.inlier_count, 1)
        useful = {
            it.key: rules.with_usefulness(it.usefulness, answered.inliers_of.get(it.reference_id, 0) / total, options)
            for it in here
        }
        await asyncio.to_thread(adoption.set_usefulness, database, useful)
        return False

    async def _count_contradictions(
        self, candidate: Candidate, place: Place, surveyed: Evidence, result: Result, options: AdoptionOptions
    ) -> None:
        """Counts what a photograph says of the surveyed references that should show what it shows, and retires some."""
        if candidate.query.photo.mask:  # what does not show a reference may be all that the mask has left
            return
        scene_key, now_us = candidate.query.scene_key, time_us(self._now())
        shares = await self._shares(candidate.query, place, surveyed, result, options)
        standings = await asyncio.to_thread(
            adoption.change_standings,
            self._store.database,
            shares,
            lambda key, it: rules.with_photograph(it, shares[key], now_us, candidate.holder, options),
        )
        contradicted = [key for key, it in standings.items() if rules.is_contradicted(it, options)]
        await self._retire(scene_key, contradicted, RetirementReason.CONTRADICTED)

    async def _adopted(self, candidate: Candidate) -> list[Adopted]:
        return await asyncio.to_thread(adoption.list_adopted, self._store.database, candidate.query.scene_key)

    async def _shares(
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
            compared = await self._localized(query, [*supporting, *left], query.photo.mask, rerank=False)
            found = self._evidence(query, compared)
            if found is not None and found.agrees_with(surveyed):
                shares = shares_compared(found, compared) | shares
        return {key: shares[it] for it, key in key_of.items() if it in shares}

    async def _adopt(
        self,
        candidate: Candidate,
        place: Place,
        surveyed: Evidence,
        policy: AdoptionPolicy,
        options: AdoptionOptions,
    ) -> Refusal | None:
        """Stores a photograph as a reference, in place of the least useful one where its place is full."""
        scene_key, photo = candidate.query.scene_key, candidate.query.photo
        (found,) = await self._engine.describe([photo], self._caller(scene_key))
        vouchers = sorted(surveyed.inliers_of.items(), key=lambda it: -it[1])[:MOST_VOUCHERS]
        radii = (surveyed.position_68_m, surveyed.position_95_m, surveyed.rotation_68_deg, surveyed.rotation_95_deg)
        share = rules.surveyed_share(candidate.answered, surveyed)
        vouching = tuple(Voucher(name, count) for name, count in vouchers)
        new = NewReference(
            f"adopted-{hashlib.sha256(photo.image).hexdigest()[:32]}",
            photo.image,
            photo.camera,
            surveyed.world_from_camera,
            found.views,
            found.descriptors,
            photo.mask,
            Provenance(ADOPTED, Accuracy(*radii), share, vouching),
            place_key=place.key,
            usefulness=options.first_usefulness,
        )
        try:
            record, left = await asyncio.to_thread(adoption.adopt, self._store, scene_key, new, policy.most_per_place)
        except adoption.PlaceFull:
            return rules.Refusal.PLACE_FULL
        except (adoption.NotAdopted, AlreadyExists) as error:  # by the operator, or another server
            log.info("a photograph is not adopted: %s", error)
            return rules.Refusal.CHANGED
        self._engine.forget_references(left)
        self._engine.references.agreements.changed(scene_key)
        log.info("scene %s adopts %s at the place of %s", scene_key, record.reference_id, place.reference_id)
        return None

    def _delete(self, scene_key: SceneKey, reference_id: str) -> None:
        with suppress(NotFound):  # another server was first
            self._engine.forget_references({self._store.delete_reference(scene_key, reference_id)})

    async def _retire(self, scene_key: SceneKey, keys: Sequence[str], reason: RetirementReason) -> Sequence[str]:
        """Retires references; returns the keys of those that were not retired."""
        if not keys:
            return []
        retired = await asyncio.to_thread(adoption.retire, self._store, scene_key, keys, reason)
        self._observer.count("retirements", len(retired), reason.value)
        return retired
