"""Makes the engine and its store from the settings; replaces parts that `auto` would use but are not installed.

Nothing here imports torch unless the settings name a network.
"""

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mapless_server.choices import AUTO, BEST_VARIANTS, OFF, STORED
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Tier
from mapless_server.engine.queue_engine import QueueEngine, check_tiers
from mapless_server.engine.references import References, Retrieval
from mapless_server.engine.stages import Method
from mapless_server.extras import install_hint
from mapless_server.images import ImageLimits
from mapless_server.method.coarse import Reconstructor
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.features.extractors import FeatureExtractor, make_extractor
from mapless_server.method.pairs.correspond import Matcher, make_matcher
from mapless_server.method.pairs.pair import Matching
from mapless_server.method.pipeline import Pipeline
from mapless_server.networks.weights import CATALOGUE, WeightsError, WeightsMissing, find_weights, named
from mapless_server.networks.weights.folder import Status, look_up
from mapless_server.observability.metrics import Metrics
from mapless_server.scenes import GlobalDescriptor
from mapless_server.scenes.audit.neighbourhood import PairMatches
from mapless_server.scenes.audit.scene_auditor import SceneTools
from mapless_server.scenes.background import BackgroundMatching, SceneWork
from mapless_server.scenes.calibration.calibrator import Calibrator, SceneCalibrations
from mapless_server.scenes.depth.scene_depths import DepthMaker, SceneDepths
from mapless_server.scenes.depth_checks import DepthChecks
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.library import ReferenceLibrary
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.scenes.retrieval.vlad import VladDescriptor
from mapless_server.scenes.scene_agreements import SceneAgreements
from mapless_server.scenes.stored import DepthFinder, PairFinder, TierMatching
from mapless_server.scheduling import Observer, Quota, WorkQueueOptions
from mapless_server.security import RateLimiter
from mapless_server.settings import Settings, available_cores
from mapless_server.store import Store, StoreError
from mapless_server.store.depths import depth_kind
from mapless_server.store.pairs import PairStore

from .devices import choose_device

log = logging.getLogger(__name__)

WITHOUT_WEIGHTS = "sift"
"""The features that need nothing."""

ANY_ROLL = WITHOUT_WEIGHTS
"""The features that match however the camera is rolled; the others must be upright."""

ANY_ROLL_PIXELS = 640 * 480
"""Where these follow others, they are found in a photograph of so many pixels. Evidence: any-roll-pixels."""

CPU_TIERS = ((BEST_VARIANTS["edgepoint2"], WITHOUT_WEIGHTS), (ANY_ROLL,), ("aliked",))
GPU_TIERS = (("aliked", BEST_VARIANTS["edgepoint2"], WITHOUT_WEIGHTS), (ANY_ROLL,))
"""The features of `auto`, of each tier the best first, of which the first that can be used is; all licences are free.

On a CPU EdgePoint2 costs half of SIFT and localizes from fewer references, farther apart. ALIKED answers where the
first tier is in doubt: of 159 photographs, 120 of them with 3 to 5 references far apart, SIFT loses 16 at 0.1 s a
photograph, ALIKED 3 at 1 to 3 s, and ALIKED after SIFT the same 3 though only 53 need it. On a GPU ALIKED is as fast,
and is used first. SIFT follows upright features: it costs 0.3 s, matches what is rolled, and shows by how much.
"""

CACHED_AUDIT_PAIRS = 2000
"""Pairs of references whose matches audits keep in memory, about 10 KB a pair."""

WITH_WEIGHTS = frozenset(entry.name for entry in CATALOGUE)


_Missing = dict[str, ImportError | WeightsMissing]
"""Features that `auto` would use, by the names of their weights, and why it cannot."""


class StartupError(Exception):
    """The server cannot start; the message is one sentence for the operator."""


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
        image_limits=image_limits(settings),
        coverage=settings.coverage,
        queue=WorkQueueOptions(
            max_queued_s=settings.max_queued_s,
            max_bytes=settings.max_queued_mib * 2**20,
            stall_limit_s=settings.stall_limit_s,
        ),
    )


def open_store(settings: Settings) -> Store:
    """Opens the store of the settings' database or data folder; StartupError if it cannot be opened."""
    cache_bytes = settings.reference_cache_mib * 2**20
    try:
        if settings.database_url is not None:
            return Store.connect(settings.database_url.get_secret_value(), cache_bytes)
        return Store.open(settings.data_dir, cache_bytes)
    except StoreError as error:
        raise StartupError(str(error)) from error


