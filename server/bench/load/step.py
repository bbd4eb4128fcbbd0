"""One step of a measurement: calls for a while, counted by the client and by the server."""

import math
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import asdict, dataclass
from statistics import fmean
from typing import Any

from .calls import Account, CallRecord, Fate, account_of
from .sender import Target, send_closed_loop
from .slopes import MIN_SAMPLES, Slope, slope
from .watch import SAMPLE_EVERY_S, ProcessSample, Scrape, ServerUnderLoad, process_samples

Send = Callable[[], Awaitable[list[CallRecord]]]
CLOSED_SETTLE_SHARE = 0.2
"""Share of a step that rates leave out: at first as many answers are missing as calls have begun."""
TREND_CONFIDENCE = 0.95
TREND_FIELDS = ("resident_mib", "threads", "descriptors")


@dataclass(frozen=True, eq=False)
class Step:
    """The result of a step: figures of the client's calls, samples of the server's process, and its own counts.

    `asked_per_s` is the rate of the Poisson process, None for a closed loop. Rates and trends leave out the first
    `settle_s`. Samples are from before the first call until all had ended; the generator itself used `own_cpu_s`
    meanwhile.
    """

    name: str
    asked_per_s: float | None
    duration_s: float
    account: Account
    codes: Sequence[str]
    samples: Sequence[ProcessSample]
    settle_s: float
    scraped: Scrape | None
    own_cpu_s: float
    wall_s: float

    @property
    def answers(self) -> int:
        """Number of all answers, including those of the beginning."""
        return self.account.count(Fate.ANSWERED)

    @property
    def cpu_s(self) -> float:
        """Processor time of the server, seconds."""
        return self.samples[-1].cpu_s - self.samples[0].cpu_s

    @property
    def cpu_s_per_answer(self) -> float:
        """Processor time of the server per answer; infinite if there was no answer."""
        return self.cpu_s / self.answers if self.answers else math.inf

    @property
    def own_share(self) -> float:
        """Share of one core that the generator itself used."""
        return self.own_cpu_s / self.wall_s

    def trend_of(self, field: str) -> Slope | None:
        """The slope of "resident_mib", "threads" or "descriptors" once settled; None if the step was too short."""
        settled = self._settled
        if len(settled) < MIN_SAMPLES:
            return None
        values = [getattr(sample, field) for sample in settled]
        return slope([sample.at_s for sample in settled], values, TREND_CONFIDENCE)

    @property
    def _settled(self) -> list[ProcessSample]:
        """Samples after `settle_s`, without the last one, which is taken after all calls have ended."""
        begin_s = self.samples[0].at_s + self.settle_s
        return [sample for sample in self.samples[:-1] if sample.at_s >= begin_s]

    def _trend_json(self, field: str) -> dict[str, float] | None:
        found = self.trend_of(field)
        if found is None:
            return None
        mean = fmean(getattr(sample, field) for sample in self._settled)
        return {"mean": mean, "per_minute": found.per_hour / 60, "low": found.low / 60, "high": found.high / 60}

    def as_json(self) -> dict[str, Any]:
        """All figures, for programs."""
        lag_s: float | str | None = None if self.scraped is None else self.scraped.longest_lag_s
        return {
            "name": self.name,
            "asked_per_s": self.asked_per_s,
            "duration_s": self.duration_s,
            "settle_s": self.settle_s,
            **asdict(self.account),
            "server_cpu_s": self.cpu_s,
            "server_cpu_s_per_answer": self.cpu_s_per_answer if self.answers else None,
            "server_start": vars(self.samples[0]),
            "server_end": vars(self.samples[-1]),
            "server_trends_per_minute": {name: self._trend_json(name) for name in TREND_FIELDS},
            "event_loop_lag_below_s": "beyond the widest bucket" if lag_s == math.inf else lag_s,
            "server_handled": None if self.scraped is None else dict(self.scraped.handled),
            "server_terminated": None if self.scraped is None else dict(self.scraped.terminated),
            "generator_cpu_share_of_a_core": self.own_share,
        }


async def run_step(
    name: str,
    server: ServerUnderLoad,
    send: Send,
    duration_s: float,
    *,
    asked_per_s: float | None = None,
    settle_s: float = 0.0,
    sample_every_s: float = SAMPLE_EVERY_S,
) -> Step:
    """Makes calls for `duration_s` by the function `send`, and measures client, server and process meanwhile."""
    before = server.scrape()
    own_s, start_s = time.process_time(), time.monotonic()
    async with process_samples(server.process_id, sample_every_s) as samples:
        records = await send()
    own_s, wall_s = time.process_time() - own_s, time.monotonic() - start_s
    after = server.scrape()
    return Step(
        name=name,
        asked_per_s=asked_per_s,
        duration_s=duration_s,
        account=account_of(records, duration_s, settle_s),
        codes=[record.code for record in records],
        samples=samples,
        settle_s=settle_s,
        scraped=None if before is None or after is None else after.since(before),
        own_cpu_s=own_s,
        wall_s=wall_s,
    )


async def closed_loop_step(
    name: str,
    server: ServerUnderLoad,
    target: Target,
    requests: Sequence[bytes],
    concurrency: int,
    seconds: float,
    waits_if_refused: bool = True,
) -> Step:
    """Runs a step of this many concurrent calls; rates leave out its first fifth."""
    return await run_step(
        name,
        server,
        lambda: send_closed_loop(target, requests, concurrency, seconds, waits_if_refused),
        seconds,
        settle_s=CLOSED_SETTLE_SHARE * seconds,
    )
