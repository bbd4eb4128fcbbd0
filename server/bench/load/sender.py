"""Sends the calls as bytes, so that nothing is encoded or decoded during the measurement.

One process with one event loop is enough: it spends a third of a millisecond on a call of 0.3 MB.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any

import grpc

from mapless.errors import from_rpc_error
from mapless.proxies import is_exempt

from .calls import CallRecord, Fate, Kind, PlannedCall

MAX_MESSAGE_BYTES = 64 * 2**20
REFUSED_PAUSE_S = 0.1
"""Before a refused caller in a closed loop calls again, where the server does not say when."""
ReadAnswer = Callable[[bytes], str]
"""The outcome of an answer, in a few words."""
Metadata = tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class Target:
    """The called method, of each client on its own connection; the default deadline; and how an answer is read."""

    methods: Sequence[Any]
    deadline_s: float
    read_answer: ReadAnswer


@asynccontextmanager
async def connected(
    address: str,
    method: str,
    clients: int,
    deadline_s: float,
    read_answer: ReadAnswer,
    metadata: Callable[[int], Metadata] = lambda _: (),
) -> AsyncIterator[Target]:
    """Connects several clients to a method, "/package.Service/Method", until the end of the block.

    `metadata` makes the metadata of each call of a client, by its index.
    """
    channels = [own_channel(address) for _ in range(clients)]
    try:
        for channel in channels:
            await asyncio.wait_for(channel.channel_ready(), 30)
        methods = [_with_metadata(it.unary_unary(method), partial(metadata, i)) for i, it in enumerate(channels)]
        yield Target(methods, deadline_s, read_answer)
    finally:
        for channel in channels:
            await channel.close()


def own_channel(address: str) -> grpc.aio.Channel:
    """A channel with a connection of its own, without retries: a refusal is measured, not the outcome of a retry."""
    options = [
        # Channels to one address share a connection otherwise, and the server would see one client.
        ("grpc.use_local_subchannel_pool", 1),
        ("grpc.enable_http_proxy", int(not is_exempt(address))),
        ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
        ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
        ("grpc.enable_retries", 0),
    ]
    return grpc.aio.insecure_channel(address, options)


def _with_metadata(method: Any, metadata: Callable[[], Metadata]) -> Callable[..., Any]:
    return lambda request, timeout: method(request, timeout=timeout, metadata=metadata())


async def send_open_loop(target: Target, plan: Sequence[PlannedCall], start_s: float | None = None) -> list[CallRecord]:
    """Makes every call of a plan at its time, independent of the outcomes of earlier calls.

    The plan, in order of time, begins at `start_s` by the event loop's clock, or now. Returns one record per call,
    after all have ended; all end, since they have deadlines.
    """
    loop = asyncio.get_running_loop()
    begin_s = loop.time() if start_s is None else start_s
    calls: list[asyncio.Task[CallRecord]] = []
    for planned in plan:
        wait_s = begin_s + planned.at_s - loop.time()
        if wait_s > 0:
            await asyncio.sleep(wait_s)
        calls.append(asyncio.create_task(_call(target, planned, begin_s)))
    return list(await asyncio.gather(*calls))


async def send_closed_loop(
    target: Target, requests: Sequence[bytes], concurrency: int, duration_s: float, waits_if_refused: bool = True
) -> list[CallRecord]:
    """Keeps this many calls in progress, to measure the largest rate or, with one call, the unloaded latency.

    It does not measure latency under load, since the callers wait for the server. A refused caller calls again when the
    server requests it, or else at once, as badly written callers do.
    """
    loop = asyncio.get_running_loop()
    begin_s = loop.time()
    records: list[CallRecord] = []
    numbers = count()

    async def keep_calling(client: int) -> None:
        while (at_s := loop.time() - begin_s) < duration_s:
            planned = PlannedCall(at_s, client, Kind.QUERY, requests[next(numbers) % len(requests)])
            record = await _call(target, planned, begin_s)
            records.append(record)
            if record.fate is Fate.REFUSED and waits_if_refused:
                left_s = max(0.0, begin_s + duration_s - loop.time())
                await asyncio.sleep(min(record.retry_after_s or REFUSED_PAUSE_S, left_s))

    await asyncio.gather(*map(keep_calling, range(concurrency)))
    return records


async def _call(target: Target, planned: PlannedCall, begin_s: float) -> CallRecord:
    loop = asyncio.get_running_loop()
    sent_s = loop.time()
    deadline_s = target.deadline_s if planned.deadline_s is None else planned.deadline_s
    call = target.methods[planned.client % len(target.methods)](planned.request, timeout=deadline_s)
    hang_up = None
    if planned.cancel_after_s is not None:
        hang_up = loop.call_later(planned.cancel_after_s, call.cancel)
    retry_after_s = None
    try:
        answer = await call
        ended_s = loop.time()
        code, detail = "OK", target.read_answer(answer)
    except grpc.aio.AioRpcError as error:
        ended_s = loop.time()
        known = from_rpc_error(error)
        is_given = known.request_id or known.reason != known.code  # by the server, with a reason
        code, detail, retry_after_s = known.code, known.reason if is_given else "", known.retry_after_s
    except asyncio.CancelledError:
        if not call.cancelled() or hang_up is None:
            raise  # this task was cancelled, not the call
        ended_s = loop.time()
        code, detail = "CANCELLED", ""
    finally:
        if hang_up is not None:
            hang_up.cancel()
    times_s = (planned.at_s, sent_s - begin_s, ended_s - begin_s)
    return CallRecord(planned.kind, planned.client, *times_s, deadline_s, code, detail, retry_after_s)
