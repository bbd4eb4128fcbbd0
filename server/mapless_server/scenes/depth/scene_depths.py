"""Makes the depths of references without any, one after the other, for all servers of a database."""

import logging
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace

from mapless_server.errors import DataLoss, NotFound
from mapless_server.method.coarse import Reconstructor, Request, Triangulation
from mapless_server.method.coarse.scale import estimate_scale
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.views import KeptDepth, PosedView
from mapless_server.method.options import StageContext
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pairs.pair import Matching
from mapless_server.method.rejection import Rejection
from mapless_server.security import SceneKey
from mapless_server.store import Store
from mapless_server.store.depths import depth_kind, discard_depths, keep_depths, list_kinds, list_without
from mapless_server.store.pairs import Claim, PairStore, Progress

from ..indexes import SceneIndexes
from ..library import Closed, ReferenceLibrary
from ..observer import BackgroundObserver
from ..retrieval.ranking import rank_beside, spread_choice
from ..stored import DepthFinder
from .check import MIN_POINTS, checked_depths

NEIGHBOURS, SHORTLIST = 7, 14
"""References that the network gets besides the wanted one, and those that are matched with it, of which the best are
used. As many as in a query of ten references need half of its memory."""


class DepthMaker:
    """Makes and checks depths with one network, of references with one extractor's features."""

    def __init__(
        self, indexes: SceneIndexes, extractor: FeatureExtractor, matcher: Matcher, network: Reconstructor
    ) -> None:
        """`matcher` is that of the extractor's features."""
        self._indexes = indexes
        self._extractor = extractor
        self._matcher = matcher
        self._network = network

    @property
    def kind(self) -> str:
        """Kind of the depths."""
        return depth_kind(self._network.name, self._network.weights_sha256)

    def make(
        self, scene_key: SceneKey, library: ReferenceLibrary, reference_id: str, check: Callable[[], None]
    ) -> dict[str, KeptDepth | None]:
        """Makes the depths of a reference and of its neighbours that the network gets with it, by key.

        A depth that is not kept is None. The result is empty if the reference has fewer than two neighbours that share
        matches with it. `check` is called between the steps, and may raise, which ends it. NotFound if the reference or
        the scene was deleted, DataLoss if the reference is damaged, or any exception of the network.
        """
        context = StageContext(check)
        scene, (subject,) = library.load(scene_key, [reference_id], self._extractor, context)
        neighbours = self._neighbours(scene_key, library, subject, reference_id, context)
        if len(neighbours) < 2:
            return {}
        origin = subject.world_from_camera.translation
        query, *others = neighbours
        given = [replace(it, world_from_camera=it.world_from_camera.shifted(-origin)) for it in (subject, *others)]
        correspondences = self._matcher.correspond(query.view, (subject, *others), Matching.STRICT, check)
        is_metric = not scene.attributes.arbitrary_unit
        request = Request(query.view, given, correspondences, is_metric=is_metric)
        (outcome,) = self._network.reconstruct_many([request])
        check()
        if isinstance(outcome, Exception):
            raise outcome
        nothing = dict.fromkeys(it.key for it in given)
        if isinstance(outcome, Rejection | Triangulation):  # only a network predicts depths
            return nothing
        scale = estimate_scale(outcome, given, correspondences)
        if isinstance(scale, Rejection):
            return nothing
        true_pose = query.world_from_camera.shifted(-origin)
        depths = checked_depths(outcome, scale, given, true_pose, correspondences)
        return dict(zip(nothing, depths, strict=True))

    def _neighbours(
        self,
        scene_key: SceneKey,
        library: ReferenceLibrary,
        subject: PosedView,
        reference_id: str,
        context: StageContext,
    ) -> list[PosedView]:
        """The references that share most matches with one, from different places, the best first."""
        entries = self._indexes.entries(scene_key, context)
        if reference_id not in entries:
            raise NotFound("the reference was deleted")
        wanted = [it.reference_id for it in rank_beside(entries, reference_id, SHORTLIST)]
        others = self._indexes.load_existing(library, scene_key, wanted, self._extractor, context)
        matches = [self._matcher.pairs.match(subject, other) for other in others]
        context.check()
        sharing = [i for i, found in enumerate(matches) if len(found) >= MIN_POINTS]
        centres = [others[i].world_from_camera.translation for i in sharing]
        return [others[sharing[i]] for i in spread_choice([len(matches[i]) for i in sharing], centres, NEIGHBOURS)]


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
