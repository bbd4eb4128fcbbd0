"""Makes the depths of references without any, one after the other, for all servers of a database."""

import logging
import time
from collections.abc import Callable
from contextlib import closing

from mapless_server.errors import DataLoss, NotFound
from mapless_server.store import Store
from mapless_server.store.depths import discard_depths, keep_depths, list_kinds, list_without
from mapless_server.store.pairs import Claim, PairStore, Progress

from ..library import Closed, ReferenceLibrary
from ..observer import BackgroundObserver
from .finder import DepthFinder
from .maker import DepthMaker

log = logging.getLogger(__name__)

CLAIM_S = 1800.0
"""Far longer than a network takes for a reference and its neighbours, also on a CPU."""

_CACHE_BYTES = 32 * 2**20


class SceneDepths:
    """Makes depths for the references of a store; for use by one thread."""

    def __init__(
        self, store: Store, finder: DepthFinder, maker: DepthMaker | None, observer: BackgroundObserver
    ) -> None:
        """Without a maker, depths of other servers are used, but none are made."""
        self._store = store
        self._finder = finder
        self._maker = maker
        self._observer = observer
        self._claims = PairStore(store.database, CLAIM_S)
        self._progress = Progress()
        self._is_abandoned = False

    def abandon(self) -> None:
        """Ends storing, since the store will be closed while the network computes."""
        self._is_abandoned = True

    @property
    def kinds(self) -> list[str]:
        """The kinds of depths in use, for `record_use`."""
        return list_kinds(self._store.database) if self._maker is None else [self._maker.kind]

    def maintain(self) -> None:
        """Deletes damaged depths that queries have found, so that they are made again."""
        damaged = self._finder.take_damaged()
        if damaged:
            discard_depths(self._store.database, damaged)

    def make_next(self, pause: Callable[[], None]) -> bool:
        """Makes the depth of one reference that may be claimed now; False if there is none. Raises if the store fails.

        `pause` is called in the middle of the work; it may raise, which ends it.
        """
        if self._maker is None:
            return False
        kind = self._maker.kind
        claim = self._claims.claim(kind, self._progress)
        self._observer.waiting("depth_waiting", self._claims.count_waiting(kind))
        if claim is None:
            return False
        # The network has seen a reference already as the neighbour of another one.
        if list_without(self._store.database, kind, [claim.key]):
            self._make(self._maker, claim, pause)
        else:
            self._claims.add(kind, claim, {}, is_complete=True)
        return True

    def _make(self, maker: DepthMaker, claim: Claim, pause: Callable[[], None]) -> None:
        """Makes the depth of a claimed reference, or postpones it if that fails."""
        begin_s = time.monotonic()
        try:
            # Of its own, so that references that queries use stay in memory.
            with closing(ReferenceLibrary(self._store.uncached(_CACHE_BYTES))) as library:
                made = maker.make(claim.scene_key, library, claim.reference_id, pause)
        except Closed:
            if self._is_abandoned:  # the claim ends by itself
                raise
            self._claims.add(maker.kind, claim, {}, is_complete=False)
            raise
        except NotFound:  # the reference was deleted
            self._claims.postpone(maker.kind, claim)
            return
        except Exception as error:
            wait_s = self._claims.postpone(maker.kind, claim)
            self._observer.count("depth_failures")
            message = "no depth could be made for reference %s of scene %s, next time in %.0f s: %s"
            expected = None if isinstance(error, DataLoss) else error
            log.warning(message, claim.reference_id, claim.scene_key, wait_s, error, exc_info=expected)
            return
        depths = {key: depth for key, depth in made.items() if depth is not None}
        keep_depths(self._store.database, maker.kind, depths)
        self._claims.add(maker.kind, claim, {}, is_complete=True)
        self._observer.count("depths", len(depths), "kept")
        self._observer.count("depths", len(made) - len(depths), "dropped")
        self._observer.count("depth_seconds", time.monotonic() - begin_s)
        if claim.key not in depths:
            log.info("no depth is kept of reference %s of scene %s", claim.reference_id, claim.scene_key)
