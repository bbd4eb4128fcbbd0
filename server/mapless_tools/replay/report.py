"""Computes a folder of captured calls again: which calls, and what has changed since."""

from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Tier
from mapless_server.networks.weights import WeightsError, WeightsMissing
from mapless_server.serve.assembly import engine_options, make_tiers, what_is_missing
from mapless_server.services.capture.calls import CapturedCall, CaptureError, decode_call
from mapless_server.services.capture.files import calls_of, check_format
from mapless_server.services.capture.recorder import circumstances_of
from mapless_server.settings import Settings

from .comparing import Change, changed, compare, outcome_of, stage_seconds
from .recompute import Blobs, recompute, response_of

IDENTICAL, CHANGED, NOT_COMPUTED = "identical", "changed", "not computed"
"""Verdicts on a call; the last: a part of the capture is damaged, or unknown to this version."""


@dataclass(frozen=True)
class Selection:
    """A choice of calls: of these ids, the latest ones, of a tenant, in a scene; empty values and None select all."""

    request_ids: frozenset[str] = frozenset()
    last: int | None = None
    tenant: str = ""
    scene_id: str = ""

    def files(self, folder: Path) -> list[Path]:
        """Files of the tenant and the scene, the latest first; CaptureError if a folder cannot be read."""
        try:
            found = {it: it.relative_to(folder).parts for it in calls_of(folder)}
        except OSError as error:
            raise CaptureError(f"{error.filename} cannot be read: {error.strerror}") from error
        chosen = [
            path
            for path, (_, tenant, _, scene_id, _) in found.items()
            if self.tenant in ("", tenant) and self.scene_id in ("", scene_id)
        ]
        return sorted(chosen, key=lambda it: it.name, reverse=True)


@dataclass(frozen=True)
class Replayed:
    """A captured call and its answer computed again; the time is UTC, the verdict one of `IDENTICAL` and so on.

    Outcomes are "localized" or the reason of the rejection, empty without an answer, for which `error` has the reason.
    Seconds are the computing time of all stages. Distances are None unless there are two poses, or if the answers are
    identical. This version cannot read the captured features of `found_anew` references, and extracted them again.
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
    found_anew: int = 0


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


def replay(folder: Path, selection: Selection, settings: Settings) -> Report:
    """Computes captured answers of a folder again, whether a server uses it or not; nothing in it is changed.

    Settings of listening and storing have no effect. CaptureError if the folder is not a capture folder or has no such
    calls, or the settings name what is not available.
    """
    check_format(folder)
    unreadable: list[str] = []
    found = select(folder, selection, unreadable)
    calls, circumstances = [], dict[Change, None]()
    with ExitStack() as stack:
        tiers, options = _tiers(settings), engine_options(settings)
        for tier in tiers:
            stack.callback(tier.pipeline.matcher.close)
        now, blobs = circumstances_of(settings, tiers), Blobs(folder)
        for path in found:
            call = _call_in(path, folder, unreadable)
            if call is None:
                continue
            replayed = _replayed(call, blobs, tiers, options)
            if replayed.error and not path.exists():  # its server deleted it, or a part of it, meanwhile
                continue
            circumstances |= dict.fromkeys(changed(call.circumstances, now))
            calls.append(replayed)
    return Report(tuple(calls), tuple(circumstances), tuple(unreadable))


def select(folder: Path, selection: Selection, unreadable: list[str]) -> list[Path]:
    """Files of the calls, the oldest first; files that cannot be read are added to `unreadable`, selected or not."""
    found: list[Path] = []
    ids: set[str] = set()
    for path in selection.files(folder):
        call = _call_in(path, folder, unreadable)
        if call is None:
            continue
        if not selection.request_ids or call.request_id in selection.request_ids:
            found.append(path)
            ids.add(call.request_id)
        if len(found) == selection.last:
            break
    missing = selection.request_ids - ids if selection.last is None or len(found) < selection.last else frozenset()
    if missing or not (found or unreadable):
        which = f"call of id {', '.join(sorted(missing))}" if missing else "such calls"
        faults = f"; {len(unreadable)} files cannot be read" if unreadable else ""
        raise CaptureError(f"{folder} holds no {which}{faults}")
    if selection.request_ids:
        unreadable.clear()  # all selected calls are there
    return found[::-1]


def _call_in(path: Path, folder: Path, unreadable: list[str]) -> CapturedCall | None:
    try:
        return decode_call(path.read_bytes())
    except FileNotFoundError:  # its server has deleted it since
        return None
    except OSError as error:
        unreadable.append(f"{path.relative_to(folder)}: {error.strerror}")
    except CaptureError as error:
        unreadable.append(f"{path.relative_to(folder)}: {error}")
    return None


def _tiers(settings: Settings) -> tuple[Tier, ...]:
    try:
        return make_tiers(settings)
    except (ImportError, WeightsMissing) as error:
        raise CaptureError(what_is_missing(error)) from error
    except (ValueError, WeightsError) as error:
        raise CaptureError(str(error)) from error


def _replayed(call: CapturedCall, blobs: Blobs, tiers: tuple[Tier, ...], options: EngineOptions) -> Replayed:
    time = datetime.fromtimestamp(call.time_s, timezone.utc).isoformat(timespec="milliseconds")
    about = (call.request_id, time, call.method, call.tenant, call.scene_id)
    outcome_then, stages_then = "", dict[str, float]()
    try:
        then = response_of(call)
        outcome_then, stages_then = outcome_of(then), stage_seconds(then)
        now = recompute(call, blobs, tiers, options)
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
        found_anew=len(blobs.found_anew & {key for _, key in call.keys}),
    )
