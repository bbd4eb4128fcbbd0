"""Counts answered photographs for reports of scenes: noted on the event loop, written in batches in the background.

Noting one takes microseconds. What waits when the process is killed is lost, and so is what comes beyond
`MOST_WAITING`, as while the store is away; a server that stops writes it. A thread that gives way to queries counts.
"""

import asyncio
import logging
import time
from collections import defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from mapless.geometry import MAX_COORDINATE_M, Array
from mapless.names import parse_reference_name
from mapless_server.engine.query import Query, Result, SceneQuestion
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.errors import DataLoss, NotFound, RequestError
from mapless_server.method.bundle.priors import Priors
from mapless_server.method.judge.answer import Localization
from mapless_server.method.options import StageContext
from mapless_server.method.rejection import Rejection
from mapless_server.scenes import Narrowing
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.scenes.report.counting import Places, Sighting, counted
from mapless_server.scheduling.processor import give_way, lower_priority
from mapless_server.security import SceneKey
from mapless_server.services.localization import Localized
from mapless_server.services.photographs import question_in
from mapless_server.store import Store, adoption, counts
from mapless_server.store.counts import DAY_US, LOCALIZED, CountKey, Sums
from mapless_server.store.rows import now_us

log = logging.getLogger(__name__)

WRITE_S = 5.0
"""Time between two transactions."""
TIDY_S = 3600.0
"""Time between deletions of old counts."""
MOST_WAITING = 10_000
"""Photographs that wait to be written, some 20 MB."""

Happened = tuple[SceneKey, int, str, int]
"""Something that happened in a scene: when, microseconds since 1970, and how often."""


@dataclass(frozen=True, eq=False)
class Noted:
    """A photograph that waits to be counted in a scene.

    `scenes` are the questions of several scenes, whose priors count in the one that was found; else empty.
    """

    scene_key: SceneKey
    sighting: Sighting
    scenes: Sequence[SceneQuestion] = ()


