"""Which references a query uses: those that it names, or those that resemble the photograph and match it most.

A photograph that was not localized is also compared with them turned (so is one with a pose of little trust), and with
references elsewhere than priors say.
"""

from collections.abc import Sequence
from functools import partial

from scipy.special import bdtrc

from mapless_server.errors import DataLoss
from mapless_server.method.judge.answer import Answer
from mapless_server.method.rejection import Advice, Hint, Rejection, RejectionReason
from mapless_server.scenes.library import Loaded, load_usable
from mapless_server.scenes.retrieval.ranking import spread_choice

from . import tracking
from .photos import QueryViews
from .query import TURN, QueryRun, Tier
from .tiers import CLEARLY_MORE

TURN_REFERENCES = 10
"""A photograph that was not localized is compared with so many references each way round, the most similar first."""

MIRRORED_BY_CHANCE = 1e-6
"""A photograph is mirrored only if matches that are as likely with it as with its mirror image would be shared so
unevenly with less than this probability."""


def with_named(run: QueryRun, tier: Tier) -> QueryRun:
    """Loads the references that the query names, and finds the photograph's features."""
    # References come first: a wrong name is found before the photograph is described.
    generation, references = run.load(run.query.reference_ids, tier)
    view = run.views.view(tier.extractor, run.context)
    return run.but(generation=generation, references=references, view=view)


def with_chosen(run: QueryRun, tier: Tier) -> QueryRun:
    """Chooses, among the references that resemble the photograph most, those with the most matches."""
    query, context = run.query, run.context
    choice = run.choose(query.narrowing)
    generation, shortlist = load_chosen(run, [it.reference_id for it in choice.references], tier)
    view = run.views.view(tier.extractor, context)

    def choose(indices: Sequence[int], match_counts: Sequence[int]) -> list[int]:
        centres = [shortlist[i].world_from_camera.translation for i in indices]
        return [indices[i] for i in spread_choice(match_counts, centres, query.reference_count)]

    with context.stage("shortlist"):
        matcher = tier.pipeline.matcher
        matches = matcher.match_best(view, shortlist, query.reference_count, choose, context.check)
    chosen, query_matches = tuple(shortlist[i] for i in matches), tuple(matches.values())
    found = run.but(generation=generation, references=chosen, view=view, choice=choice)
    return found.but(query_matches=query_matches)


def load_chosen(run: QueryRun, reference_ids: Sequence[str], tier: Tier) -> Loaded:
    """Loads chosen references without damaged ones; a damaged reference that the caller named is an error."""
    if run.query.reference_ids:
        return run.load(reference_ids, tier)
    report = partial(run.source.report_damaged, run.query.scene_key)
    return load_usable(lambda some: run.load(some, tier), reference_ids, (DataLoss,), report)


def turned_to_match(run: QueryRun, tier: Tier) -> QueryViews | Rejection:
    """The photograph turned such that clearly more of it matches references than as it is; else as it is.

    The best of its references counts: others may not show the same.

    Returns:
        The photograph; or its rejection, where its mirror image matches clearly more than any of these, and not by
        chance. So it does if the photograph is mirrored, or shows another side of something symmetric: parts of the
        place that look like the mirror image of others would give it a wrong pose.
    """
    context = run.context
    with context.stage(TURN):
        found = [run.views, *(run.views.turned(turns, context) for turns in (1, 2, 3)), run.views.mirrored(context)]
    *turned, mirrored = [_most_matches(run.but(views=views), tier) for views in found]
    best = max(turned, key=lambda it: it[0])
    most, name = mirrored
    chance = bdtrc(most - 1, most + best[0], 0.5) if most else 1.0
    if most >= CLEARLY_MORE * best[0] and chance < MIRRORED_BY_CHANCE:
        return _mirrored(most, best[0], name)
    return found[turned.index(best) if best[0] >= CLEARLY_MORE * turned[0][0] else 0]


def _mirrored(most: int, not_mirrored: int, reference: str) -> Rejection:
    message = (
        "the photograph is mirrored, or shows another side of something symmetric: its mirror image has "
        f"{most} matches with a reference, as it is or turned at most {not_mirrored}"
    )
    advice = (
        "Send the photograph as the camera took it: previews of front cameras and some videos exchange left and right "
        "(if so, the principal point is at width - 1 - x). If it is as taken, add references of this side."
    )
    return Rejection(RejectionReason.GATE, message, Hint(TURN, Advice.CHECK_CALIBRATION, advice, reference))


def _most_matches(run: QueryRun, tier: Tier) -> tuple[int, str]:
    """Most matches of the photograph with one of the references that it resembles, or of those named; its name."""
    query = run.query
    if query.chooses:
        chosen = run.choose(query.narrowing).references[:TURN_REFERENCES]
        references = load_chosen(run, [it.reference_id for it in chosen], tier)[1]
    else:
        references = run.load(query.reference_ids[:TURN_REFERENCES], tier)[1]
    view = run.views.view(tier.extractor, run.context)
    with run.context.stage(TURN):
        matches = tier.pipeline.matcher.match_quickly(view, references, run.context.check)
    counts = list(map(len, matches))
    best = max(range(len(counts)), key=counts.__getitem__, default=None)
    return (0, "") if best is None else (counts[best], references[best].name)


def may_be_elsewhere(run: QueryRun, tier: Tier, answer: Answer) -> bool:
    """Whether soft priors may have led to the wrong references.

    That is if the photograph was not localized, and references elsewhere would be chosen without them; or if the
    reference that resembles it most is not where they say, and references elsewhere contradict the pose.
    """
    outcome, query = answer.outcome, run.query
    is_excluded = isinstance(outcome, Rejection) and bool(outcome.intrinsics_checks)
    if run.choice is None or query.is_part or is_excluded or not query.narrowing.has_likely:
        return False
    with run.context.stage("retrieval"):
        alike = run.choose(query.narrowing.limits).references
    inside = {it.reference_id for it in run.choice.references}
    if isinstance(outcome, Rejection):
        return any(it.reference_id not in inside for it in alike)
    if not alike or alike[0].reference_id in inside:
        return False
    assert run.view is not None
    others = [it.reference_id for it in alike if it.reference_id not in inside][: tracking.OTHERS]
    with run.context.stage("correspond"):
        rivals = load_chosen(run, others, tier)[1]
        return tracking.is_contradicted(answer, run.view, rivals, tier.pipeline.matcher)


def is_searched(run: QueryRun) -> bool:
    """Whether the scene has references to choose from."""
    return run.choice is not None and bool(run.choice.descriptor)
