"""Makes the backend that a setting names. Imports torch only for a network.

A further network needs its name in `choices.NETWORKS` and an entry, with its class, in the weights' catalogue.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from mapless_server.choices import AUTO, BACKENDS, NETWORKS
from mapless_server.networks.weights import WeightsMissing, find_weights, named

from . import Reconstructor
from .geometric import GeometricReconstructor

if TYPE_CHECKING:
    from .network import NetworkOptions

log = logging.getLogger(__name__)

COMPILED_ASPECTS = ((4, 3), (3, 4))
"""Aspects of most cameras, landscape and portrait."""


def make_reconstructor(
    backend: str,
    weights_dir: Path,
    device: str = "cpu",
    options: NetworkOptions | None = None,
    compiled_views: int = 0,
    answers_queries: bool = True,
) -> Reconstructor:
    """Makes the backend that a setting names: one of `BACKENDS`, or `auto`, on "cpu" or a CUDA device.

    `auto` is a network if its weights are in the folder and there is a CUDA device; otherwise it is `geometric`, and
    the reason is logged. A network is compiled for photographs of 4:3, landscape or portrait, with `compiled_views`,
    the query included, which takes minutes; 0 compiles nothing. `answers_queries` says whether queries wait for it, so
    that a CPU is worth a warning.

    ValueError for an unknown name; WeightsMissing if the network's weights are not in the folder, with the command that
    fetches them; CheckpointError if they do not fit the network; ImportError if a package that networks need is not
    installed.
    """
    if backend not in (AUTO, *BACKENDS):
        raise ValueError(f"unknown backend {backend!r}; known: {', '.join((AUTO, *BACKENDS))}")
    if backend == AUTO:
        backend = _choose(weights_dir, device)
    if backend == "geometric":
        return GeometricReconstructor()
    if device == "cpu" and answers_queries:
        log.warning("backend %s on the CPU: minutes for a query, so calls need longer deadlines", backend)
    return _load(backend, find_weights(backend, weights_dir), device, options, compiled_views)


def _choose(weights_dir: Path, device: str) -> str:
    """The backend that `auto` means on this machine; logs the reason."""
    problem: str | None = "there is no CUDA device, and on a CPU a network takes minutes for a query"
    if device != "cpu":
        missing = {name: _missing(name, weights_dir) for name in NETWORKS}
        for name, sentence in missing.items():
            if sentence is None:
                log.info("backend auto: %s serves, whose weights have the licence %s", name, named(name).licence)
                return name
        problem = missing[NETWORKS[0]]
    log.warning("backend auto: geometric serves, not a network: %s", problem)
    return "geometric"


def _missing(name: str, weights_dir: Path) -> str | None:
    """The message about missing weights; None if they are in the folder."""
    try:
        find_weights(name, weights_dir)
    except WeightsMissing as error:
        return str(error)
    return None


def _load(
    backend: str,
    weights: Path,
    device: str,
    options: NetworkOptions | None,
    compiled_views: int,
) -> Reconstructor:
    import torch

    from mapless_server.networks.checkpoint import load_strictly
    from mapless_server.networks.runner import CompiledShape, NetworkRunner

    from .grids import fitted_grid
    from .network import NetworkOptions, NetworkReconstructor

    options = options or NetworkOptions()
    known = named(backend)
    with torch.device("meta"):
        network = known.network_class()()
    # On the host, where the runner reduces the precision before the weights are copied to the device.
    with known.naming_the_licence():
        weights_sha256 = load_strictly(network, weights)
        known.check_terms(weights_sha256, str(weights))
    compiler = "inductor" if compiled_views else None
    runner = NetworkRunner(network, backend, weights_sha256, device, compile_backend=compiler)
    if compiled_views:
        log.info("backend %s: compiling for %d views", backend, compiled_views)
        grids = (fitted_grid(*aspect, options.pixel_limit) for aspect in COMPILED_ASPECTS)
        runner.warm_up([CompiledShape((grid.rows, grid.columns), compiled_views) for grid in grids])
    return NetworkReconstructor(runner, options)
