"""Finds the scenes, among several, in which a photograph is looked for, and decides between what is found in them.

References are chosen among those of all scenes as over one index. Where these are of several scenes, the photograph is
matched with them: the scenes are tried in the order of the agreement of the matches. An attempt in a scene then chooses
its references anew, among that scene's, so that its answer is the one with the scene named.

What is wrong with one scene must not cost the answer from another: a scene that cannot be read is left out.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

from mapless_server.engine.photo_views import QueryViews, RasterForm
from mapless_server.engine.search import Search
from mapless_server.errors import DataLoss, NotFound, Unavailable
from mapless_server.method import ladder
from mapless_server.method.features.rolls import LEAST_AGREEMENT, similarity_of
from mapless_server.method.features.views import Matches, PosedView, View
from mapless_server.method.judge.answer import Localization
from mapless_server.method.judge.decide import Verdict
from mapless_server.method.judge.hypothesis import Attempt, Doubt, Found, Hypothesis
from mapless_server.method.judge.worlds import World, decide_among
from mapless_server.method.pairs.correspond import Compared
from mapless_server.method.promise import PromiseOptions
from mapless_server.scenes import RankedReference
from mapless_server.scenes.library import FeaturesMissing
from mapless_server.security import scene_id_of

from . import choosing
from .failures import SceneMadeAnew
from .query import SceneQuestion, Tier
from .references import References
from .scene_group import RankedScene
from .situation import situation_of

log = logging.getLogger(__name__)

UNREADABLE = NotFound, DataLoss, FeaturesMissing
"""Errors of a scene that was deleted, is damaged, or has not been described."""

Chosen = tuple[SceneQuestion, Sequence[RankedReference]]
"""A scene, and its references among the most similar of all scenes."""


def with_scenes(search: Search, tier: Tier) -> Search:
    """The search at its begin in the scene that the photograph matches best; SceneMadeAnew if no scene is left."""
    group = search.group
    assert group is not None
    found, search = _chosen(search, tier)
    if not found:
        raise SceneMadeAnew
    resembling, compared = [it for it in found if it[1]], None
    ranking = tuple(_ranked(*it) for it in resembling or found[:1])
    if len(resembling) > 1:
        views = search.views.in_form(RasterForm(max_pixels=tier.max_pixels))
        compared = Compared(views.view(tier.extractor, search.context))
        ranking = _by_matches(search, resembling, tier, compared) or ranking
    group = replace(group, ranking=ranking, searched_count=len(found), compared=compared)
    return search.but(group=group).entered(0).but(spent_s=search.seconds(tier.features))


def _chosen(search: Search, tier: Tier) -> tuple[Sequence[Chosen], Search]:
    """The references that resemble the photograph, and the search with it turned as these are held."""
    assert search.group is not None
    source = search.source
    assert isinstance(source, References)
    query, count = search.group.query, choosing.SHORTLIST * search.group.query.reference_count
    search = search.but(query=query, views=search.group.views, material=None)
    for _ in range(2):
        views = search.views.in_form(RasterForm(max_pixels=tier.max_pixels))
        found = source.choose_among(query.scenes, views, count, search.context)
        likely = max((it for it in found if it[1]), key=lambda it: it[1][0].similarity, default=None)
        if likely is None or likely[0].priors.gravity is None:
            break
        views = _turned(search.but(query=query.in_scene(likely[0])), tier)
        if views is search.views:
            break
        search = search.but(views=views)
    return found, search


def _turned(search: Search, tier: Tier) -> QueryViews:
    """The photograph, turned as the references of the search's scene are held, if these can be read."""
    try:
        return choosing.turned_by_gravity(search, tier).views
    except UNREADABLE as error:
        log.warning("a photograph is not turned as scene %s is held: %s", search.query.scene_key, error)
        return search.views


def _by_matches(search: Search, found: Sequence[Chosen], tier: Tier, compared: Compared) -> tuple[RankedScene, ...]:
    """The scenes by the agreement of the photograph's matches with their references, and by similarity.

    Those of a sample of its keypoints suffice if they agree with the best scene's. Where the sample's matches may agree
    with another one's, all keypoints count, of the two references that match most, as many as a pose needs.
    """
    matcher, check = tier.pipeline.matcher, search.context.check
    loaded = [(it, references) for it in found if (references := _loaded(search, it, tier))]
    with search.context.stage("scenes"):
        sample, step = matcher.match_sample(compared, [it for _, some in loaded for it in some], check)
        ranked = _in_order(_agreements(loaded, compared.query, sample, step))
        if not ranked or step == 1:
            return ranked
        is_clear = ranked[0].agreement >= LEAST_AGREEMENT
        others = [it for it in ranked[1:] if it.may_rival(ranked[0])]
        again = {it.question.scene_key for it in (others if is_clear else ranked)}
        counts = {it.key: len(them) for it, them in zip((r for _, some in loaded for r in some), sample, strict=True)}
        most = 2 if is_clear else len(counts)
        some = [
            (it, tuple(sorted(references, key=lambda one: -counts[one.key])[:most]))
            for it, references in loaded
            if it[0].scene_key in again
        ]
        matches = matcher.match_compared(compared, [it for _, them in some for it in them], check)
        known = [it for it in ranked if it.question.scene_key not in again]
        return _in_order([*known, *_agreements(some, compared.query, matches, 1)])


