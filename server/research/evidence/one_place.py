"""The constants of the one rule: when poses are of one place, and when a place is clearly better than another.

The attempts of each photograph are computed once, with SIFT; each alternative decides between the same results.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from mapless.geometry import Camera
from mapless.priors import set_priors
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.bundle.priors import NO_PRIORS, Priors
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.features.extractors import make_extractor
from mapless_server.method.features.matching import OPTIONS
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.judge.decide import PLACES, PlaceOptions, at_one_place, decide
from mapless_server.method.judge.hypothesis import Found, Hypothesis
from mapless_server.method.localize import attempts
from mapless_server.method.options import DoubtOptions, LocalizeOptions, StageContext
from mapless_server.method.pairs.make import make_matcher
from mapless_server.method.pipeline import Pipeline, prepare, reconstruct
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.services.messages.priors import priors_from_message
from mapless_server.store.attributes import SceneAttributes
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.references import choose_references
from research.contradictions.cases import Case, Expected, cases_of
from research.places import Place, Scenes, distance_seen, is_right

from .page import Measurement, Row

ASKED = ("sparse", "repeated", "two-places", "right-priors", "wrong-priors")
REFERENCES = 10
ALTERNATIVES = {
    "same-place": {
        f"{scale * 0.1:g} m, {scale * 2:g} deg, {scale * 5:g} %": PlaceOptions(0.1 * scale, 2 * scale, 0.05 * scale)
        for scale in (0.1, 0.3, 0.5, 1.0, 2.0, 3.0, 10.0)
    },
    "clearly-more": {
        f"{ratio:g}": PlaceOptions(clearly_more=ratio) for ratio in (1.0, 1.1, 1.25, 1.5, 1.75, 2.0, 3.0, 5.0)
    },
}


@dataclass(frozen=True, eq=False)
class Asked:
    """A case with the results of its attempts."""

    case: Case
    found: Sequence[Found]
    priors: Priors


def _rows(key: str, scenes: Path) -> Iterator[Row]:
    asked = _asked(scenes)
    several = [it for it in asked if _place_count(it.found) > 1]
    for value, options in ALTERNATIVES[key].items():
        outcomes = Counter(_outcome(it, options) for it in asked)
        ratio = Counter(_outcome(it, options) for it in several)
        yield {
            "value": f"**{value}**" if options == PLACES else value,
            "right": outcomes["right"],
            "wrong": outcomes["wrong"],
            "ambiguous": outcomes[RejectionReason.AMBIGUOUS.name],
            "rejected otherwise": len(asked) - sum(outcomes[it] for it in ("right", "wrong", "AMBIGUOUS")),
            f"of the {len(several)} with two places: right": ratio["right"],
            "wrong there": ratio["wrong"],
        }


def _place_count(found: Sequence[Found]) -> int:
    """The number of places of the poses with the values in use."""
    places = list[Hypothesis]()
    for it in found:
        if isinstance(it, Hypothesis) and not any(at_one_place(it, other) for other in places):
            places.append(it)
    return len(places)


def _outcome(asked: Asked, options: PlaceOptions) -> str:
    case, verdict = asked.case, decide(asked.found, asked.priors, options=options)
    outcome, support = verdict.outcome, verdict.chosen.answer.support
    if isinstance(outcome, Rejection):
        return outcome.reason.name
    if case.true_pose is None or support is None or case.expected in (Expected.REJECTED, Expected.AMBIGUOUS):
        return "wrong"
    errors = pose_error(case.true_pose, outcome.world_from_camera)
    distance = distance_seen(support.query.camera, case.true_pose, support.structure.x_in_world + support.origin)
    return "right" if is_right(*errors, distance, case.place.dataset.metric) else "wrong"


@cache
def _asked(scenes: Path) -> Sequence[Asked]:
    """Computes the attempts of each case."""
    extractor = make_extractor("sift")
    pipeline = Pipeline(make_reconstructor("geometric", Path()), make_matcher("sift", 2))

    @cache
    def view_of(image: Path, camera: Camera) -> View:
        return extractor.extract(decode_image(image.read_bytes(), ImageLimits()), camera)

    @cache
    def references_of(place: Place) -> list[PosedView]:
        return [
            PosedView(it.reference_id, it.reference_id, view_of(Path(str(it.image)), it.camera), it.world_from_camera)
            for it in place.references()
        ]

    asked = list[Asked]()
    for case in cases_of(Scenes(scenes), ASKED):
        if "limit" in case.name:
            continue
        query = extractor.extract(decode_image(case.image(), ImageLimits()), case.camera)
        every = references_of(case.place)
        chosen = choose_references(query, every, REFERENCES, ratio=OPTIONS["sift"].query_ratio)
        priors = _method_priors(case)
        references = [every[i] for i in chosen]
        prepared = prepare(query, references, pipeline, LocalizeOptions(), StageContext(), priors=priors)
        if isinstance(prepared, Rejection):
            continue
        (coarse,) = reconstruct([prepared])
        if isinstance(coarse, Exception):
            raise coarse
        asked.append(Asked(case, [found for found, _ in attempts(coarse, DoubtOptions())], priors))
    pipeline.matcher.close()
    return asked


def _method_priors(case: Case) -> Priors:
    """The priors of a case as the method takes them."""
    if case.priors is None:
        return NO_PRIORS
    request = pb.LocalizeRequest()
    set_priors(request, case.priors)
    return priors_from_message(request, SceneAttributes())[1]


MEASUREMENTS = {key: Measurement(partial(_rows, key)) for key in ALTERNATIVES}
