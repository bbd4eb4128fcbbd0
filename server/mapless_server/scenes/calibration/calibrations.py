"""Calibrates the scenes that have changed, one after the other, for all servers of a database."""

import logging
import time
from collections.abc import Callable
from contextlib import closing, suppress

from mapless_server.errors import DataLoss, NotFound
from mapless_server.store import SelfCalibration, Store
from mapless_server.store.calibrations import (
    CLAIM_S,
    CalibrationClaim,
    add,
    claim_scene,
    count_waiting,
    discard_damaged,
    list_newest,
    postpone,
    release,
    renew,
)

from ..depth.finder import DepthFinder
from ..library import Closed, ReferenceLibrary
from ..observer import BackgroundObserver
from .calibrator import Calibrator

log = logging.getLogger(__name__)

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
        self, store: Store, calibrator: Calibrator, observer: BackgroundObserver, depths: DepthFinder | None = None
    ) -> None:
        """The `observer` receives the events; `depths` are those that queries use."""
        self._depths = depths
        self._store = store
        self._calibrator = calibrator
        self._observer = observer

    @property
    def kind(self) -> str:
        """Kind of the answers that it calibrates."""
        return self._calibrator.kind

    def calibrate_next(self, pause: Callable[[], None]) -> bool:
        """Calibrates one scene that may be claimed now; returns False if there is none. Raises if the store fails.

        `pause` is called in the middle of the work; it may raise, which ends it.
        """
        database = self._store.database
        claim = claim_scene(database, self.kind)
        self._observer.waiting("calibration_waiting", count_waiting(database, self.kind))
        if claim is None:
            return False
        with suppress(_Lost, NotFound):
            self._calibrate(claim, pause)
        return True

    def maintain(self) -> None:
        """Deletes damaged calibrations, so that they are made again."""
        count = discard_damaged(self._store.database, self.kind)
        if count:
            log.error("%d damaged calibrations of scenes are made again", count)

    def _calibrate(self, claim: CalibrationClaim, pause: Callable[[], None]) -> None:
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
            found = self._localize_references(claim, renew_and_pause)
        except (_Lost, NotFound):
            raise
        except Closed:
            release(self._store.database, held[0])
            raise
        except Exception as error:
            self._report_failure(held[0], error)
            return
        cpu_s = time.thread_time() - begin_s
        if add(self._store, held[0], found, max(LEAST_WAIT_S, WAIT_BY_CPU * cpu_s)):
            self._observer.count("calibrations")
            self._observer.count("calibration_cpu_seconds", cpu_s)
            log.info("scene %s is calibrated from %d of its references", claim.scene_key, found.answer_count)

    def _localize_references(self, claim: CalibrationClaim, pause: Callable[[], None]) -> SelfCalibration:
        newest = list_newest(self._store.database, claim.scene_key, self._calibrator.options.sample)
        # Of its own, so that references that queries use stay in memory.
        with closing(ReferenceLibrary(self._store.uncached(_CACHE_BYTES), self._depths)) as library:
            return self._calibrator.calibrate(claim.scene_key, library, newest, pause)

    def _report_failure(self, claim: CalibrationClaim, error: Exception) -> None:
        wait_s = postpone(self._store.database, claim)
        self._observer.count("calibration_failures")
        message = "scene %s could not be calibrated from its references, next time in %.0f s: %s"
        log.warning(message, claim.scene_key, wait_s, error, exc_info=None if isinstance(error, DataLoss) else error)
