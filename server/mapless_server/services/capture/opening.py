"""What captures a server's calls, put together from its settings."""

from __future__ import annotations

import logging
from functools import partial

from mapless_server.observability.metrics import Metrics
from mapless_server.security.tenancy import check_tenant
from mapless_server.settings import Settings
from mapless_server.store import Store

from .circumstances import circumstances_of
from .errors import CaptureError
from .folder import CaptureFolder, Retention
from .recorder import Recorder

log = logging.getLogger(__name__)


def open_recorder(settings: Settings, store: Store, metrics: Metrics) -> Recorder | None:
    """What captures calls, if the settings ask for it; the log says so, since photographs are then kept.

    Raises:
        CaptureError: the folder cannot be used, or a tenant's name is none.
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
    metrics.watch_captures(lambda: folder.space_bytes)
    return Recorder(folder, store, metrics, partial(circumstances_of, settings), tenants)
