"""What is known of a call before its message is read: who calls by what id, and until when the answer is awaited."""

from __future__ import annotations

import math
import re
import time
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from urllib.parse import unquote

from mapless_server.engine.query import Caller
from mapless_server.observability.tracing import Metadata
from mapless_server.observability.trail import Trail
from mapless_server.scheduling import Flow, StageRecord
from mapless_server.security.principal import Principal

from .receiving import Context

REQUEST_ID_KEY = "x-request-id"
CLIENT_ID_KEY = "x-client-id"
ANSWER_MARGIN_SHARE = 0.02
"""Of the time given, the answer leaves this early: gRPC rounds the time up when it sends it, by 1 % at most."""
ANSWER_MARGIN_S = 0.01
"""And at least so early, because the answer has to be written and sent as well ..."""
_MAX_MARGIN_SHARE = 0.1
"""... where there is time for that."""
_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}", re.ASCII)  # it enters the log: no line breaks, no escapes


@dataclass(frozen=True)
class Call:
    """What a servicer may know of the call it answers, and what it tells of it.

    Attributes:
        request_id: identifies it in the log; the caller's own if it sent a well-formed one.
        arrived_s: when its headers arrived, `time.monotonic`; its message may take longer.
        deadline_s: when the servicer must have answered, `time.monotonic`.
        principal: who calls.
        client: what tells callers apart: the id that they give, else the address of their connection.
        trail: what was told of it so far.
    """

    request_id: str
    arrived_s: float
    deadline_s: float
    principal: Principal = field(default_factory=Principal)
    client: str = ""
    trail: Trail = field(default_factory=Trail, repr=False, compare=False)

    @property
    def caller(self) -> Caller:
        """Who asks, as the engine knows it."""
        return Caller(Flow(self.principal.tenant, self.client), self.deadline_s)

    def note(self, **fields: object) -> None:
        """Adds fields to the call's line in the log and to its trace; those that every line has cannot be changed."""
        self.trail.notes.update(fields)

    def record(self, records: Iterable[StageRecord]) -> None:
        """Notes the stages of the queue that a job of the call has been through."""
        for it in records:
            self.waited(it.stage, it.queued_s, it.start_s)
            if it.jobs:
                self.computed(it.stage, it.start_s, it.end_s, batch=it.batch, batch_size=it.jobs)

    def waited(self, stage: str, start_s: float, end_s: float) -> None:
        """It waited for a stage of the queue, `time.monotonic`."""
        self.trail.waited(stage, start_s, end_s)

    def computed(
        self, stage: str, start_s: float, end_s: float, part_seconds: Mapping[str, float] | None = None, **about: object
    ) -> None:
        """A stage was computed for it, `time.monotonic`; the parts that it consisted of followed each other."""
        self.trail.computed(stage, start_s, end_s, part_seconds or {}, **about)


@dataclass(frozen=True)
class Deadlines:
    """How long calls may take; see the settings of these names."""

    default_deadline_s: float = 30.0
    max_deadline_s: float = 600.0

    def given_s(self, asked_s: float | None, is_endless: bool) -> float:
        """What a call gets that asks for so many seconds, or for none; a call that need not end may get all."""
        if is_endless:
            return math.inf if asked_s is None else asked_s
        return min(self.default_deadline_s if asked_s is None else asked_s, self.max_deadline_s)


def begin_call(context: Context, deadlines: Deadlines, is_endless: bool) -> Call:
    """The call whose headers have just arrived; nobody knows yet who makes it."""
    now_s = time.monotonic()
    given_s, margin_s = deadlines.given_s(context.time_remaining(), is_endless), 0.0
    if math.isfinite(given_s):
        margin_s = min(max(ANSWER_MARGIN_S, ANSWER_MARGIN_SHARE * given_s), _MAX_MARGIN_SHARE * given_s)
    metadata = metadata_of(context)
    request_id = _well_formed(metadata, REQUEST_ID_KEY) or uuid.uuid4().hex
    client = _well_formed(metadata, CLIENT_ID_KEY) or unquote(context.peer())
    call = Call(request_id, now_s, now_s + given_s - margin_s, client=client)
    if math.isfinite(given_s):
        call.note(deadline_ms=round(1000 * given_s))
    return call


def metadata_of(context: Context) -> Metadata:
    """What the caller sent along, in order."""
    return context.invocation_metadata() or ()


def _well_formed(metadata: Metadata, wanted: str) -> str:
    """The metadata's value; empty if there is none or it is not fit for the log."""
    given = next((str(value) for key, value in metadata if key == wanted), "")
    return given if _ID.fullmatch(given) else ""
