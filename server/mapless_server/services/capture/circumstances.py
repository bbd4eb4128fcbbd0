"""What decides an answer beside request and references: versions, weights, settings, the machine's arithmetic."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version

from mapless_server import __version__
from mapless_server.engine.query import Tier
from mapless_server.observability.provenance import ROOT, commit_of, cpu_model
from mapless_server.settings import Settings

PACKAGES = ("numpy", "scipy", "opencv-python-headless", "poselib", "torch", "kornia")
"""Whose arithmetic answers are made of."""

DECISIVE_SETTINGS = ("device", "coverage", "retrieval", "max_batch", "compiled_views")
"""Those of which another value may mean another answer; features, backend and weights are told by name."""


def circumstances_of(settings: Settings, tiers: Sequence[Tier]) -> dict[str, str]:
    """Of a server with these settings and tiers, here and now, by name."""
    reconstructor = tiers[0].pipeline.reconstructor
    found = {
        "mapless": __version__,
        "commit": commit_of(ROOT),
        "backend": reconstructor.name,
        "weights_sha256": reconstructor.weights_sha256,
        "features": ", ".join(tier.extractor.name for tier in tiers),
        "processor": f"{cpu_model()}, {platform.machine()}",
        "python": platform.python_version(),
        "blas_threads": os.environ.get("OPENBLAS_NUM_THREADS", ""),
        **{name: str(getattr(settings, name)) for name in DECISIVE_SETTINGS},
        **{name: _version_of(name) for name in PACKAGES},
    }
    return {name: value for name, value in found.items() if value}


def _version_of(package: str) -> str:
    if package in ("torch", "kornia") and package not in sys.modules:
        return ""  # it may be installed, and nothing of this server asks it
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
