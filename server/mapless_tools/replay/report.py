"""Computes a folder of captured calls again: which calls, and what has changed since."""

from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Tier
from mapless_server.serve.assembly import UNUSABLE, engine_options
from mapless_server.serve.features import make_tiers
from mapless_server.serve.startup import what_is_missing
from mapless_server.services.capture.calls import CapturedCall, CaptureError, decode_call
from mapless_server.services.capture.folder import calls_of
from mapless_server.services.capture.recorder import circumstances_of
from mapless_server.settings import Settings
from mapless_server.store import LruCache, Store, StoreError
from mapless_server.store.backup import reading_backup
from mapless_server.store.database import Database
from mapless_server.store.migrations import read_version
from mapless_server.store.tables import SCHEMA_VERSION
from mapless_tools.stores import open_database

from .comparing import Change, changed, compare, outcome_of, stage_seconds
from .recompute import StoredReferences, recompute, response_of

IDENTICAL, CHANGED, NOT_COMPUTED = "identical", "changed", "not computed"
"""Verdicts on a call; the last: its references have changed since, or it is unknown to this version."""


@dataclass(frozen=True)
class Selection:
    """A choice of calls: of these ids, the latest ones, of a tenant, in a scene; empty values and None select all."""

    request_ids: frozenset[str] = frozenset()
    last: int | None = None
    tenant: str = ""
    scene_id: str = ""


@dataclass(frozen=True)
class Replayed:
    """A captured call and its answer computed again; the time is UTC, the verdict one of `IDENTICAL` and so on.

    Outcomes are "localized" or the reason of the rejection, empty without an answer, for which `error` has the reason.
    Seconds are the computing time of all stages. Distances are None unless there are two poses, or if the answers are
    identical. Damaged references are left out, and named with what is wrong.
    """

    request_id: str
    time: str
    method: str
    tenant: str
    scene_id: str
    verdict: str
    outcome_then: str = ""
    outcome_now: str = ""
    seconds_then: float = 0.0
    seconds_now: float = 0.0
    stages_then: dict[str, float] | None = None
    stages_now: dict[str, float] | None = None
    apart_cm: float | None = None
    apart_deg: float | None = None
    changes: tuple[Change, ...] = ()
    error: str = ""
    damaged: tuple[str, ...] = ()


@dataclass(frozen=True)
class Report:
    """The replayed calls, the oldest first, differences of circumstances of any of them, and damaged files."""

    calls: tuple[Replayed, ...]
    circumstances: tuple[Change, ...]
    unreadable: tuple[str, ...]

    @property
    def is_identical(self) -> bool:
        """Whether every answer is the same, to the last bit."""
        return not self.unreadable and all(it.verdict == IDENTICAL for it in self.calls)


def replay(folder: Path, selection: Selection, settings: Settings, backup: Path | None = None) -> Report:
    """Computes captured answers of a folder again, whether a server uses it or not; nothing in it is changed.

    References are read from the settings' store, also while a server uses it, or from a backup of it. CaptureError if
    the folder has no such calls, the store cannot be read, or the settings name what is not available.
    """
    unreadable: list[str] = []
    paths = select(folder, selection, unreadable)
    calls, circumstances = [], dict[Change, None]()
    with ExitStack() as stack:
        store = stack.enter_context(_store(settings, backup))
        tiers, options = _tiers(settings), engine_options(settings)
        references = StoredReferences(store, any(tier.uses_depths for tier in tiers))
        for tier in tiers:
            stack.callback(tier.pipeline.matcher.close)
        now = circumstances_of(settings, tiers)
        for path in paths:
            call = _read(path, folder, unreadable)
            if call is not None:
                calls.append(_replayed(call, references, tiers, options))
                circumstances |= dict.fromkeys(changed(call.circumstances, now))
    return Report(tuple(calls), tuple(circumstances), tuple(unreadable))