MakeEngine = Callable[[Settings, Store, Metrics, "RateLimiter | None"], QueueEngine]


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
    extractors = [tier.extractor for tier in tiers]
    first = extractors[0]
    descriptor = parts.descriptor or VladDescriptor.of(first)
    depths = None
    if depth_network is not None or any(tier.uses_depths for tier in tiers):
        kind = None if depth_network is None else depth_kind(depth_network.name, depth_network.weights_sha256)
        depths = DepthFinder(store.database, observed, kind)
    library = ReferenceLibrary(store, depths if any(tier.uses_depths for tier in tiers) else None)
    any_roll = [tier for tier in tiers[1:] if tier.any_roll]
    capacity_bytes = options.index_cache_bytes // (1 + len(any_roll))
    indexes = SceneIndexes(store, library, descriptor, first, capacity_bytes)
    retrievals = [Retrieval(descriptor, first, indexes)]
    for tier in any_roll:  # photographs that are rolled resemble references by these features alone
        own = VladDescriptor.of(tier.extractor)
        retrievals.append(
            Retrieval(own, tier.extractor, SceneIndexes(store, library, own, tier.extractor, capacity_bytes))
        )
    matcher = tiers[0].pipeline.matcher
    pairs = PairMatches(matcher.options.reference_ratio, CACHED_AUDIT_PAIRS)
    # References that are rolled against one another agree only by what matches at any roll.
    comparing = any_roll[0] if any_roll else tiers[0]
    compared = comparing.extractor, comparing.pipeline.matcher
    checks = DepthChecks(store, indexes, library, *compared)
    agreements = SceneAgreements(store, indexes, library, *compared, observed, checks)
    tools = SceneTools(library, indexes, descriptor, first, pairs, checks)
    references = References(tools, retrievals, extractors, options.image_limits, agreements)
    engine = QueueEngine(tiers, references, options, parts.observer, parts.quota, parts.method)
    maker = None
    if depth_network is not None:
        maker = DepthMaker(indexes, first, tiers[0].pipeline.matcher, depth_network)
    made = None if depths is None else SceneDepths(store, depths, maker, observed)
    engine.background = _background_matching(store, indexes, engine, observed, made, depths, agreements)
    return engine


