"""Has localized photographs become references of scenes that adopt, after they were answered, while the server is idle.

An answer is offered on the event loop, which takes less than a millisecond; one task then takes one photograph after
another, when nothing has been computed for callers for a while. What is decided, and why, is in
`scenes.adoption.policy`. Photographs wait in memory, in a queue that is bounded in number and bytes, and those that
wait when the server stops are forgotten.
"""

import asyncio
import hashlib
import logging
import time
from collections.abc import Callable
from datetime import datetime, timezone

from mapless.answers import Accuracy
from mapless.geometry import Array
from mapless.provenance import ADOPTED, MOST_VOUCHERS, Provenance, Voucher
from mapless.scenes import AdoptionPolicy
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.engine.query import Photo, Query, Result
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.errors import AlreadyExists, NotFound
from mapless_server.method.judge.answer import Localization
from mapless_server.scenes.adoption import policy as rules
from mapless_server.scenes.adoption.policy import AdoptionOptions, Evidence, Refusal
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.security import Principal, SceneKey
from mapless_server.store import NewReference, Store, adoption, time_us

from .evidence import (
    distance_shown,
    has_its_camera,
    inliers_px,
    is_by_survey,
    kept_query,
    keypoints_px,
    rival_count,
    with_stated_camera,
)
from .keeping import Keeper, guarded
from .surveyed import Place, SurveyedLocalizer
from .waiting import Candidate, Waiting

log = logging.getLogger(__name__)

