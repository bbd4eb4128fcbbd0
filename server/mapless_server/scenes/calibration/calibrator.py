"""Localizes references of a scene against the others, as queries are localized."""

import logging
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice, zip_longest

import numpy as np
from scipy.spatial import KDTree

from mapless_server.errors import DataLoss, NotFound
from mapless_server.method.bundle.estimate import PosedSupport, accuracy_from_covariance, viewpoint_gap
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.views import PosedView
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.localize import refine
from mapless_server.method.options import LocalizeOptions, StageContext
from mapless_server.method.pairs.readings.repeats import pose_difference
from mapless_server.method.pipeline import Pipeline, prepare, reconstruct
from mapless_server.method.rejection import Rejection
from mapless_server.security import SceneKey
from mapless_server.store import SelfCalibration, Store
from mapless_server.store.adoption import list_adopted
from mapless_server.store.calibrations import (
    CLAIM_S,
    LEAST_REFERENCES,
    CalibrationClaim,
    add,
    claim_scene,
    count_waiting,
    discard_damaged,
    is_waiting,
    list_newest,
    postpone,
    release,
    renew,
)

from ..indexes import SceneIndexes
from ..library import Closed, ReferenceLibrary
from ..observer import BackgroundObserver
from ..retrieval.index import Entries
from ..retrieval.ranking import rank_beside, spread_choice
from ..scene_agreements import SceneAgreements
from ..stored import DepthFinder
from .fit import LeftOut, fit
from .lens import LENS_REFERENCES, SharedErrors, lens_contradiction, shared_errors, without_errors

log = logging.getLogger(__name__)


FIRST_SAMPLE = 8
"""References that the first calibration localizes, before there is idle time. Evidence: first-answers."""
SAMPLE = 40
"""Largest number of references of a scene that are localized against the others."""
MAX_CPU_S = 8.5
"""Processor time of the calling thread after which no further reference is begun, for each (also incomplete) thousand
references of the scene; twice, if these have a wrong lens. With the matcher's threads the total is at most 2.4 times as
much, if the matches of the references are stored."""
REFERENCE_COUNT, SHORTLIST = 10, 20
"""References that each is localized with, and those of which they are chosen; as for queries by default."""


@dataclass(frozen=True, eq=False)
class _Surveyed:
    """The references of a scene whose poses are independent of one another's: all that were not adopted.

    Attributes:
        scene_key: the scene.
        entries: its references in use, of one generation.
        ids: those that were not adopted; None for all.
        library: with their features.
    """

    scene_key: SceneKey
    entries: Entries
    ids: Collection[str] | None
    library: ReferenceLibrary

    @classmethod
    def of(
        cls, scene_key: SceneKey, entries: Entries, adopted: Collection[str], library: ReferenceLibrary
    ) -> "_Surveyed":
        """The references of a scene without the `adopted`, given by id."""
        if not adopted:
            return cls(scene_key, entries, None, library)
        ids = (entries.reference(row)[0] for row in entries.rows().tolist())
        return cls(scene_key, entries, [it for it in ids if it not in adopted], library)