def _background_matching(
    store: Store,
    indexes: SceneIndexes,
    engine: QueueEngine,
    observer: BackgroundObserver,
    made: SceneDepths | None,
    depths: DepthFinder | None,
    agreements: SceneAgreements,
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
    return BackgroundMatching(
        store,
        indexes,
        finders | strong,
        lambda: engine.queue.job_count == 0,
        observer,
        SceneWork(
            SceneCalibrations(store, calibrator, observer, depths if first.uses_depths else None, agreements),
            made,
            agreements,
        ),
    )


def feature_names(settings: Settings, device: str) -> tuple[str, ...]:
    """The features of the settings on "cpu" or "cuda...", the cheapest first; with `auto`, those with weights."""
    return tuple(dict.fromkeys(_present(_tiers(settings.features, device), settings)))


def _tiers(features: str, device: str) -> tuple[tuple[str, ...], ...]:
    """For each tier, the cheapest first, the features that it may use, the best first."""
    if features != AUTO:
        return ((BEST_VARIANTS.get(features, features),), (ANY_ROLL,))
    return CPU_TIERS if device == "cpu" else GPU_TIERS


def make_tiers(settings: Settings) -> tuple[Tier, ...]:
    """Makes the tiers of the settings, the cheapest first.

    `auto` leaves out features without weights or packages, and logs it; in the worst case only SIFT is used. ValueError
    if there is no such device; WeightsError if weights are missing, or do not fit; ImportError if a package that a
    network needs is not installed.
    """
    device = device_for(settings)
    missing = _Missing()
    extractors = _make_extractors(settings, device, missing)
    first, cores = next(iter(extractors)), available_cores()
    matchers = {
        # A stronger tier on a CPU has LightGlue, a third of a second per pair.
        name: make_matcher(name, cores, _find_light_glue(name, settings, missing))
        if device == "cpu" and name != first
        else _make_matcher(name, settings, device)
        for name in extractors
    }
    _log_features(settings, extractors, missing)
    reconstructor = make_reconstructor(
        settings.backend,
        settings.weights_dir,
        device,
        compiled_views=settings.compiled_views,
    )
    uses_depths = settings.reference_depth != OFF and reconstructor.uses_correspondences
    return tuple(
        Tier(
            extractor,
            Pipeline(reconstructor, matchers[name]),
            uses_depths,
            any_roll=name == ANY_ROLL,
            max_pixels=ANY_ROLL_PIXELS if name == ANY_ROLL != first else None,
        )
        for name, extractor in extractors.items()
    )


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


def make_first_features(settings: Settings) -> tuple[str, FeatureExtractor]:
    """Name of the first tier's features, and their extractor; errors as in `make_tiers`."""
    missing = _Missing()
    extractors = _make_extractors(settings, device_for(settings), missing)
    _log_features(settings, extractors, missing)
    return next(iter(extractors.items()))


UNUSABLE = (ImportError, ValueError, WeightsError)
"""The errors of settings that name what is not there, or cannot be used."""


def what_is_missing(error: Exception) -> str:
    """The error for the operator; of a package that is missing, how to get it."""
    return install_hint(error) if isinstance(error, ImportError) else str(error)


def device_for(settings: Settings) -> str:
    """The device of networks; errors as in `choose_device`.

    Without networks it is the CPU: searching for others would import torch, a third of the server's memory.
    """
    needs_none = settings.backend == "geometric" and settings.reference_depth in (OFF, STORED)
    features: Iterable[str] = [settings.features]
    if settings.features == AUTO:
        features = _present([*CPU_TIERS, *GPU_TIERS], settings)
    if settings.device == "auto" and needs_none and all(name == WITHOUT_WEIGHTS for name in features):
        return "cpu"
    return choose_device(settings.device)


def _present(tiers: Iterable[Sequence[str]], settings: Settings) -> Iterator[str]:
    """The first features of each tier whose weights are in the folder, if they need any."""
    for alternatives in tiers:
        for name in alternatives:
            if name not in WITH_WEIGHTS or look_up(named(name), settings.weights_dir).status is not Status.ABSENT:
                yield name
                break


def _make_extractors(settings: Settings, device: str, missing: _Missing) -> dict[str, FeatureExtractor]:
    """Makes the extractor of each tier; adds to `missing` what `auto` leaves out."""
    extractors: dict[str, FeatureExtractor] = {}
    for alternatives in _tiers(settings.features, device):
        for name in alternatives:
            try:
                extractors[name] = extractors.get(name) or _make_extractor(name, settings, device)
                break
            except (ImportError, WeightsMissing) as error:
                if settings.features != AUTO:
                    raise
                missing[name] = error
                _find_light_glue(name, settings, missing)
    return extractors


def _log_features(settings: Settings, present: Iterable[str], missing: _Missing) -> None:
    """Logs what `auto` chose, and what it leaves out."""
    if settings.features != AUTO:
        return
    chosen = " and ".join(present)
    if not missing:
        log.info("features auto: %s", chosen)
        return
    package = next((install_hint(it) for it in missing.values() if isinstance(it, ImportError)), "")
    log.info(
        "features auto: %s; with %s more photographs are localized where references are few or far apart: %s",
        chosen,
        " and ".join(missing),
        package or f"run `mapless-server weights fetch {' '.join(missing)}`",
    )


def _make_extractor(name: str, settings: Settings, device: str) -> FeatureExtractor:
    if name not in WITH_WEIGHTS:
        return make_extractor(name)
    return make_extractor(name, find_weights(name, settings.weights_dir), device)


def _make_matcher(name: str, settings: Settings, device: str) -> Matcher:
    """Makes a matcher: nearest neighbours, or LightGlue on a GPU if its weights are present."""
    network = _light_glue_of(name)
    if device != "cpu" and network is not None:
        try:
            weights = find_weights(network, settings.weights_dir)
            return make_matcher(name, available_cores(), weights, device)
        except WeightsMissing as error:
            log.warning("features %s: matched by nearest neighbours: %s", name, error)
    return make_matcher(name, available_cores())


def _find_light_glue(features: str, settings: Settings, missing: _Missing) -> Path | None:
    """Finds the weights of the features' LightGlue, if there is one; adds them to `missing` if they are missing."""
    network = _light_glue_of(features)
    try:
        return None if network is None else find_weights(network, settings.weights_dir)
    except WeightsMissing as error:
        missing[f"{features}-lightglue"] = error
        return None


def _light_glue_of(features: str) -> str | None:
    """Name of the features' LightGlue in the catalogue; None if there is none."""
    network = f"{features}-lightglue"
    return network if network in WITH_WEIGHTS else None