def select(folder: Path, selection: Selection, unreadable: list[str]) -> list[Path]:
    """Files of the calls, the oldest first; of those selected, files that cannot be read are added to `unreadable`."""
    try:
        paths = calls_of(folder)
    except OSError as error:
        raise CaptureError(f"{error.filename} cannot be read: {error.strerror}") from error
    found: list[Path] = []
    missing = set(selection.request_ids)
    for path in reversed(paths):
        tenant, _, scene_id, _ = path.parts[-4:]
        if selection.tenant not in ("", tenant) or selection.scene_id not in ("", scene_id):
            continue
        call = _read(path, folder, unreadable)
        if call is not None and (not selection.request_ids or call.request_id in selection.request_ids):
            found.append(path)
            missing.discard(call.request_id)
        if len(found) == selection.last:
            break
    if (missing and len(found) != selection.last) or not (found or unreadable):
        which = f"call of id {', '.join(sorted(missing))}" if missing else "such calls"
        faults = f"; {len(unreadable)} files cannot be read" if unreadable else ""
        raise CaptureError(f"{folder} holds no {which}{faults}")
    if selection.request_ids:
        unreadable.clear()  # all selected calls are there
    return found[::-1]


def _read(path: Path, folder: Path, unreadable: list[str]) -> CapturedCall | None:
    try:
        return decode_call(path.read_bytes())
    except FileNotFoundError:  # its server has deleted it since
        return None
    except (OSError, CaptureError) as error:
        unreadable.append(f"{path.relative_to(folder)}: {getattr(error, 'strerror', None) or error}")
        return None


@contextmanager
def _store(settings: Settings, backup: Path | None) -> Iterator[Store]:
    try:
        with reading_backup(backup) if backup else closing(open_database(settings, as_is=True)) as database:
            _check_schema(database)
            yield Store(database, LruCache(settings.reference_cache_mib * 2**20), name_cache_bytes=0)
    except StoreError as error:
        raise CaptureError(
            f"{error}; name the store that answered (--data-dir), or a backup of it (--backup)"
        ) from error


def _check_schema(database: Database) -> None:
    with database.read() as connection:
        version = read_version(connection)
    if version != SCHEMA_VERSION:
        raise StoreError(
            f"database {database.name} has schema version {version}, this program's is {SCHEMA_VERSION}: make a backup "
            "with the program that serves it, which is read in this one's schema"
        )


def _tiers(settings: Settings) -> tuple[Tier, ...]:
    try:
        return make_tiers(settings)
    except UNUSABLE as error:
        raise CaptureError(what_is_missing(error)) from error


def _replayed(
    call: CapturedCall, references: StoredReferences, tiers: tuple[Tier, ...], options: EngineOptions
) -> Replayed:
    time = datetime.fromtimestamp(call.time_s, timezone.utc).isoformat(timespec="milliseconds")
    about = (call.request_id, time, call.method, call.tenant, call.scene_id)
    outcome_then, stages_then = "", dict[str, float]()
    try:
        then = response_of(call)
        outcome_then, stages_then = outcome_of(then), stage_seconds(then)
        now = recompute(call, references, tiers, options)
        comparison, stages_now = compare(then, now), stage_seconds(now)
    except Exception as error:  # one call that this version cannot compute does not stop the others
        name = "" if isinstance(error, CaptureError) else f"{type(error).__name__}: "
        return Replayed(*about, NOT_COMPUTED, outcome_then, stages_then=stages_then, error=f"error: {name}{error}")
    return Replayed(
        *about,
        IDENTICAL if comparison.is_identical else CHANGED,
        outcome_then,
        outcome_of(now),
        sum(stages_then.values()),
        sum(stages_now.values()),
        stages_then,
        stages_now,
        comparison.apart_cm,
        comparison.apart_deg,
        comparison.changes,
        damaged=tuple(dict.fromkeys(references.damaged)),
    )
