"""A fleet beside callers that ask without end about another place, alone and beside them with the same calls.

Either the fleet has a token and a neighbour another one, with a new client id for each call; or each robot of the fleet
has a token of its own, and each neighbour too: these are then robots that are lost, and ask until they are localized.
"""

import asyncio
import tempfile
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

from mapless_server.bounds import check_bounds
from mapless_server.security import create_token
from mapless_server.settings import PREFIX
from mapless_tools.child import CONNECT
from mapless_tools.demo import Place
from mapless_tools.progress import Progress

from .calls import CallRecord, Fate, account_of
from .driving import (
    METHOD,
    LoadedServer,
    find_saturation,
    noise_photographs,
    open_step,
    photo_request,
    read_answer,
    server_with_scene,
)
from .report import Check
from .sender import Metadata, connected, send_closed_loop
from .step import Step

MAX_OVER_ALONE = 1.5
"""Limits of the fleet's median beside a neighbour, and of its 99th percentile beside lost robots."""
MIN_SHARE_OF_ANSWERS = 0.9
_WARM_UP_S = 3.0
"""The neighbour calls before the fleet does, so that its calls have filled the queue."""


@dataclass(frozen=True)
class NeighbourOptions:
    """Options of the measurement.

    Attributes:
        clients: number of the fleet's robots, each with its own connection and id.
        callers: calls of the neighbour side by side, or lost robots with one each; each call is followed by the next.
        own_tokens: whether each of the robots and of the lost ones has a token; then no request names references.
        share: the fleet's load, as a share of the largest rate of its answers.
        deadline_s: deadline of every call.
        ramp_s: time with each number of concurrent calls, by which that rate is found.
        step_s: time alone, and time beside the neighbour.
        settle_s: beginning of each that its rates leave out.
    """

    clients: int = 4
    callers: int = 8
    own_tokens: bool = False
    share: float = 0.4
    deadline_s: float = 30.0
    ramp_s: float = 10.0
    step_s: float = 60.0
    settle_s: float = 5.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_bounds(self, "clients callers", at_least=1)
        check_bounds(self, "share deadline_s ramp_s", above=0)
        check_bounds(self, "settle_s", at_least=0, below=self.step_s)


@dataclass(frozen=True, eq=False)
class NeighbourResult:
    """The fleet's steps: concurrent calls, then its load alone and beside the neighbour, whose outcomes are counted."""

    options: NeighbourOptions
    ramp: Sequence[Step]
    saturation_per_s: float
    alone: Step
    beside: Step
    neighbour_outcomes: dict[str, int]

    @property
    def all_steps(self) -> list[Step]:
        """All steps in order."""
        return [*self.ramp, self.alone, self.beside]


def measure_neighbours(
    place: Place, elsewhere: Place | None, options: NeighbourOptions, progress: Progress, log: Path | None = None
) -> NeighbourResult:
    """Starts a server with tokens, and measures; the neighbour's photographs are of another place, or of none."""
    with tempfile.TemporaryDirectory(prefix="mapless-tokens-") as folder:
        file = Path(folder) / "tokens"

        def tokens(name: str, clients: int, role: str = "localize") -> list[str]:
            names = [f"{name}-{i}" for i in range(clients if options.own_tokens else 1)]
            return [create_token(file, it, "default", role, None) for it in names]

        fleet, neighbour = tokens("robot", options.clients), tokens("neighbour", options.callers)
        surveyor = create_token(file, "surveyor", "default", "write", None)
        environment = {f"{PREFIX}TOKENS_FILE": str(file)}
        with server_with_scene(place, progress, environment, log, replace(CONNECT, token=surveyor)) as server:
            camera = place.queries[0].camera
            foreign = [photo_request(it, camera, ()) for it in noise_photographs(camera, 4)]
            if elsewhere:
                foreign = [photo_request(it.data, it.camera, ()) for it in elsewhere.queries]
            if options.own_tokens:
                own = [photo_request(it.data, it.camera, ()) for it in place.queries]
                server = replace(server, requests=replace(server.requests, good=own))
            return asyncio.run(_measure(server, (fleet, neighbour), foreign, options, progress))


def neighbour_checks(result: NeighbourResult) -> list[Check]:
    """The bars."""
    alone, beside = result.alone.account, result.beside.account
    name = "p99" if result.options.own_tokens else "p50"
    alone_ms, beside_ms = (getattr(it.answers, f"{name}_ms") for it in (alone, beside))
    figure, bar = f"the fleet's {name} beside the neighbour", f"at most {MAX_OVER_ALONE:g} times that alone"
    time = Check(figure, "-", bar, None)
    if alone_ms is not None and beside_ms is not None:
        ratio = beside_ms / alone_ms
        value = f"{beside_ms:.0f} ms, {ratio:.2f} times {alone_ms:.0f} ms"
        time = Check(figure, value, bar, ratio <= MAX_OVER_ALONE)
    share = beside.count(Fate.ANSWERED) / max(1, alone.count(Fate.ANSWERED))
    return [
        time,
        Check(
            "the fleet's answers beside the neighbour",
            f"{beside.count(Fate.ANSWERED)}, {100 * share:.0f} % of {alone.count(Fate.ANSWERED)}",
            f"at least {100 * MIN_SHARE_OF_ANSWERS:.0f} % of those alone",
            share >= MIN_SHARE_OF_ANSWERS,
        ),
    ]


async def _measure(
    server: LoadedServer,
    tokens: tuple[Sequence[str], Sequence[str]],
    foreign: Sequence[bytes],
    options: NeighbourOptions,
    progress: Progress,
) -> NeighbourResult:
    (fleet, neighbour), numbers = tokens, count()

    def of_fleet(robot: int) -> Metadata:
        return ("authorization", f"Bearer {fleet[robot % len(fleet)]}"), ("x-client-id", f"robot-{robot}")

    def of_neighbour(caller: int) -> Metadata:
        client = f"id-{caller if options.own_tokens else next(numbers)}"
        return ("authorization", f"Bearer {neighbour[caller % len(neighbour)]}"), ("x-client-id", client)

    address = server.address
    async with (
        connected(address, METHOD, options.clients, options.deadline_s, read_answer, of_fleet) as target,
        connected(address, METHOD, options.callers, options.deadline_s, read_answer, of_neighbour) as other,
    ):
        ramp, saturation_per_s = await find_saturation(server, target, options.ramp_s, progress)
        records: list[CallRecord] = []

        @asynccontextmanager
        async def calling() -> AsyncIterator[None]:
            seconds = options.step_s + _WARM_UP_S
            task = asyncio.create_task(send_closed_loop(other, foreign, options.callers, seconds))
            await asyncio.sleep(_WARM_UP_S)
            yield
            records.extend(await task)

        rate_per_s = options.share * saturation_per_s
        progress("alone", 0, 1)
        alone = await open_step(
            "alone", server, target, rate_per_s, options.step_s, settle_s=options.settle_s, seed=options.seed
        )
        progress("beside the neighbour", 0, 1)
        beside = await open_step(
            "beside the neighbour",
            server,
            target,
            rate_per_s,
            options.step_s,
            settle_s=options.settle_s,
            seed=options.seed,
            beside=calling,
        )
    outcomes = dict(account_of(records, options.step_s + _WARM_UP_S).outcomes)
    return NeighbourResult(options, ramp, saturation_per_s, alone, beside, outcomes)
