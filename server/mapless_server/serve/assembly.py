"""Makes the engine from the settings; replaces parts that `auto` would use but are not installed.

Nothing here imports torch unless the settings name a network.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mapless_server.choices import OFF, STORED
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Tier
from mapless_server.engine.queue_engine import QueueEngine, check_tiers
from mapless_server.engine.references import References, Retrieval
from mapless_server.engine.stages import Method
from mapless_server.images import ImageLimits
from mapless_server.method.coarse import Reconstructor
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.pairs.pair import Matching
from mapless_server.networks.weights import WeightsError, WeightsMissing, find_weights
from mapless_server.observability.metrics import Metrics
from mapless_server.scenes.audit.neighbourhood import PairMatches
from mapless_server.scenes.audit.scene_auditor import SceneTools
from mapless_server.scenes.background import BackgroundMatching, SceneWork
from mapless_server.scenes.calibration.calibrator import Calibrator, SceneCalibrations
from mapless_server.scenes.depth.scene_depths import DepthMaker, SceneDepths
from mapless_server.scenes.depth_checks import DepthChecks
from mapless_server.scenes.index_files import IndexFiles
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.later import LaterFeatures
from mapless_server.scenes.library import ReferenceLibrary
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.scenes.retrieval.index import GlobalDescriptor
from mapless_server.scenes.retrieval.vlad import VladDescriptor
from mapless_server.scenes.scene_agreements import SceneAgreements
from mapless_server.scenes.stored import DepthFinder, PairFinder, TierMatching
from mapless_server.scheduling import Observer, Quota, WorkQueueOptions
from mapless_server.security import RateLimiter
from mapless_server.settings import Settings, cache_dir
from mapless_server.store import Store
from mapless_server.store.depths import depth_kind
from mapless_server.store.pairs import PairStore

from .devices import choose_device
from .features import device_for, make_tiers
from .startup import StartupError, what_is_missing

log = logging.getLogger(__name__)

CACHED_AUDIT_PAIRS = 2000
"""Pairs of references whose matches audits keep in memory, about 10 KB a pair."""


def image_limits(settings: Settings) -> ImageLimits:
    """Limits of images from the settings."""
    return ImageLimits(
        max_bytes=settings.max_image_mib * 2**20, max_pixels=round(settings.max_image_megapixels * 1_000_000)
    )


def engine_options(settings: Settings) -> EngineOptions:
    """Options of the engine from the settings."""
    return EngineOptions(
        workers=settings.workers,
        max_batch=settings.max_batch,
        index_cache_bytes=settings.retrieval_cache_mib * 2**20,
        index_dir=_index_dir(settings),
        image_limits=image_limits(settings),
        coverage=settings.coverage,
        queue=WorkQueueOptions(
            max_queued_s=settings.max_queued_s,
            max_bytes=settings.max_queued_mib * 2**20,
            stall_limit_s=settings.stall_limit_s,
        ),
    )


def _index_dir(settings: Settings) -> Path:
    """The folder of the index files of large scenes: beside the store, or in the user's cache where that is shared."""
    if settings.index_dir is not None:
        return settings.index_dir
    return settings.data_dir / "indexes" if settings.database_url is None else cache_dir("indexes")


def make_engine(settings: Settings, store: Store, metrics: Metrics, quota: RateLimiter | None) -> QueueEngine:
    """Makes the engine of the settings; StartupError if they name a device or weights that are missing."""
    try:
        tiers = make_tiers(settings)
        descriptor = make_descriptor(settings, tiers[0].extractor)
        network = make_depth_network(settings, tiers)
        options = engine_options(settings)
        parts = Parts(metrics, quota, descriptor=descriptor, background_observer=metrics, depth_network=network)
        return engine_over(store, tiers, options, parts)
    except UNUSABLE as error:
        raise StartupError(what_is_missing(error)) from error


@dataclass(frozen=True, eq=False)
class Parts:
    """Parts of an engine besides its tiers; each has a default.

    Attributes:
        observer, quota, method: see `QueueEngine`.
        descriptor: chooses references; None makes one from the first tier's features.
        background_observer: is notified of what is computed in the background.
        depth_network: makes the depths that are stored with references; None makes none.
    """

    observer: Observer | None = None
    quota: Quota | None = None
    method: Method | None = None
    descriptor: GlobalDescriptor | None = None
    background_observer: BackgroundObserver = field(default_factory=BackgroundObserver)
    depth_network: Reconstructor | None = None


