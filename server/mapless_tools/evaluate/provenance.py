"""The origin of figures (code, weights, settings, machine, day), without which they cannot be reproduced."""

from dataclasses import dataclass
from datetime import datetime, timezone

from mapless_server import __version__
from mapless_server.networks.weights import CATALOGUE
from mapless_server.networks.weights.folder import Status, look_up, recorded
from mapless_server.observability.provenance import ROOT, commit_of, cpu_model
from mapless_server.serve.assembly import device_for, feature_names
from mapless_server.settings import Settings, available_cores


@dataclass(frozen=True)
class Provenance:
    """The origin of figures.

    The commit is `git describe` of a checkout, with a digest of what is not committed; empty for an installed package.
    Weights are the SHA-256 of each network's file that the settings use; "not recorded" for a file copied by hand. The
    machine includes the GPU if networks use one; the date is when it began, UTC.
    """

    version: str
    commit: str
    weights: dict[str, str]
    settings: dict[str, str]
    machine: str
    date: str


def provenance_of(settings: Settings) -> Provenance:
    """The origin of figures of a server with these settings; errors as in `device_for` and `feature_names`."""
    device = device_for(settings)
    features = feature_names(settings, device)
    used = {settings.backend, *features, *(f"{name}-lightglue" for name in features if device != "cpu")}
    if settings.retrieval == "megaloc" or (settings.retrieval == "auto" and device != "cpu"):
        used.add("megaloc")
    weights = {}
    for entry in CATALOGUE:
        stored = look_up(entry, settings.weights_dir)
        if entry.name in used and stored.status not in (Status.ABSENT, Status.NO_FILE):
            known = stored.status is not Status.UNCHECKED and recorded(stored.path)
            weights[entry.name] = known or "not recorded"
    figures_of = {
        "backend": settings.backend,
        "features": ", ".join(features),
        "device": device,
        "retrieval": settings.retrieval,
    }
    date = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return Provenance(__version__, commit_of(ROOT), weights, figures_of, _machine(device), date)


def _machine(device: str) -> str:
    machine = f"{cpu_model()}, {available_cores()} cores"
    if device == "cpu":
        return machine
    import torch

    return f"{machine}; {torch.cuda.get_device_name(torch.device(device))}"