def _in_order(ranked: Sequence[RankedScene]) -> tuple[RankedScene, ...]:
    return tuple(sorted(ranked, key=lambda it: (-it.agreement, -it.similarity)))


def _agreements(
    loaded: Sequence[tuple[Chosen, tuple[PosedView, ...]]], view: View, matches: Sequence[Matches], step: int
) -> list[RankedScene]:
    """The scenes with the agreement of matches of one in so many keypoints; that of all is larger by its root."""
    ranked, rest = [], iter(matches)
    for (question, chosen), references in loaded:
        pairs = [(reference, next(rest)) for reference in references]
        similar = [similarity_of(view, reference.view, them) for reference, them in pairs]
        agreement = math.sqrt(step) * choosing.agreement_of(similar, references, is_enough=True)
        agreeing = step * max((it.agreeing for it in similar if it), default=0)
        most = step * max(len(them) for _, them in pairs)
        ranked.append(
            replace(_ranked(question, chosen), match_count=most, agreement=agreement, agreeing_count=agreeing)
        )
    return ranked


def _loaded(search: Search, chosen: Chosen, tier: Tier) -> tuple[PosedView, ...]:
    """References with the tier's features; none if the scene, or what it stores, cannot be read."""
    question, references = chosen
    in_it = search.but(query=search.query.in_scene(question))
    try:
        return choosing.load_chosen(in_it, [it.reference_id for it in references], tier)[1]
    except UNREADABLE as error:
        log.warning("scene %s is left out among several: %s", question.scene_key, error)
        return ()


def _ranked(question: SceneQuestion, chosen: Sequence[RankedReference]) -> RankedScene:
    return RankedScene(question, len(chosen), max((it.similarity for it in chosen), default=0.0))


def is_of_scene(failure: Exception) -> bool:
    """Whether an attempt failed by what is stored of its scene, so that others may have an answer."""
    return isinstance(failure, NotFound | DataLoss | Unavailable)


def without_scene(search: Search, failure: Exception) -> Search | None:
    """The search without its present scene, which could not be read; None if no other one is left."""
    group = search.group
    assert group is not None
    log.warning("scene %s is left out among several: %s", search.query.scene_key, failure)
    if not group.ranking:
        return search
    group = replace(group, left_out=group.left_out | {search.attempt.scene})
    tried = (*search.tried, search.attempt)
    if search.verdict is None and group.next_scene(tried) is None:
        return None
    return search.but(group=group)


def doubting(search: Search, found: Found) -> Found:
    """The result of the present attempt, in doubt if references of a scene that was not tried match the photograph."""
    assert search.group is not None
    rank = search.group.next_scene((*search.tried, search.attempt))
    is_accepted = isinstance(found, Hypothesis) and found.is_accepted
    ranking = search.group.ranking
    if not is_accepted or rank is None or not ranking[rank].may_rival(ranking[search.attempt.scene]):
        return found
    return replace(found, doubts=found.doubts | Doubt.OTHER_SCENE)


def verdict_among(search: Search) -> Verdict:
    """The verdict of all scenes that have one."""
    return decide_among([_world(it) for it in search.searches if it.own is not None])


def _world(search: Search) -> World:
    assert search.own is not None
    key, datum = search.query.scene_key, search.materials[-1].attributes.datum
    ecef_from_world = None if datum is None else datum.ecef_from_world()
    return World(key, scene_id_of(key), search.found, search.own, search.query.priors, ecef_from_world)


def following(search: Search, tiers: Sequence[Tier], promise: PromiseOptions) -> Iterator[tuple[ladder.Rung, Attempt]]:
    """The attempts that can remove a doubt: in the scene that is answered, or in all if none is, by their rungs.

    In each scene they follow one another as if that scene had been named.
    """
    group, verdict = search.group, search.verdict
    assert group is not None
    assert verdict is not None
    left = [it for it in search.searches if it.own is not None and it.attempt.scene not in group.left_out]
    if isinstance(verdict.outcome, Localization):
        left = [it for it in left if it.attempt.scene == verdict.chosen.attempt.scene]
    found = [
        (ladder.RUNGS.index(rung), rung, attempt)
        for it in left
        for rung, attempt in _further(it.but(group=group, tried=search.tried), tiers, promise)
    ]
    yield from ((rung, attempt) for _, rung, attempt in sorted(found, key=lambda it: it[0]))


def _further(search: Search, tiers: Sequence[Tier], promise: PromiseOptions) -> Iterator[tuple[ladder.Rung, Attempt]]:
    assert search.own is not None
    before = search.before or search.attempt
    return ladder.further(before, search.tried, search.own.doubts, situation_of(search, tiers, promise))
