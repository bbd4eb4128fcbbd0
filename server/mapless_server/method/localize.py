"""The method on one screen: prepare (features, matches) > reconstruct (coarse, scale) > solve, attempt by attempt.

`solve` has the order of what one attempt computes, `ladder` the attempts, `judge.decide` which of them is answered. The
queue calls each part separately, for many photographs: see `engine.stages`, which also changes features and references.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

from . import ladder
from .bundle.priors import NO_PRIORS, Priors
from .features.views import PosedView, View
from .judge.answer import Answer
from .judge.decide import Verdict, decide
from .judge.hypothesis import Attempt, Found
from .options import DoubtOptions, LocalizeOptions, StageContext, Variant
from .pipeline import Coarse, Pipeline, prepare, reconstruct
from .rejection import Rejection
from .solve import solve


def localize(
    query: View,
    references: Sequence[PosedView],
    pipeline: Pipeline,
    options: LocalizeOptions,
    context: StageContext | None = None,
    priors: Priors = NO_PRIORS,
    doubt: DoubtOptions = DoubtOptions(),  # noqa: B008  frozen
) -> Answer:
    """Localizes a query among posed references, the most similar first; priors are in the references' world.

    A rejection is an answer too; it names the first stage that failed. Raises whatever the context's check raises.
    """
    context = context or StageContext()
    prepared = prepare(query, references, pipeline, options, context, priors=priors)
    if isinstance(prepared, Rejection):
        return Answer(prepared)
    (coarse,) = reconstruct([prepared])
    if isinstance(coarse, Exception):
        raise coarse
    return refine(coarse, doubt)


def refine(coarse: Coarse, doubt: DoubtOptions = DoubtOptions()) -> Answer:  # noqa: B008  frozen
    """Computes poses from a reconstruction until nothing is in doubt that another attempt could change."""
    *_, (_, verdict) = attempts(coarse, doubt)
    seconds = dict(coarse.prepared.context.stage_seconds)
    return replace(verdict.chosen.answer, outcome=verdict.outcome, stage_seconds=seconds)


def attempts(coarse: Coarse, doubt: DoubtOptions) -> Iterator[tuple[Found, Verdict]]:
    """The attempts of a reconstruction, one after the other: each one's result, and the verdict after it."""
    prepared, attempt, found = coarse.prepared, Attempt(), list[Found]()
    priors = prepared.priors.shifted(prepared.origin)
    situation = ladder.Situation(
        is_best=prepared.options.variant is Variant.BEST,
        reference_count=len(prepared.references),
        has_depth=prepared.has_depth,
    )
    while True:
        found.append(solve(coarse, attempt, doubt))
        verdict = decide(found, priors, prepared.unit)
        yield found[-1], verdict
        tried = [it.attempt for it in found]
        following = next(ladder.further(attempt, tried, verdict.doubts, situation), None)
        if following is None:
            return
        attempt = following[1]