def engine_over(store: Store, tiers: Sequence[Tier], options: EngineOptions, parts: Parts | None = None) -> QueueEngine:
    """Makes an engine over tiers, the cheapest first, and the references in memory that it uses.

    ValueError if there is no tier, two have the same extractor or matcher, or the descriptor uses other features.
    """
    parts = parts or Parts()
    observed, depth_network = parts.background_observer, parts.depth_network
    check_tiers(tiers)
    first = tiers[0].extractor
    descriptor = parts.descriptor or VladDescriptor.of(first)
    depths = None
    if depth_network is not None or any(tier.uses_depths for tier in tiers):
        kind = None if depth_network is None else depth_kind(depth_network.name, depth_network.weights_sha256)
        depths = DepthFinder(store.database, observed, kind)
    library = ReferenceLibrary(store, depths if any(tier.uses_depths for tier in tiers) else None)
    any_roll = [tier for tier in tiers[1:] if tier.any_roll]
    capacity_bytes = options.index_cache_bytes // (1 + len(any_roll))

    def indexes_by(by: GlobalDescriptor, extractor: FeatureExtractor) -> SceneIndexes:
        files = None
        if options.index_dir is not None:
            files = IndexFiles(store, by, options.index_dir, lambda: library.is_idle(), observed)
        return SceneIndexes(store, library, by, extractor, capacity_bytes, files)

    indexes = indexes_by(descriptor, first)
    retrievals = [Retrieval(descriptor, first, indexes)]
    for tier in any_roll:  # photographs that are rolled resemble references by these features alone
        own = VladDescriptor.of(tier.extractor)
        retrievals.append(Retrieval(own, tier.extractor, indexes_by(own, tier.extractor)))
    matcher = tiers[0].pipeline.matcher
    pairs = PairMatches(matcher.options.reference_ratio, CACHED_AUDIT_PAIRS)
    # References that are rolled against one another agree only by what matches at any roll.
    comparing = any_roll[0] if any_roll else tiers[0]
    compared = comparing.extractor, comparing.pipeline.matcher
    checks = DepthChecks(store, indexes, library, *compared)
    agreements = SceneAgreements(store, indexes, library, *compared, observed, checks)
    tools = SceneTools(library, indexes, descriptor, first, pairs, checks)
    references = References(tools, retrievals, options.image_limits, agreements)
    engine = QueueEngine(tiers, references, options, parts.observer, parts.quota, parts.method)
    maker = None
    if depth_network is not None:
        maker = DepthMaker(indexes, first, tiers[0].pipeline.matcher, depth_network)
    made = None if depths is None else SceneDepths(store, depths, maker, observed)
    library.is_idle = lambda: engine.queue.job_count == 0
    indexes_of = {it.extractor.name: it.indexes for it in retrievals[1:]}
    features = [LaterFeatures(it.extractor, indexes_of.get(it.extractor.name)) for it in tiers[1:]]
    engine.background = _background_matching(store, indexes, engine, observed, made, depths, agreements, features)
    return engine


def _background_matching(
    store: Store,
    indexes: SceneIndexes,
    engine: QueueEngine,
    observer: BackgroundObserver,
    made: SceneDepths | None,
    depths: DepthFinder | None,
    agreements: SceneAgreements,
    features: Sequence[LaterFeatures],
) -> BackgroundMatching:
    """Makes the matching for the queries of each tier, in order; queries look for its results from then on."""
    pairs = PairStore(store.database)
    finders, strong = dict[TierMatching, PairFinder](), dict[TierMatching, PairFinder]()
    for tier in engine.tiers:
        matcher = tier.pipeline.matcher
        matcher.pairs.stored = finder = PairFinder(pairs, tier.extractor.name, observer)
        finders |= {TierMatching(tier.extractor, matcher, it): finder for it in Matching if not it.is_strong}
        if matcher.pair_matching is not None:  # last, because it takes long
            strong |= {TierMatching(tier.extractor, matcher, it): finder for it in Matching if it.is_strong}
    first = engine.tiers[0]
    # Answers of stronger tiers, some per cent, keep the generic radii: their references take too long to localize.
    calibrator = Calibrator(indexes, first.extractor, first.pipeline, first.kind)
    background = BackgroundMatching(
        store,
        indexes,
        finders | strong,
        lambda: engine.queue.job_count == 0,
        observer,
        SceneWork(
            SceneCalibrations(store, calibrator, observer, depths if first.uses_depths else None, agreements),
            made,
            agreements,
            features,
        ),
    )
    engine.references.pending = background.pending
    return background


def make_depth_network(settings: Settings, tiers: Sequence[Tier]) -> Reconstructor | None:
    """Makes the network of the depths stored with references; None without one. Errors as in `make_tiers`."""
    name = settings.reference_depth
    if name in (OFF, STORED):
        return None
    reconstructor = tiers[0].pipeline.reconstructor
    if reconstructor.name == name:
        return reconstructor
    return make_reconstructor(name, settings.weights_dir, device_for(settings), answers_queries=False)


def make_descriptor(settings: Settings, extractor: FeatureExtractor) -> GlobalDescriptor:
    """Makes the descriptor for choosing references; `extractor` is the first tier's. Errors as in `make_tiers`.

    `auto` is MegaLoc if networks run on a CUDA device and its weights are present: on a CPU it takes seconds.
    """
    if settings.retrieval == "vlad" or (settings.retrieval == "auto" and device_for(settings) == "cpu"):
        return VladDescriptor.of(extractor)
    try:
        from mapless_server.scenes.retrieval.megaloc import MegaLocDescriptor

        return MegaLocDescriptor(find_weights("megaloc", settings.weights_dir), choose_device(settings.device))
    except (ImportError, WeightsMissing):
        if settings.retrieval != "auto":
            raise
    return VladDescriptor.of(extractor)


UNUSABLE = (ImportError, ValueError, WeightsError)
"""The errors of settings that name what is not there, or cannot be used."""
