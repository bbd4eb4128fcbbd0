"""The call that a servicer answers: its id, caller and deadline, and a record of its steps."""

import math
import random
import re
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from urllib.parse import unquote

from mapless_server import __version__
from mapless_server.engine.query import Caller
from mapless_server.observability.tracing import CallRecord, Metadata
from mapless_server.scheduling import Flow, StageRecord
from mapless_server.security import Principal

from .receiving import Context

REQUEST_ID_KEY = "x-request-id"
CLIENT_ID_KEY = "x-client-id"
TIME_KEY, VERSION_KEY = "x-mapless-time", "x-mapless-version"
ANSWER_MARGIN_SHARE = 0.02
"""Share of the time given by which the answer is early: gRPC rounds the time up when it sends it, by at most 1 %."""
ANSWER_MARGIN_S = 0.01
"""Least time by which it is early, because the answer has to be written and sent as well ..."""
_MAX_MARGIN_SHARE = 0.1
"""... and the largest share of the time that this may take."""
_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}", re.ASCII)  # it is logged: no line breaks, no escapes


@dataclass(frozen=True)
class Call:
    """A call, for its servicer, with the record of its steps so far; times are by `time.monotonic`.

    The request id identifies it in the log; it is the caller's own if that is well-formed. The message may arrive later
    than the headers, at `arrived_s`. `client` distinguishes callers: the id that the caller gives, else the address of
    its connection.
    """

    request_id: str
    arrived_s: float
    deadline_s: float
    principal: Principal = field(default_factory=Principal)
    client: str = ""
    history: CallRecord = field(default_factory=CallRecord, repr=False, compare=False)

    @property
    def caller(self) -> Caller:
        """The caller in the engine's form."""
        return Caller(Flow(self.principal.tenant, self.client), self.deadline_s)

    @property
    def trailers(self) -> tuple[tuple[str, str], ...]:
        """Trailers of a successful answer: its caller is authenticated, and may know the version."""
        return (REQUEST_ID_KEY, self.request_id), (TIME_KEY, f"{time.time():.3f}"), (VERSION_KEY, __version__)

    def note(self, **fields: object) -> None:
        """Adds fields to the call's line in the log and to its trace; they cannot replace the standard fields."""
        self.history.notes.update(fields)

    def record(self, stages: Iterable[StageRecord]) -> None:
        """Records the queue's stages that a job of the call has passed."""
        self.history.stages += stages


@dataclass(frozen=True)
class Deadlines:
    """Time limits of calls, from the settings of these names."""

    default_deadline_s: float = 30.0
    max_deadline_s: float = 600.0

    def given_s(self, asked_s: float | None, is_endless: bool) -> float:
        """Time for a call that requests `asked_s`, or no limit; unlimited only for an endless method."""
        if is_endless:
            return math.inf if asked_s is None else asked_s
        return min(self.default_deadline_s if asked_s is None else asked_s, self.max_deadline_s)


def begin_call(context: Context, deadlines: Deadlines, is_endless: bool) -> Call:
    """Makes the call whose headers have just arrived; it is not authenticated yet."""
    now_s = time.monotonic()
    given_s, margin_s = deadlines.given_s(context.time_remaining(), is_endless), 0.0
    if math.isfinite(given_s):
        margin_s = min(max(ANSWER_MARGIN_S, ANSWER_MARGIN_SHARE * given_s), _MAX_MARGIN_SHARE * given_s)
    metadata = metadata_of(context)
    request_id = _well_formed(metadata, REQUEST_ID_KEY) or f"{random.getrandbits(128):032x}"
    client = _well_formed(metadata, CLIENT_ID_KEY) or unquote(context.peer())
    call = Call(request_id, now_s, now_s + given_s - margin_s, client=client)
    if math.isfinite(given_s):
        call.note(deadline_ms=round(1000 * given_s))
    return call


def metadata_of(context: Context) -> Metadata:
    """The caller's metadata, in order."""
    return context.invocation_metadata() or ()


def _well_formed(metadata: Metadata, wanted: str) -> str:
    """The value of a key of the metadata; empty if it is missing or cannot be written to the log."""
    given = next((str(value) for key, value in metadata if key == wanted), "")
    return given if _ID.fullmatch(given) else ""
