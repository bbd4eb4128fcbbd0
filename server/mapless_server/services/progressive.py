"""Coarse first, refined after: an answer and what is known before it, as a stream of at most two messages."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable, Coroutine
from typing import Any

from mapless.v1 import localization_service_pb2 as pb
from mapless_server.engine.query import Result

TellCoarse = Callable[[Result], None]
"""Told a coarse result, on the event loop."""


async def coarse_then_final(
    answer: Callable[[TellCoarse], Coroutine[Any, Any, pb.LocalizeResponse]],
    coarse_message: Callable[[Result], pb.LocalizeResponse],
) -> AsyncGenerator[pb.LocalizeProgressivelyResponse, None]:
    """The coarse answer as soon as there is one, if there is, and the final one.

    The answer is computed whether anybody reads or not: who reads slowly holds up their own messages alone. Closing the
    generator gives the answer up, and with it its place in the queue.

    Args:
        answer: gives the final answer, and tells a coarse result before, or none. Of several the first is sent.
        coarse_message: of such a result.

    Raises:
        Exception: whatever `answer` does, after the coarse message if there was one.
    """
    coarse: asyncio.Future[Result] = asyncio.get_running_loop().create_future()

    def tell(result: Result) -> None:
        if not coarse.done():
            coarse.set_result(result)

    answering = asyncio.ensure_future(answer(tell))
    either: set[asyncio.Future[Any]] = {answering, coarse}
    try:
        await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
        if coarse.done():
            yield pb.LocalizeProgressivelyResponse(answer=coarse_message(coarse.result()))
        yield pb.LocalizeProgressivelyResponse(answer=await answering, is_final=True)
    finally:
        answering.cancel()
        await asyncio.gather(answering, return_exceptions=True)
