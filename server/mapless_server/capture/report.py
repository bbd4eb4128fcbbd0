"""A folder of captured calls, computed anew: which, by what, and what has changed since."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from mapless.wire import FieldError

from ..assembly import engine_options, make_tiers, what_is_missing
from ..engine import EngineOptions
from ..errors import RequestError
from ..settings import Settings
from ..tiers import Tier
from ..weights import WeightsError, WeightsMissing
from .calls import CapturedCall, decode_call
from .circumstances import circumstances_of
from .comparing import Change, changed, compare, outcome_of, stage_seconds
from .errors import CaptureError
from .files import calls_of, check_format
from .recorded import Blobs
from .replaying import recompute, response_of

IDENTICAL, CHANGED, FAILED = "identical", "changed", "failed"
"""Verdicts on a call; one that failed then has nothing to be computed anew."""


@dataclass(frozen=True)
class Selection:
    """Which calls; what is empty or None selects all.

    Attributes:
        request_ids: of these calls.
        last: so many, the latest.
        tenant: of this tenant.
        scene_id: in its scenes of this id.
    """

    request_ids: frozenset[str] = frozenset()
    last: int | None = None
    tenant: str = ""
    scene_id: str = ""

    def takes(self, call: CapturedCall) -> bool:
        """Whether a call is one of them, whatever its age."""
        wanted = not self.request_ids or call.request_id in self.request_ids
        return wanted and self.tenant in ("", call.tenant) and self.scene_id in ("", call.scene_id)


@dataclass(frozen=True)
class Replayed:
    """A captured call and its answer computed anew.

    Attributes:
        request_id, time, method, tenant, scene_id: of the call; the time is UTC.
        verdict: see `IDENTICAL`.
        outcome_then, outcome_now: "localized", or why not; empty where there is no answer.
        seconds_then, seconds_now: computing time of its stages.
        stages_then, stages_now: of each stage.
        apart_cm, apart_deg: how far the poses are apart; None where there are no two, or the answers are identical.
        changes: what is different; the first of it.
        error: why there is no answer, then (`FAILED`) or now.
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


@dataclass(frozen=True)
class Report:
    """What became of the calls, the oldest first.

    Attributes:
        calls: each of them.
        circumstances: what else is different between then and now, of any of the calls.
        unreadable: files that are damaged, and why.
    """

    calls: tuple[Replayed, ...]
    circumstances: tuple[Change, ...]
    unreadable: tuple[str, ...]

    @property
    def is_identical(self) -> bool:
        """Whether every answer is the same, to the last bit."""
        return not self.unreadable and all(it.verdict != CHANGED for it in self.calls)


def replay(folder: Path, selection: Selection, settings: Settings) -> Report:
    """Computes captured answers anew.

    Args:
        folder: a capture folder, whether a server uses it or not; nothing in it is changed.
        selection: which calls.
        settings: by which features, backend and so on; where they listen and store does not matter.

    Raises:
        CaptureError: it is no capture folder, holds no such calls, or the settings ask for what is not there.
    """
    check_format(folder)
    unreadable: list[str] = []
    found = [path for path, call in _read(folder, unreadable) if selection.takes(call)]
    if selection.last is not None:
        found = heapq.nlargest(selection.last, found, key=lambda it: it.name)
    if not (found or unreadable):
        raise CaptureError(f"{folder} holds no such calls")
    tiers, options = _tiers(settings), engine_options(settings)
    now, blobs = circumstances_of(settings, tiers), Blobs(folder)
    calls, circumstances = [], dict[Change, None]()
    for path in sorted(found, key=lambda it: it.name):
        call = _call_in(path, folder, unreadable)
        if call is None:
            continue
        if call.failure is None:
            circumstances |= dict.fromkeys(changed(call.circumstances, now))
        calls.append(_replayed(call, blobs, tiers, options))
    for tier in tiers:
        tier.pipeline.matcher.close()
    return Report(tuple(calls), tuple(circumstances), tuple(unreadable))


def _read(folder: Path, unreadable: list[str]) -> Iterator[tuple[Path, CapturedCall]]:
    for path in calls_of(folder):
        call = _call_in(path, folder, unreadable)
        if call is not None:
            yield path, call


def _call_in(path: Path, folder: Path, unreadable: list[str]) -> CapturedCall | None:
    try:
        return decode_call(path.read_bytes())
    except FileNotFoundError:  # its server has deleted it since
        return None
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
    if call.failure is not None:
        return Replayed(*about, FAILED, error=f"{call.failure.code} {call.failure.reason}: {call.failure.message}")
    then = response_of(call)
    stages_then = stage_seconds(then)
    try:
        now = recompute(call, blobs, tiers, options)
    except (RequestError, FieldError, CaptureError) as error:
        return Replayed(*about, CHANGED, outcome_of(then), stages_then=stages_then, error=f"{error}")
    comparison, stages_now = compare(then, now), stage_seconds(now)
    return Replayed(
        *about,
        IDENTICAL if comparison.is_identical else CHANGED,
        outcome_of(then),
        outcome_of(now),
        sum(stages_then.values()),
        sum(stages_now.values()),
        stages_then,
        stages_now,
        comparison.apart_cm,
        comparison.apart_deg,
        comparison.changes,
    )