class Calibrator:
    """Calibrates scenes for the answers of one tier."""

    def __init__(
        self,
        indexes: SceneIndexes,
        extractor: FeatureExtractor,
        pipeline: Pipeline,
        kind: str,
        max_cpu_s: float = MAX_CPU_S,
    ) -> None:
        """`kind` is that of the tier's answers, see `store.calibration_kind`."""
        self._indexes = indexes
        self._extractor = extractor
        self._pipeline = pipeline
        self.kind = kind
        self._max_cpu_s = max_cpu_s

    def calibrate(
        self,
        scene_key: SceneKey,
        library: ReferenceLibrary,
        newest: Sequence[str],
        pause: Callable[[], None],
        contradicts_itself: bool = False,
        count: int = SAMPLE,
        adopted: Collection[str] = (),
    ) -> SelfCalibration:
        """Localizes so many references of a scene, and fits the model to the results.

        `newest` are ids of its latest references, the latest first. Those of the `adopted` are left out on both sides:
        their poses were computed from the others, which would localize them, and be localized by them, too well.
        `pause` is called between the stages of each, and may raise, which ends it.
        Of fewer than `LENS_REFERENCES` no errors of the lens are sought. In a scene that
        `contradicts_itself` none are localized: its poses measure nothing.
        NotFound if there is no such scene (field "scene").
        """
        context = StageContext(pause)
        entries = self._indexes.entries(scene_key, context)
        surveyed = _Surveyed.of(scene_key, entries, adopted, library)
        sample = [] if contradicts_itself else self._sample(surveyed, newest, count)
        shared: list[SharedErrors] = []
        # Few references show errors of a lens that more of them do not.
        results = self._localize(surveyed, sample, context, shared if count >= LENS_REFERENCES else None)
        found, lens = fit(results, self.kind, entries.generation), lens_contradiction(shared)
        if lens is None:
            return found
        log.warning("scene %s: %s", scene_key, lens)
        # With the same wrong lens references agree with one another. Photographs with the right one are off by more, or
        # rejected, so that nothing is known of them.
        results = self._localize(surveyed, sample, context, lens=lens)
        right = fit(results, self.kind, entries.generation)
        return replace(right if right.answer_count else found, lens=str(lens))

    def _localize(
        self,
        surveyed: _Surveyed,
        sample: Sequence[str],
        context: StageContext,
        shared: list[SharedErrors] | None = None,
        lens: SharedErrors | None = None,
    ) -> list[LeftOut]:
        """Localizes each of a sample against the others, without errors `lens`; appends what it shows to `shared`."""
        begin_s, results = time.thread_time(), []
        most_s = self._max_cpu_s * max(1, -(-len(surveyed.entries) // 1000))
        for reference_id in sample:
            if time.thread_time() - begin_s > most_s:
                break
            result = self._leave_out(surveyed, reference_id, context, shared, lens)
            if result is not None:
                results.append(result)
            context.check()
        return results

    def _sample(self, surveyed: _Surveyed, newest: Sequence[str], count: int) -> list[str]:
        """Ids of so many references to leave out: the newest and the worst covered by turns."""
        entries, rows = surveyed.entries, surveyed.entries.rows(surveyed.ids)
        if len(rows) < LEAST_REFERENCES:
            return []
        centres = entries.centres(rows)
        nearest_m = KDTree(centres).query(centres, k=2)[0][:, 1]
        by_distance = (entries.reference(rows[i])[0] for i in np.argsort(-nearest_m, kind="stable"))
        known_newest = [it for it in newest if it in entries]
        by_turns = chain.from_iterable(zip_longest(known_newest, islice(by_distance, count)))
        return [it for it in dict.fromkeys(by_turns) if it is not None][:count]

    def _leave_out(
        self,
        surveyed: _Surveyed,
        reference_id: str,
        context: StageContext,
        shared: list[SharedErrors] | None,
        lens: SharedErrors | None,
    ) -> LeftOut | None:
        """Localizes one reference; None if it has too few others, or is deleted or damaged."""
        load = partial(
            self._indexes.load_existing,
            surveyed.library,
            surveyed.scene_key,
            extractor=self._extractor,
            context=context,
        )
        loaded = load(reference_ids=[reference_id])
        if not loaded:
            return None
        (subject,) = loaded
        if lens is not None:
            subject = without_errors(subject, lens)
        wanted = [it.reference_id for it in rank_beside(surveyed.entries, reference_id, SHORTLIST, surveyed.ids)]
        others = [it for it in load(reference_ids=wanted) if not _is_copy(it, subject)]
        if len(others) < 2:
            return None
        context.check()
        matches = self._pipeline.matcher.match_quickly(subject.view, others, context.check)
        centres = [it.world_from_camera.translation for it in others]
        chosen = spread_choice([len(it) for it in matches], centres, REFERENCE_COUNT)
        references, chosen_matches = [others[i] for i in chosen], [matches[i] for i in chosen]
        if shared is not None and len(shared) < LENS_REFERENCES:
            found = shared_errors(subject, references, chosen_matches)
            shared.extend([found] if found else [])
        options = LocalizeOptions(coverage=1.0)
        prepared = prepare(subject.view, references, self._pipeline, options, context, chosen_matches)
        if isinstance(prepared, Rejection):
            return None
        (coarse,) = reconstruct([prepared])
        if isinstance(coarse, Exception):
            raise coarse
        return left_out(subject, refine(coarse))


def left_out(subject: PosedView, answer: Answer) -> LeftOut | None:
    """Compares the answer to a reference with its pose; None if it was rejected."""
    outcome, support = answer.outcome, answer.support
    if not isinstance(outcome, Localization) or outcome.covariance is None or not isinstance(support, PosedSupport):
        return None
    return LeftOut(
        *pose_difference(outcome.world_from_camera, subject.world_from_camera),
        accuracy_from_covariance(outcome.covariance),
        outcome.trust or 0.0,
        *viewpoint_gap(support),
    )


def _is_copy(first: PosedView, second: PosedView) -> bool:
    """Whether two references are the same photograph, which would be localized by its own pose."""
    one, other = first.view.photograph, second.view.photograph
    return one is not None and other is not None and one.sha256 == other.sha256


_CACHE_BYTES = 32 * 2**20
"""Features that are kept from one reference to the next, of about 30."""

LEAST_WAIT_S = 60.0
WAIT_BY_CPU = 50.0
"""After a calibration its scene is not calibrated again, however often it changes, for so long: 2 % of a core."""


class _Lost(Exception):
    """Another server has claimed the scene, or it was deleted."""


class SceneCalibrations:
    """Calibrates the scenes of a store; for use by one thread."""

    def __init__(
        self,
        store: Store,
        calibrator: Calibrator,
        observer: BackgroundObserver,
        depths: DepthFinder | None = None,
        agreements: SceneAgreements | None = None,
    ) -> None:
        """The `observer` receives the events; `depths` are those that queries use.

        The agreements say which scenes contradict themselves; None knows none.
        """
        self._agreements = agreements
        self._depths = depths
        self._store = store
        self._calibrator = calibrator
        self._observer = observer

    @property
    def kind(self) -> str:
        """Kind of the answers that it calibrates."""
        return self._calibrator.kind

    def is_waiting(self, scene_key: SceneKey) -> bool:
        """Whether a scene has changed since its calibration."""
        return is_waiting(self._store.database, scene_key, self.kind)

    def calibrate_next(self, pause: Callable[[], None], is_first: bool = False) -> bool:
        """Calibrates one scene that may be claimed now; returns False if there is none. Raises if the store fails.

        With `is_first` one without a calibration of any kind, or with a first one and twice as many references since,
        from a few of its references. `pause` is called in the middle of the work; it may raise, which ends it.
        """
        database = self._store.database
        claim = claim_scene(database, self.kind, is_first)
        self._observer.waiting("calibration_waiting", count_waiting(database, self.kind))
        if claim is None:
            return False
        with suppress(_Lost, NotFound):
            self._calibrate(claim, pause, is_first)
        return True

    def maintain(self) -> None:
        """Deletes damaged calibrations, so that they are made again."""
        count = discard_damaged(self._store.database, self.kind)
        if count:
            log.error("%d damaged calibrations of scenes are made again", count)

    def _calibrate(self, claim: CalibrationClaim, pause: Callable[[], None], is_first: bool) -> None:
        """Calibrates one scene, or postpones it if that fails."""
        held = [claim]

        def renew_and_pause() -> None:
            if held[0].until_us / 1e6 - time.time() < CLAIM_S * 3 / 4:
                renewed = renew(self._store.database, held[0])
                if renewed is None:
                    raise _Lost
                held[0] = renewed
            pause()

        begin_s = time.thread_time()
        try:
            found = self._localize_references(claim, renew_and_pause, FIRST_SAMPLE if is_first else SAMPLE)
        except (_Lost, NotFound):
            raise
        except Closed:
            release(self._store.database, held[0])
            raise
        except Exception as error:
            self._report_failure(held[0], error)
            return
        cpu_s = time.thread_time() - begin_s
        wait_s = 0.0 if is_first else max(LEAST_WAIT_S, WAIT_BY_CPU * cpu_s)
        if add(self._store, held[0], found, wait_s, is_first):
            self._observer.count("calibrations")
            self._observer.count("calibration_cpu_seconds", cpu_s)
            log.info("scene %s is calibrated from %d of its references", claim.scene_key, found.answer_count)

    def _localize_references(self, claim: CalibrationClaim, pause: Callable[[], None], count: int) -> SelfCalibration:
        newest = list_newest(self._store.database, claim.scene_key, SAMPLE)
        adopted = {it.reference_id for it in list_adopted(self._store.database, claim.scene_key)}
        # Of its own, so that references that queries use stay in memory.
        with closing(ReferenceLibrary(self._store.uncached(_CACHE_BYTES), self._depths)) as library:
            is_wrong = self._agreements is not None and self._agreements.known(claim.scene_key).contradicts_itself
            return self._calibrator.calibrate(claim.scene_key, library, newest, pause, is_wrong, count, adopted)

    def _report_failure(self, claim: CalibrationClaim, error: Exception) -> None:
        wait_s = postpone(self._store.database, claim)
        self._observer.count("calibration_failures")
        message = "scene %s could not be calibrated from its references, next time in %.0f s: %s"
        log.warning(message, claim.scene_key, wait_s, error, exc_info=None if isinstance(error, DataLoss) else error)
