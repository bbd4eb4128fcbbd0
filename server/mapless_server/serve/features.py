"""The features of the settings: what finds and matches them, the cheapest first.

`auto` leaves out what is not installed. Of a server on a CPU the later ones, which answer where the first are in doubt,
are made after the start, since torch takes seconds to load. Nothing here imports torch.
"""

import logging
from collections.abc import Iterable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

from mapless_server.choices import AUTO, BEST_VARIANTS, OFF, STORED
from mapless_server.engine.query import Tier
from mapless_server.extras import install_hint
from mapless_server.kernels import adjustment, nearest
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.features.extractors import FeatureExtractor, make_extractor
from mapless_server.method.features.extractors.options import ALIKED_VARIANT, LearnedOptions
from mapless_server.method.features.lightglue_options import CPU_OPTIONS
from mapless_server.method.features.matching import OPTIONS
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pairs.make import make_light_glue, make_matcher
from mapless_server.method.pipeline import Pipeline
from mapless_server.networks.weights import CATALOGUE, WeightsMissing, find_weights, named
from mapless_server.networks.weights.folder import Status, look_up
from mapless_server.settings import Settings, available_cores

from .deferred import DeferredExtractor, DeferredPairMatching
from .devices import choose_device

log = logging.getLogger(__name__)

DESCRIPTOR_LENGTH = 64
"""Numbers of the descriptors that are stored as int8."""

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

WITH_WEIGHTS = frozenset(entry.name for entry in CATALOGUE)


_Missing = dict[str, ImportError | WeightsMissing]
"""Features that `auto` would use, by the names of their weights, and why it cannot."""


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
    first = next(iter(extractors))
    matchers = {
        name: _make_later_matcher(name, settings, missing)
        if device == "cpu" and name != first
        else _make_matcher(name, settings, device)
        for name in extractors
    }
    _log_features(settings, extractors, missing)
    for what, is_compiled in (
        ("descriptors of int8 are compared", nearest.is_available(DESCRIPTOR_LENGTH)),
        ("poses are adjusted", adjustment.IS_COMPILED),
    ):
        log.info("%s by %s", what, "compiled code" if is_compiled else "numpy, in more time")
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


def make_first_features(settings: Settings) -> tuple[str, FeatureExtractor]:
    """Name of the first tier's features, and their extractor; errors as in `make_tiers`."""
    missing = _Missing()
    extractors = _make_extractors(settings, device_for(settings), missing)
    _log_features(settings, extractors, missing)
    return next(iter(extractors.items()))


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
        make = _make_later_extractor if extractors and device == "cpu" else _make_extractor
        for name in alternatives:
            try:
                extractors[name] = extractors.get(name) or make(name, settings, device)
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
    packages = "; ".join(dict.fromkeys(install_hint(it) for it in missing.values() if isinstance(it, ImportError)))
    log.info(
        "features auto: %s; with %s more photographs are localized where references are few or far apart: %s",
        chosen,
        " and ".join(missing),
        packages or f"run `mapless-server weights fetch {' '.join(missing)}`",
    )


def _make_extractor(name: str, settings: Settings, device: str) -> FeatureExtractor:
    if name not in WITH_WEIGHTS:
        return make_extractor(name)
    return make_extractor(name, find_weights(name, settings.weights_dir), device)


def _make_later_extractor(name: str, settings: Settings, device: str) -> FeatureExtractor:
    """The extractor of a tier after the first: with official weights, which fit, it is made when it is needed first."""
    sha256 = _official_sha256(name, settings) if name == "aliked" else None
    if sha256 is None:
        return _make_extractor(name, settings, device)
    for package in ("torch", "kornia"):
        if find_spec(package) is None:
            raise ModuleNotFoundError(f"No module named {package!r}", name=package)
    label = LearnedOptions().label(ALIKED_VARIANT, sha256)
    return DeferredExtractor(label, lambda: _make_extractor(name, settings, device))


def _make_later_matcher(name: str, settings: Settings, missing: _Missing) -> Matcher:
    """The same of a matcher, with LightGlue for references that are matched again: a third of a second per pair."""
    weights, cores = _find_light_glue(name, settings, missing), available_cores()
    sha256 = None if weights is None else _official_sha256(f"{name}-lightglue", settings)
    if weights is None or sha256 is None:
        return make_matcher(name, cores, weights)
    light_glue = DeferredPairMatching(CPU_OPTIONS.label(sha256), lambda: make_light_glue(name, weights))
    return Matcher(OPTIONS[name], cores, pair_matching=light_glue)


def _official_sha256(name: str, settings: Settings) -> str | None:
    """Digest of the weights in the folder, if they are the official ones; None for others."""
    weights = named(name)
    is_official = look_up(weights, settings.weights_dir).status is Status.OFFICIAL
    return weights.sha256 if is_official else None


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
