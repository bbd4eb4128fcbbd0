"""What figures come from: code, weights, settings, machine, day. Figures without them cannot be reproduced."""

from __future__ import annotations

import hashlib
import subprocess
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from .. import __version__
from ..assembly import device_for, feature_names
from ..machine import cpu_model
from ..settings import Settings, available_cores
from ..weights import CATALOGUE
from ..weights.folder import Status, look_up, recorded

ROOT = Path(__file__).parents[3]
CODE = ("server", "client")
"""What of a checkout decides on figures."""


@dataclass(frozen=True)
class Provenance:
    """What figures come from.

    Attributes:
        version: of mapless.
        commit: `git describe` of a checkout, with a digest of what is not committed; empty for an installed package.
        weights: SHA-256 of each network's file that these settings use; "not recorded" for one put there by hand.
        settings: those that figures depend on.
        machine: processor, cores, and the GPU where networks run on one.
        date: when it began, UTC.
    """

    version: str
    commit: str
    weights: dict[str, str]
    settings: dict[str, str]
    machine: str
    date: str


def provenance_of(settings: Settings) -> Provenance:
    """Of a server with these settings, here and now; errors as `device_for` and `feature_names`."""
    device = device_for(settings)
    features = feature_names(settings.features, device)
    used = {settings.backend, *features, *(f"{name}-lightglue" for name in features if device != "cpu")}
    if settings.retrieval == "megaloc" or (settings.retrieval == "auto" and device != "cpu"):
        used.add("megaloc")
    weights = {}
    for entry in CATALOGUE:
        stored = look_up(entry, settings.weights_dir)
        if entry.name in used and stored.status not in (Status.ABSENT, Status.NO_FILE):
            known = stored.status is not Status.UNCHECKED and recorded(stored.path)
            weights[entry.name] = known or "not recorded"
    told = {
        "backend": settings.backend,
        "features": ", ".join(features),
        "device": device,
        "retrieval": settings.retrieval,
    }
    date = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return Provenance(__version__, commit_of(ROOT), weights, told, _machine(device), date)


def commit_of(root: Path) -> str:
    """`git describe` of a checkout, "e18f3fc-dirty.1a2b3c4d" with a digest of the code's changes; else empty."""
    if not (root / ".git").exists():
        return ""
    try:
        described = _git(root, "describe", "--always", "--tags").strip()
        untracked = _git(root, "ls-files", "--others", "--exclude-standard", "-z", "--", *CODE).split("\0")
        changes = _git(root, "diff", "HEAD", "--", *CODE)
    except (OSError, subprocess.SubprocessError):
        return ""
    digest = hashlib.sha256(changes.encode())
    for name in filter(None, untracked):
        digest.update(name.encode() + (root / name).read_bytes())
    return described if not changes and not any(untracked) else f"{described}-dirty.{digest.hexdigest()[:8]}"


def _git(root: Path, *arguments: str) -> str:
    command = ["git", "-C", str(root), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True, errors="replace", timeout=30).stdout


def _machine(device: str) -> str:
    machine = f"{cpu_model()}, {available_cores()} cores"
    if device == "cpu":
        return machine
    import torch

    return f"{machine}; {torch.cuda.get_device_name(torch.device(device))}"
