"""LocalizeProgressively: a stream of at most two messages, the coarse answer if there is one and the final answer."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable, Coroutine
from typing import Any

from mapless.v1 import localization_service_pb2 as pb

FutureCoarseAnswer = asyncio.Future[pb.LocalizeResponse]
"""Is set to the coarse answer, on the event loop, if there is one."""


async def coarse_then_final(
    answer: Callable[[FutureCoarseAnswer], Coroutine[Any, Any, pb.LocalizeResponse]],
) -> AsyncGenerator[pb.LocalizeProgressivelyResponse, None]:
    """Yields the coarse answer as soon as it is known, if there is one, and then the final answer.

    The answer is computed whether the messages are read or not, so a slow reader delays only its own messages. Closing
    the generator cancels the answer, and frees its place in the queue.

    Args:
        answer: returns the final answer; before, it may set its argument to the coarse answer.

    Raises:
        Exception: as `answer`, after the coarse message if there was one.
    """
    coarse: FutureCoarseAnswer = asyncio.get_running_loop().create_future()
    answering = asyncio.ensure_future(answer(coarse))
    either: set[asyncio.Future[Any]] = {answering, coarse}
    try:
        await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
        if coarse.done():
            yield pb.LocalizeProgressivelyResponse(answer=coarse.result())
        yield pb.LocalizeProgressivelyResponse(answer=await answering, is_final=True)
    finally:
        answering.cancel()
        await asyncio.gather(answering, return_exceptions=True)
