"""Looks for a photograph also in scenes where its soft priors do not expect it, if it is rejected in the others.

So a soft prior that is wrong costs time and no answer, as within one scene (the rung "elsewhere").
"""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace

from mapless_server.engine.query import Query, Result
from mapless_server.errors import RequestError
from mapless_server.method.judge.answer import Localization
from mapless_server.method.rejection import Rejection, RejectionReason


@dataclass(frozen=True, eq=False)
class Asked:
    """A query, and what makes the one in the scenes that soft priors alone leave out; None if they leave out none."""

    query: Query
    beyond: Callable[[], Query] | None = None


def may_be_beyond(result: Result) -> bool:
    """Whether a photograph may be where soft priors do not expect it: it is rejected, and not for two poses."""
    outcome = result.answer.outcome
    return isinstance(outcome, Rejection) and outcome.reason is not RejectionReason.AMBIGUOUS


async def searched_beyond(
    query: Query, result: Result, beyond: Callable[[], Query], run: Callable[[Query], Awaitable[Result]]
) -> tuple[Query, Result]:
    """A rejected query and its result, or those in the scenes beyond if the photograph is localized there.

    A failed search for a better answer does not cost the first one.
    """
    try:
        further = await asyncio.to_thread(beyond)
        found = await run(further)
    except RequestError:
        return query, result
    count = result.searched_scene_count + found.searched_scene_count
    if isinstance(found.answer.outcome, Localization):
        query, result = further, found
    return query, replace(result, searched_scene_count=count)
