"""Answers of LocalizeProgressively: each better one as soon as it is known, and then the final one."""

import asyncio
from collections.abc import AsyncGenerator, Callable, Coroutine
from typing import Any

from mapless.v1 import localization_service_pb2 as pb

GiveBetter = Callable[[pb.LocalizeResponse], None]
"""Receives an answer that is better than those before, while the final one is computed."""


async def better_then_final(
    answer: Callable[[GiveBetter], Coroutine[Any, Any, pb.LocalizeResponse]],
) -> AsyncGenerator[pb.LocalizeProgressivelyResponse, None]:
    """Yields each answer as soon as it is known, and then the final one.

    `answer` returns the final one; before, it may give others to its argument, on the event loop. It is computed
    whether the messages are read or not, so a slow reader delays only its own messages. Closing the generator cancels
    the answer, and frees its place in the queue. Any exception of `answer` is raised after what was given before.
    """
    given: asyncio.Queue[pb.LocalizeResponse | None] = asyncio.Queue()
    answering = asyncio.ensure_future(answer(given.put_nowait))
    answering.add_done_callback(lambda _: given.put_nowait(None))
    try:
        while (better := await given.get()) is not None:
            yield pb.LocalizeProgressivelyResponse(answer=better)
        yield pb.LocalizeProgressivelyResponse(answer=answering.result(), is_final=True)
    finally:
        answering.cancel()
        await asyncio.gather(answering, return_exceptions=True)