class Counting(BackgroundObserver):
    """Counts the photographs of one server, and what becomes of those that are considered as references."""

    def __init__(self, engine: QueueEngine, store: Store, observer: BackgroundObserver, days: int) -> None:
        """Makes the object; counts are kept for so many days, `run` deletes older ones. With 0 nothing is counted."""
        self._engine = engine
        self._store = store
        self._observer = observer
        self._days = days
        self._waiting = deque[Noted]()
        self._happened = deque[Happened]()
        self._writing: asyncio.Future[None] | None = None
        self._thread = ThreadPoolExecutor(1, "counting", lower_priority, (lambda: engine.queue.prompt_count > 0,))

    def note(self, parts: Sequence[tuple[Query, Result]], outcome: object, localization: Localized | None) -> None:
        """Remembers the photographs of an answer; called on the event loop.

        Where a rig or a sequence is localized, all of its photographs are. `localization` is the message of the pose.
        """
        if not self._days:
            return
        room = MOST_WAITING - len(self._waiting)
        if room < len(parts):
            self._dropped(len(parts) - max(0, room))
        for query, result in parts[: max(0, room)]:
            scene_key = result.scene_key or (None if query.scenes else query.scene_key)
            if scene_key is not None:
                sighting = _localized(result, localization) if not isinstance(outcome, Rejection) else None
                sighting = sighting or _rejected(query, result, outcome)
                self._waiting.append(Noted(scene_key, sighting, query.scenes))

    def count(self, name: str, amount: float = 1.0, result: str = "") -> None:
        """Implements BackgroundObserver."""
        self._observer.count(name, amount, result)

    def count_in_scene(self, scene_key: SceneKey, name: str, amount: int = 1, result: str = "") -> None:
        """Implements BackgroundObserver."""
        self._observer.count(name, amount, result)
        if not self._days or not amount:
            return
        if len(self._happened) < MOST_WAITING:
            self._happened.append((scene_key, now_us(), counts.happening(name, result), amount))
        else:
            self._dropped(1)

    async def run(self) -> None:
        """Writes what waits until it is cancelled, and deletes old counts; a failure is logged, and tried again."""
        tidied_s = -TIDY_S
        while True:
            await asyncio.sleep(WRITE_S)
            try:
                await self.write()
                if time.monotonic() - tidied_s >= TIDY_S:
                    tidied_s = time.monotonic()
                    before = now_us() // DAY_US - self._days + 1
                    await asyncio.to_thread(counts.delete_counts, self._store.database, before)
            except RequestError as error:  # the store is away
                log.warning("photographs could not be counted: %s", error)
            except Exception as error:  # must not end the counting
                log.error("photographs could not be counted", exc_info=error)

    async def write(self) -> None:
        """Writes what waits, or waits for the end of a write; RequestError if the store is away, then it waits on.

        A write goes on to its end if the caller is cancelled: what is in the store must not wait any more.
        """
        if self._writing is None or self._writing.done():
            self._writing = asyncio.ensure_future(self._write_waiting())
        await asyncio.shield(self._writing)

    async def close(self) -> None:
        """Writes what waits, after `run` was cancelled; what cannot be written is lost, and logged."""
        try:
            await self.write()  # that which `run` had begun, if it had
            await self.write()
        except Exception as error:
            log.warning("%d photographs could not be counted: %s", len(self._waiting), error)
        self._thread.shutdown(wait=False)

    async def _write_waiting(self) -> None:
        noted, happened = list(self._waiting), list(self._happened)
        if noted or happened:
            try:
                await asyncio.get_running_loop().run_in_executor(self._thread, self._write, noted, happened)
            except RequestError:
                raise
            except Exception as error:  # of no scene alone; would come again
                self._dropped(len(noted) + len(happened))
                log.error("photographs could not be counted, and are left out", exc_info=error)
            for _ in noted:
                self._waiting.popleft()
            for _ in happened:
                self._happened.popleft()

    def _dropped(self, count: int) -> None:
        self._observer.count("scene_counts_dropped", count)

    def _write(self, noted: Sequence[Noted], happened: Sequence[Happened] = ()) -> None:
        of_scene = defaultdict[SceneKey, tuple[list[Noted], list[Happened]]](lambda: ([], []))
        for it in noted:
            of_scene[it.scene_key][0].append(it)
        for that in happened:
            of_scene[that[0]][1].append(that)
        created_us = counts.scenes_created(self._store.database, of_scene.keys())
        found = dict[SceneKey, Mapping[CountKey, Sums]]()
        for key, (its, those) in of_scene.items():
            if key in created_us:
                try:
                    found[key] = self._sums(key, its, those, created_us[key])
                except RequestError:
                    raise
                except Exception as error:  # must not cost other scenes their counts
                    self._dropped(len(its) + len(those))
                    log.error("photographs of scene %s could not be counted, and are left out", key, exc_info=error)
        counts.add_counts(self._store.database, found)

    def _sums(
        self, scene_key: SceneKey, noted: Sequence[Noted], happened: Sequence[Happened], since_us: int
    ) -> dict[CountKey, Sums]:
        """Sums of a scene's counts since it was made; earlier ones are of another that had its id."""
        found = self._counted(scene_key, [it for it in noted if it.sighting.time_us >= since_us])
        for _, time_us, outcome, amount in happened:
            if time_us >= since_us:
                key = CountKey(time_us // DAY_US, "", outcome)
                found[key] = found.get(key, Sums()) + Sums(photograph_count=amount)
        return found

    def _counted(self, scene_key: SceneKey, noted: Sequence[Noted]) -> dict[CountKey, Sums]:
        if not noted:
            return {}
        try:
            indexes = self._engine.references.retrievals[0].indexes
            entries = indexes.entries(scene_key, StageContext(lambda: None), waits=False)
            adopted = adoption.list_adopted(self._store.database, scene_key)
        except (NotFound, DataLoss) as error:  # it was deleted meanwhile, or cannot be read
            log.info("photographs of scene %s are not counted: %s", scene_key, error)
            return {}
        return counted(_giving_way(noted), Places(entries, adopted))


def _giving_way(noted: Sequence[Noted]) -> Iterator[Sighting]:
    for it in noted:
        give_way()
        yield _with_priors(it)


def _localized(result: Result, localization: Localized | None) -> Sighting:
    """A photograph that was localized, alone or with others; its pose is that alone."""
    answer = result.answer
    pose = answer.outcome.world_from_camera if isinstance(answer.outcome, Localization) else None
    radii = None if localization is None else localization.accuracy
    return Sighting(
        now_us(),
        LOCALIZED,
        None if pose is None else pose.translation,
        None,
        None if pose is None else pose.rotation[:, 2],
        _most_similar(result),
        answer.outcome.inlier_count if isinstance(answer.outcome, Localization) else 0,
        None if radii is None else radii.position_68_m,
        _inliers_of(result),
    )


def _rejected(query: Query, result: Result, joint: object) -> Sighting:
    """A photograph that was rejected, alone or, with its own reason if it has one, with others."""
    alone = result.answer.outcome
    rejection = alone if isinstance(alone, Rejection) else joint
    assert isinstance(rejection, Rejection)
    known = alone if isinstance(alone, Localization) else rejection.imprecise
    if known is None:
        expected = _expected(query.priors, query.narrowing)
    else:
        expected = known.world_from_camera.translation, None, known.world_from_camera.rotation[:, 2]
    return Sighting(now_us(), rejection.reason.value, *expected, _most_similar(result))


def _with_priors(noted: Noted) -> Sighting:
    """The photograph with its priors in the scene that was found of several."""
    it = noted.sighting
    if not noted.scenes or it.position is not None:
        return it
    question = question_in(noted.scenes, noted.scene_key)
    position, covariance, forward = _expected(question.priors, question.narrowing)
    return replace(it, position=position, covariance=covariance, forward=forward)


def _expected(priors: Priors, narrowing: Narrowing) -> tuple[Array | None, Array | None, Array | None]:
    """Position (3,), its covariance (3, 3), viewing direction (3,), world, by priors or by limits; None without."""
    position = covariance = forward = None
    if priors.pose is not None:
        position, forward = priors.pose.world_from_camera.translation, priors.pose.world_from_camera.rotation[:, 2]
        covariance = priors.pose.covariance[:3, :3]
    if priors.position is not None:
        position, covariance = priors.position.position, priors.position.covariance
    elif narrowing.position is not None and position is None:
        position = narrowing.position.position
        covariance = min(narrowing.position.radius_m, MAX_COORDINATE_M) ** 2 / 5 * np.eye(3)  # of a full sphere
    if priors.heading is not None:
        forward = np.asarray(priors.heading.in_world)
    elif narrowing.heading is not None and forward is None:
        forward = narrowing.heading.forward
    return position, covariance, forward


def _most_similar(result: Result) -> str:
    """Id of the reference with most matches, or the one that retrieval ranks first; empty if there is none."""
    matches = result.answer.reference_match_counts
    if any(matches) and len(matches) == len(result.references):
        return parse_reference_name(result.references[matches.index(max(matches))].name)[1]
    chosen = () if result.choice is None else result.choice.references
    return chosen[0].reference_id if chosen else ""


def _inliers_of(result: Result) -> dict[str, int]:
    found = zip(result.references, result.answer.reference_inlier_counts, strict=False)
    return {parse_reference_name(it.name)[1]: count for it, count in found if count}
