"""A call, as its servicer gets it."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field

from mapless_server import __version__
from mapless_server.engine.query import Caller
from mapless_server.scheduling import Flow, StageRecord
from mapless_server.security import Principal

from .descriptors import most_connections
from .sending import REQUEST_ID_KEY

TIME_KEY, VERSION_KEY, CONNECTIONS_KEY = "x-mapless-time", "x-mapless-version", "x-mapless-connections"


@dataclass(frozen=True)
class Call:
    """A call, for its servicer; times are by `time.monotonic`.

    The request id identifies it in the log; it is the caller's own if that is well-formed. The message may arrive later
    than the headers, at `arrived_s`. `client` distinguishes the clients of a token: the id that the client gives, else
    the address of its connection. `notes` are fields of its line in the log, `stages` those of the queue that its jobs
    have passed.
    """

    request_id: str
    arrived_s: float
    deadline_s: float
    principal: Principal = field(default_factory=Principal)
    client: str = ""
    notes: dict[str, object] = field(default_factory=dict, repr=False, compare=False)
    stages: list[StageRecord] = field(default_factory=list, repr=False, compare=False)

    @property
    def caller(self) -> Caller:
        """The caller in the engine's form."""
        return Caller(self.flow, self.deadline_s)

    @property
    def flow(self) -> Flow:
        """The owner of the call's jobs.

        A client that its token or certificate names is one caller, however many names it gives itself; others are what
        they call themselves.
        """
        it = self.principal
        return Flow(it.tenant, it.name, self.client) if it.name else Flow(it.tenant, self.client)

    @property
    def trailers(self) -> tuple[tuple[str, str], ...]:
        """Trailers of a successful answer: its caller is authenticated, and may know version and limit."""
        return (
            (REQUEST_ID_KEY, self.request_id),
            (TIME_KEY, f"{time.time():.3f}"),
            (VERSION_KEY, __version__),
            (CONNECTIONS_KEY, str(most_connections())),
        )

    def note(self, **fields: object) -> None:
        """Adds fields to the call's line in the log and to its trace; they cannot replace the standard fields."""
        self.notes.update(fields)

    def record(self, stages: Iterable[StageRecord]) -> None:
        """Records the queue's stages that a job of the call has passed."""
        self.stages.extend(stages)
