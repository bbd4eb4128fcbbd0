"""Builds the recorder from a server's settings, and names the circumstances that decide its answers."""

import logging
import os
import platform
import sys
from collections.abc import Sequence
from functools import partial
from importlib.metadata import PackageNotFoundError, version

from mapless_server import __version__
from mapless_server.engine.query import Tier
from mapless_server.observability.metrics import Metrics
from mapless_server.observability.provenance import ROOT, commit_of, cpu_model
from mapless_server.security import check_tenant
from mapless_server.settings import Settings
from mapless_server.store import Store

from .calls import CaptureError
from .folder import CaptureFolder, Retention
from .recorder import Recorder

PACKAGES = ("numpy", "scipy", "opencv-python-headless", "poselib", "torch", "kornia")
"""Packages whose arithmetic decides answers."""

DECISIVE_SETTINGS = ("device", "coverage", "retrieval", "max_batch", "compiled_views")
"""Settings of which another value may change an answer, beside features, backend and weights."""


def circumstances_of(settings: Settings, tiers: Sequence[Tier]) -> dict[str, str]:
    """Collects what decides the answers of a server with these settings and tiers on this machine, by name."""
    found = {
        "mapless": __version__,
        "commit": commit_of(ROOT),
        "backend": tiers[0].backend,
        "weights_sha256": tiers[0].weights_sha256,
        "features": ", ".join(tier.features for tier in tiers),
        "processor": f"{cpu_model()}, {platform.machine()}",
        "python": platform.python_version(),
        "blas_threads": os.environ.get("OPENBLAS_NUM_THREADS", ""),
        **{name: str(getattr(settings, name)) for name in DECISIVE_SETTINGS},
        **{name: _version_of(name) for name in PACKAGES},
    }
    return {name: value for name, value in found.items() if value}


def _version_of(package: str) -> str:
    if package in ("torch", "kornia") and package not in sys.modules:
        return ""  # it may be installed, but this server does not use it
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


log = logging.getLogger(__name__)


def open_recorder(settings: Settings, store: Store, metrics: Metrics) -> Recorder | None:
    """Opens the recorder if the settings want one; logs a warning, since photographs are then stored.

    CaptureError if the folder cannot be used, or capture_tenants has an invalid name.
    """
    if settings.capture_dir is None:
        return None
    try:
        tenants = frozenset(check_tenant(it) for it in settings.capture_tenants.split(",") if it)
    except ValueError as error:
        raise CaptureError(f"capture_tenants: {error}") from None
    folder = CaptureFolder(settings.capture_dir, Retention(3600 * settings.capture_hours, settings.capture_mib * 2**20))
    log.warning(
        "calls are captured, photographs and all: %s, for %g hours, %d MiB at most",
        settings.capture_dir,
        settings.capture_hours,
        settings.capture_mib,
    )
    metrics.watch_captures(lambda: folder.disk_bytes)
    return Recorder(folder, store, metrics, partial(circumstances_of, settings), tenants)
