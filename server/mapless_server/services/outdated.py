"""Names, in the rejection of a photograph, the place that needs a new survey."""

from __future__ import annotations

from collections.abc import Iterable

from mapless import names
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.engine.query import Result
from mapless_server.security import scene_id_of
from mapless_server.store import Store, adoption

LACKS_REFERENCES = {
    pb.ADVICE_UNSPECIFIED,
    pb.ADVICE_ADD_REFERENCES,
    pb.ADVICE_SPREAD_REFERENCES,
    pb.ADVICE_LOOK_AT_REFERENCE,
    pb.ADVICE_CHOOSE_OTHER_REFERENCES,
}
"""Advice that a new survey stands above; other advice is about the photograph or the request, and stays."""


def name_outdated_place(store: Store, rejection: pb.Rejection, results: Iterable[Result]) -> None:
    """Sets the place of a rejection, and its hint, if photographs were compared with one that needs a new survey.

    Of several such places it is that of the reference with most matches, of as many, of the one that was chosen first.
    Reads the store.
    """
    for result in results:
        if result.scene_key is None or result.attributes.adoption is None or not result.references:
            continue
        outdated = adoption.list_outdated(store.database, result.scene_key)
        counts = result.answer.reference_match_counts or (0,) * len(result.references)
        order = sorted(range(len(counts)), key=lambda i: -counts[i])
        places = adoption.places_of(store.database, [result.references[i].key for i in order]) if outdated else []
        place = next((it for it in places if it in outdated), None)
        if place is None:
            continue
        reference_id = outdated[place]
        rejection.outdated_place = names.reference_name(scene_id_of(result.scene_key), reference_id)
        if rejection.hint.advice in LACKS_REFERENCES:
            rejection.hint.advice = pb.ADVICE_ADD_REFERENCES
            rejection.hint.message = (
                f"Survey the place of reference {reference_id} again: photographs show too little of what was surveyed."
            )
        return
