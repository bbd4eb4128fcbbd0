"""Follows rejections: looks for a photograph beyond its soft priors, and names the place that needs a new survey.

So a soft prior that is wrong costs time and no answer, as within one scene (the rung "elsewhere").
"""

import asyncio
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass, replace

from mapless import names
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.engine.query import Query, Result
from mapless_server.errors import RequestError
from mapless_server.method.judge.answer import Localization
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.security import scene_id_of
from mapless_server.store import Store

from .messages.references import named_place

LACKS_REFERENCES = {
    pb.ADVICE_UNSPECIFIED,
    pb.ADVICE_ADD_REFERENCES,
    pb.ADVICE_SPREAD_REFERENCES,
    pb.ADVICE_LOOK_AT_REFERENCE,
    pb.ADVICE_CHOOSE_OTHER_REFERENCES,
}
"""Advice that a new survey stands above; other advice is about the photograph or the request, and stays."""


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


def name_outdated_place(store: Store, rejection: pb.Rejection, results: Iterable[Result]) -> None:
    """Sets the place of a rejection, and its hint, if photographs were compared with one that needs a new survey.

    Of several such places it is that of the reference with most matches, of as many, of the one that was chosen first.
    Reads the store.
    """
    from mapless_server.store import adoption  # for these rejections alone
    from mapless_server.store.reporting import find_references

    for result in results:
        if result.scene_key is None or not result.references:
            continue
        outdated = adoption.find_outdated(store.database, [it.key for it in result.references])
        counts = result.answer.reference_match_counts or (0,) * len(result.references)
        order = sorted(range(len(counts)), key=lambda i: -counts[i])
        found = next((outdated[it] for i in order if (it := result.references[i].key) in outdated), None)
        if found is None:
            continue
        place, reference_id = found
        rejection.outdated_place = names.reference_name(scene_id_of(result.scene_key), reference_id)
        if rejection.hint.advice in LACKS_REFERENCES:
            with store.database.read() as connection:
                records = find_references(connection, result.scene_key, [place])
            rejection.hint.advice = pb.ADVICE_ADD_REFERENCES
            rejection.hint.message = (
                f"Survey the place of reference {named_place(reference_id, records.get(place))} again: "
                "photographs show too little of what was surveyed."
            )
        return