QUIET_S = 1.0
LOOK_S = 0.02
MAINTAINED_S = 60.0


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
        self._options = options
        self._quiet_s = quiet_s
        self._now = now
        self._waiting = Waiting()
        self._localizer = SurveyedLocalizer(engine, store)
        self._keeper = Keeper(engine, store, observer, self._localizer, hours)

    def offer(self, asked: pb.LocalizeOptions, query: Query, result: Result, principal: Principal) -> pb.AdoptionOffer:
        """Remembers an answered photograph whose call allows adoption, if it may be adopted; says why not.

        Called on the event loop, after the answer is made; it takes less than a millisecond.
        """
        policy = result.attributes.adoption
        if asked.confidential:
            return pb.ADOPTION_OFFER_CONFIDENTIAL
        if query.reference_ids:
            return pb.ADOPTION_OFFER_REFERENCES_NAMED
        if not isinstance(result.answer.outcome, Localization) or result.scene_key is None:
            return pb.ADOPTION_OFFER_NOT_LOCALIZED
        if policy is None:
            return pb.ADOPTION_OFFER_SCENE_ADOPTS_NOTHING
        coverage = self._engine.options.coverage
        evidence, kept = self._localizer.evidence(query, result), kept_query(query, result, policy, coverage)
        if evidence is None or kept is None:
            self._observer.count_in_scene(result.scene_key, "adoptions", 1, "uncertain")
            return pb.ADOPTION_OFFER_UNCERTAIN
        holder, now_s = rules.holder_of(principal), time.monotonic()
        as_stated, by_survey = with_stated_camera(kept, query), is_by_survey(result)
        matches_px, distance_m = inliers_px(result), distance_shown(result)
        candidate = Candidate(kept, as_stated, evidence, by_survey, matches_px, distance_m, holder, now_s)
        self._observer.count("adoptions", self._waiting.add(candidate), "queue")
        if not rules.is_certain(policy, evidence):  # it is considered for what it says of its place
            return pb.ADOPTION_OFFER_UNCERTAIN
        return pb.ADOPTION_OFFER_WAITING if candidate in self._waiting else pb.ADOPTION_OFFER_QUEUE_FULL

    async def run(self) -> None:
        """Considers what is offered until it is cancelled; each failure is logged and counted, and ends nothing.

        What is too old is deleted meanwhile, also while the server is never idle.
        """
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._maintain_always())
            while True:
                await self._waiting.arrived(MAINTAINED_S)
                await self._until_idle()
                if (candidate := self.take()) is not None:
                    await guarded(self.consider(candidate), "a photograph is not considered", self._observer)

    def take(self) -> Candidate | None:
        """Removes and returns the photograph that was offered first; None if none waits."""
        return self._waiting.pop()

    async def _maintain_always(self) -> None:
        while True:
            self._observer.count("adoptions", self._waiting.drop_old(), "queue")
            await self.maintain()
            await asyncio.sleep(MAINTAINED_S)

    async def _until_idle(self) -> None:
        queue, since_s = self._engine.queue, time.monotonic()
        busy_s = queue.busy_s
        while time.monotonic() - since_s < self._quiet_s:
            await asyncio.sleep(LOOK_S)
            if queue.job_count or queue.busy_s > busy_s:
                busy_s, since_s = queue.busy_s, time.monotonic()

    async def maintain(self) -> None:
        """Deletes adopted references that are too old, and retires those whose vouching references are gone.

        Each failure is logged and counted.
        """
        await self._keeper.maintain(self._now(), self._options or AdoptionOptions())

    async def consider(self, candidate: Candidate) -> Refusal | None:
        """Adopts a photograph, or says why not; also counts what it says of the references around.

        RequestError if the store is away.
        """
        try:
            return await self._considered(candidate)
        except NotFound as error:  # the scene was deleted meanwhile
            log.info("a photograph is not considered: %s", error)
            return self._counted(candidate.query.scene_key, rules.Refusal.CHANGED)

    async def _considered(self, candidate: Candidate) -> Refusal | None:
        options, scene_key = self._options or rules.AdoptionOptions(), candidate.query.scene_key
        policy = (await asyncio.to_thread(self._store.get_attributes, scene_key)).adoption
        if policy is None:
            return self._counted(scene_key, rules.Refusal.CHANGED)
        pose, distance_m = candidate.answered.world_from_camera, candidate.distance_m
        place = await asyncio.to_thread(self._localizer.place, scene_key, pose, distance_m, options)
        if place is None:
            return self._counted(scene_key, rules.Refusal.CHANGED)
        result = await self._localizer.localized(candidate.query, place.surveyed_ids, candidate.query.photo.mask)
        surveyed = self._localizer.evidence(candidate.query, result)
        share = await self._surveyed_share(candidate, place, result, options)
        is_outdated = await self._keeper.learn(candidate, place, share, policy, self._now(), options)
        refused = rules.refusal(policy, candidate.answered, surveyed, share, options)
        if refused is None and is_outdated:
            refused = rules.Refusal.LITTLE_SURVEYED
        if refused is None and not has_its_camera(candidate.query, result):
            refused = rules.Refusal.UNSUPPORTED
        if refused is None and surveyed is not None:
            refused = await self._refusal_by_pixels(candidate, place, surveyed, result, options)
        if refused is None and surveyed is not None:
            refused = await self._adopt(candidate, place, surveyed, share, policy, options)
        if surveyed is not None and rules.is_certain(policy, surveyed):
            await self._keeper.count_contradictions(candidate, place, surveyed, result, self._now(), options)
        return self._counted(scene_key, refused)

    def _counted(self, scene_key: SceneKey, refused: Refusal | None) -> Refusal | None:
        self._observer.count_in_scene(scene_key, "adoptions", 1, "adopted" if refused is None else refused.value)
        return refused

    async def _surveyed_share(
        self, candidate: Candidate, place: Place, result: Result, options: AdoptionOptions
    ) -> float:
        """How much of what a photograph's answer explains the survey explains alone; `result` is as it is kept.

        Asked with what its call stated of its camera: that a lens or a shutter is not as a reference needs it says
        nothing of the place. An answer without adopted references shows that the survey is there, also where it needs
        the call's priors or depth.
        """
        if candidate.by_survey:
            return 1.0
        if candidate.as_stated is not candidate.query:
            result = await self._localizer.localized(
                candidate.as_stated, place.surveyed_ids, candidate.query.photo.mask
            )
        if not isinstance(result.answer.outcome, Localization):
            return 0.0
        camera = candidate.query.photo.camera
        size_px, surveyed_px = (camera.width_px, camera.height_px), inliers_px(result)
        return await asyncio.to_thread(rules.surveyed_share, size_px, candidate.inliers_px, surveyed_px, options)

    async def _refusal_by_pixels(
        self, candidate: Candidate, place: Place, surveyed: Evidence, result: Result, options: AdoptionOptions
    ) -> Refusal | None:
        """Why a photograph is not adopted by what the matches leave unexplained; None if it may be."""
        photo = candidate.query.photo
        size_px = photo.camera.width_px, photo.camera.height_px
        by_all = await asyncio.to_thread(rules.explained, size_px, candidate.inliers_px, options)
        if rules.novelty(keypoints_px(result), by_all) < options.min_novelty:
            return rules.Refusal.NOTHING_NEW
        if await asyncio.to_thread(rival_count, result) >= options.min_rivals:
            return rules.Refusal.ELSEWHERE
        ignored = await asyncio.to_thread(self._explained_by, photo, size_px, inliers_px(result), options)
        other = self._localizer.evidence(
            candidate.query, await self._localizer.localized(candidate.query, place.surveyed_ids, ignored)
        )
        return None if other is None or other.agrees_with(surveyed) else rules.Refusal.ELSEWHERE

    def _explained_by(self, photo: Photo, size_px: tuple[int, int], inliers: Array, options: AdoptionOptions) -> bytes:
        """A mask of what matches explain, and of what the photograph's own mask ignores."""
        explained = rules.explained(size_px, inliers, options)
        own = photo.read_ignored(self._engine.options.image_limits)
        return rules.mask_of(explained if own is None else explained | own)

    async def _adopt(
        self,
        candidate: Candidate,
        place: Place,
        surveyed: Evidence,
        share: float,
        policy: AdoptionPolicy,
        options: AdoptionOptions,
    ) -> Refusal | None:
        """Stores a photograph as a reference, in place of the least useful one where its place is full."""
        scene_key, photo = candidate.query.scene_key, candidate.query.photo
        (found,) = await self._engine.describe([photo], self._localizer.caller(scene_key), gives_way=True)
        vouchers = sorted(surveyed.inliers_of.items(), key=lambda it: -it[1])[:MOST_VOUCHERS]
        radii = surveyed.position_68_m, surveyed.position_95_m, surveyed.rotation_68_deg, surveyed.rotation_95_deg
        vouching = tuple(Voucher(name, count) for name, count in vouchers)
        voucher_keys = [place.key_of[name] for name, _ in vouchers]
        new = NewReference(
            adopted_id(photo.image),
            photo.image,
            photo.camera,
            surveyed.world_from_camera,
            found.views,
            found.descriptors,
            photo.mask,
            Provenance(ADOPTED, Accuracy(*radii), share, vouching, surveyed.covariance.tolist()),
            place_key=place.key,
            usefulness=options.first_usefulness,
            adopted_by=rules.adopter_of(candidate.holder, time_us(self._now())),
        )
        try:
            record, left = await asyncio.to_thread(
                adoption.adopt, self._store, scene_key, new, voucher_keys, policy.most_per_place
            )
        except adoption.PlaceFull:
            return rules.Refusal.PLACE_FULL
        except (adoption.NotAdopted, AlreadyExists) as error:  # by the operator, or another server
            log.info("a photograph is not adopted: %s", error)
            return rules.Refusal.CHANGED
        self._engine.forget_references(left)
        self._engine.references.agreements.changed(scene_key)
        log.info("scene %s adopts %s at the place of %s", scene_key, record.reference_id, place.reference_id)
        return None


def adopted_id(image: bytes) -> str:
    """The id of the reference that a photograph becomes: two servers that adopt it give it the same."""
    return f"adopted-{hashlib.sha256(image).hexdigest()[:32]}"
