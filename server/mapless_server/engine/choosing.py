"""Chooses the references of a query: those that it names, or those that resemble the photograph and match it most.

Also how the photograph is rolled against them, and whether references elsewhere contradict its pose.
"""

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import bdtrc

from mapless_server.engine.photo_views import QueryViews, RasterForm
from mapless_server.engine.search import Material
from mapless_server.errors import DataLoss
from mapless_server.images import upright_of
from mapless_server.method.features.limits import EPIPOLAR_PX
from mapless_server.method.features.rolls import (
    LEAST_AGREEMENT,
    Similarity,
    are_alike,
    nearest_quarter,
    rasters_of,
    roll_about_axis,
    roll_of_directions,
    roll_of_rotation,
    similarity_of,
)
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.judge.decide import PLACES
from mapless_server.method.judge.hypothesis import Found, Hypothesis, Raster, Where
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pairs.epipolar import epipolar_distance_px
from mapless_server.method.promise import PROMISE
from mapless_server.method.rejection import Advice, Hint, Rejection, RejectionReason
from mapless_server.scenes import Choice, Narrowing, Selection
from mapless_server.scenes.library import FeaturesMissing, Loaded, load_usable
from mapless_server.scenes.retrieval.ranking import THINNED_LATER, spread_choice
from mapless_server.scheduling import Abandoned, Failure
from mapless_server.store import SceneAttributes, SceneState

from .failures import SceneMadeAnew, failure_of
from .query import MIRROR, Tier
from .search import Search

log = logging.getLogger(__name__)

SHORTLIST = 2
"""Factor on the references wanted: that many are matched with a sample of the photograph, and the best of them used.
Decision: 025-choosing-references."""

SAMPLED = 5
"""So many references show how most of a scene are held."""

LEAST_DESCRIBED = 2
"""An attempt is made with so many references at least where others still lack its features."""

OTHERS = 2
"""References elsewhere that are compared."""

RIVAL_SHARE = 0.5
"""A reference elsewhere contradicts a pose by so many matches off their epipolar lines, as a share of the matches with
the best reference; as in `judge.judge`."""

ALONE_BY_CHANCE = LEAST_AGREEMENT - PROMISE.agreement
"""Difference of the agreement of one reference and of two where both are as likely by chance."""

MIRROR_REFERENCES = 5
"""A photograph and its mirror image are compared with so many references, the most similar, or with all named ones."""

MIRRORED_BY_CHANCE = 1e-6
"""A photograph is mirrored only if matches that are as likely with it as with its mirror image would be shared so
unevenly with less than this probability."""


def described_anew(search: Search, tier: Tier, any_roll: int | None) -> Material | None:
    """The photograph and the references of the search's attempt; None if these are those of an attempt before.

    `any_roll` is the index of the features that match however the camera is rolled.
    """
    attempt, verdict, query = search.attempt, search.own, search.query
    if attempt.where is Where.ONE_PLACE and verdict is not None and verdict.place is not None:
        return search.materials[search.found.index(verdict.chosen)].of_place(verdict.place, attempt.basis)
    if attempt.where is Where.ANYWHERE and _is_same_anywhere(search, tier):
        return None
    views = search.views.in_form(RasterForm(attempt.angles_deg, tier.max_pixels))
    found = _chosen(search, views, tier, any_roll) if query.chooses else _named(search, views, tier)
    if found.query_matches is not None:
        return found
    with search.context.stage("correspond"):
        matches = tier.pipeline.matcher.match_quickly(found.view, found.references, search.context.check)
    return replace(found, query_matches=tuple(matches))


def turned_by_gravity(search: Search, tier: Tier) -> Search:
    """The search with a photograph that has a gravity prior turned, by quarters, as most references are held.

    Their poses show how gravity lies in the rasters in which they were described; nearly all of a scene are held alike,
    so a few show it. EXIF that turns the photograph comes first. Features that match at any roll need no turn.
    """
    query, gravity = search.query, search.query.priors.gravity
    if gravity is None or tier.any_roll or upright_of(query.photo.image).clockwise_deg:
        return search
    ids = query.reference_ids
    if query.chooses:
        ids = tuple(search.source.sample(query.scene_key, ids, SAMPLED, search.context))
    turns = Counter[float]()
    for it in load_chosen(search, ids, tier)[1] if ids else ():
        roll_deg = roll_of_directions(gravity.in_camera, it.world_from_camera.rotation.T @ gravity.in_world)
        if roll_deg is not None:
            turns[nearest_quarter(roll_deg + it.view.upright_deg)] += 1
    ((turn_deg, _),) = turns.most_common(1) or [(0.0, 0)]
    if not turn_deg:
        return search
    photo = replace(query.photo, upright_deg=turn_deg)
    return search.but(query=replace(query, photo=photo), views=search.views.of(photo))


def _narrowing_of(search: Search) -> Narrowing:
    """Where the attempt's references are."""
    narrowing = search.query.narrowing
    return narrowing.limits if search.attempt.where is Where.ANYWHERE else narrowing


def load_chosen(search: Search, reference_ids: Sequence[str], tier: Tier) -> Loaded:
    """Loads chosen references without damaged ones, and without those whose features there is no time to make.

    FeaturesMissing where too few are left. What is wrong with a reference that the caller named is an error.
    """
    if search.query.reference_ids:
        return _load(search, reference_ids, tier)
    report = partial(search.source.report_damaged, search.query.scene_key)
    try:
        return load_usable(lambda some: _load(search, some, tier), reference_ids, (DataLoss,), report)
    except FeaturesMissing as missing:
        described = [it for it in reference_ids if it not in missing.reference_ids]
        if len(described) < LEAST_DESCRIBED:
            raise
        return load_usable(lambda some: _load(search, some, tier), described, (DataLoss,), report)


def attributes_of(search: Search, scene: SceneState) -> SceneAttributes:
    """The attributes of a scene, as far as they count for the search's query; DataLoss if they are damaged.

    SceneMadeAnew unless they mean what those mean by which the query's priors were converted.
    """
    attributes, known = scene.attributes, search.query.attributes
    if known is not None and known.world != attributes.world:
        raise SceneMadeAnew
    if contradiction := search.source.contradiction(search.query.scene_key):
        attributes = replace(attributes, contradiction=contradiction)
    if search.query.is_generic:
        attributes = replace(attributes, calibration=None, self_calibrations=())
    if attributes.contradiction:  # radii and trust measured by its references say nothing
        attributes = replace(attributes, self_calibrations=())
    return attributes


def compared(search: Search) -> Search:
    """The search with what the matches of its attempt show: how much they agree, and how the photograph is rolled."""
    material = search.material
    if material is None or not material.query_matches or any(it is material for it in search.materials):
        return search
    pairs = zip(material.references, material.query_matches, strict=True)
    found = [similarity_of(material.view, reference.view, matches) for reference, matches in pairs]
    is_enough = search.query.is_part or search.query.photo.depth is not None
    agreement = max(search.agreement, agreement_of(found, material.references, is_enough))
    search = search.but(agreement=agreement)
    is_upright = search.attempt.raster is Raster.AS_IS
    return search.but(angles_deg=_rasters_by(search, material, found)) if is_upright else search


def agreement_of(found: Sequence[Similarity | None], references: Sequence[PosedView], is_enough: bool) -> float:
    """The agreement that as many references reach as a pose needs: two.

    One that has depths is enough, and so is one for a rig's or sequence's photograph, which others help; chance reaches
    more with one of many than with two.
    """
    agreements = [it.agreement if it else 0.0 for it in found]
    alone = [a for a, it in zip(agreements, references, strict=True) if is_enough or it.depths is not None]
    _, second, *_ = sorted([*agreements, 0.0, 0.0], reverse=True)
    return max([second, *(it - ALONE_BY_CHANCE for it in alone)])


def _rasters_by(search: Search, material: Material, found: Sequence[Similarity | None]) -> tuple[float, ...]:
    """By how much to turn the photograph, clockwise, so that references are upright in one of its rasters.

    Matches with the photograph as it is show how it is rolled against references, those for any roll best; references
    without enough matches are rolled against the others as their poses say. Where matches show nothing, priors may.

    Returns:
        The angles, degrees; empty if references are upright in the photograph as it is, or nothing shows that.
    """
    references = material.references
    by_exif = [it.view.upright_deg - material.view.upright_deg for it in references]
    shown = [it if it is not None and it.agreement >= LEAST_AGREEMENT else None for it in found]
    counts = [it.agreeing if it else 0 for it in shown]
    best = int(np.argmax(counts))
    if roll := shown[best]:
        world_from_query = references[best].world_from_camera.rotation @ roll_about_axis(roll.clockwise_deg)
        by_pose = (roll_of_rotation(it.world_from_camera.rotation.T @ world_from_query) for it in references)
        rolls = [it.clockwise_deg if it else other for it, other in zip(shown, by_pose, strict=True)]
        rasters = rasters_of(_added(rolls, by_exif), counts)
        return search.angles_deg if are_alike(rasters, search.angles_deg) else rasters
    return search.angles_deg or rasters_of(_added(_rolls_by_priors(search, references), by_exif))


def _added(rolls_deg: Sequence[float | None], by_exif: Sequence[float]) -> list[float | None]:
    """The rolls of upright rasters by those of rasters as they are stored."""
    return [None if roll is None else roll + more for roll, more in zip(rolls_deg, by_exif, strict=True)]


def _rolls_by_priors(search: Search, references: Sequence[PosedView]) -> list[float | None]:
    """The rolls against references that a prior on pose or gravity shows, None where it does not."""
    pose, gravity = search.query.priors.pose, search.query.priors.gravity
    rolls: list[float | None] = []
    for it in references:
        reference_from_world = it.world_from_camera.rotation.T
        if search.query.can_be_tracked and pose is not None:
            rolls.append(roll_of_rotation(reference_from_world @ pose.world_from_camera.rotation))
        elif gravity is not None:
            rolls.append(roll_of_directions(gravity.in_camera, reference_from_world @ gravity.in_world))
        else:
            rolls.append(None)
    return rolls


def mirrored(search: Search, tier: Tier) -> Rejection | None:
    """The photograph's rejection, if its mirror image matches a reference clearly more than it does, not by chance.

    So it does if the photograph is mirrored, or shows another side of something symmetric: parts of the place that look
    like the mirror image of others would give it a wrong pose. The best of its references counts: others may not show
    the same.
    """
    material = search.material
    assert material is not None
    as_it_is = max(map(len, material.query_matches or ()), default=0)
    most, name = _most_matches(search, search.views.in_form(RasterForm((), tier.max_pixels, is_mirrored=True)), tier)
    chance = bdtrc(most - 1, most + as_it_is, 0.5) if most else 1.0
    if most >= PLACES.clearly_more * as_it_is and chance < MIRRORED_BY_CHANCE:
        return _mirrored(most, as_it_is, name)
    return None


def resembles_elsewhere(search: Search, found: Found, tier: Tier) -> bool:
    """Whether soft priors may have led to the wrong references, though the photograph was localized.

    The reference that resembles it most is then not where they say, and references elsewhere contradict the pose. If
    that cannot be found out, it is not, so that the answer that there is remains.
    """
    if not isinstance(found, Hypothesis) or not found.is_accepted or search.attempt.where is not Where.LIKELY:
        return False
    try:
        return _is_contradicted_elsewhere(search, found, tier)
    except Exception as error:
        if isinstance(error, Abandoned) or failure_of(error) is Failure.DEVICE_LOST:
            raise
        log.warning("references elsewhere could not be compared; the first answer is given", exc_info=error)
        return False


def _is_contradicted_elsewhere(search: Search, found: Hypothesis, tier: Tier) -> bool:
    material = search.material
    assert material is not None
    assert material.choice is not None
    others = _outside(search, material.choice, tier)
    if not others or others[0][1] > 0:
        return False
    with search.context.stage("correspond"):
        rivals = load_chosen(search, [name for name, _ in others[:OTHERS]], tier)[1]
        return is_contradicted(found, material.view, rivals, tier.pipeline.matcher)


def is_contradicted(found: Found, view: View, others: Sequence[PosedView], matcher: Matcher) -> bool:
    """Whether other references share much with the photograph that does not fit the pose of a hypothesis."""
    assert isinstance(found, Hypothesis)
    posed = PosedView("", "", view, found.world_from_camera)
    many = RIVAL_SHARE * max(found.answer.reference_match_counts)
    matches = zip(others, matcher.match_quickly(view, others), strict=True)
    return any((epipolar_distance_px(posed, it, pairs) >= EPIPOLAR_PX).sum() >= many for it, pairs in matches)


def _is_same_anywhere(search: Search, tier: Tier) -> bool:
    """Whether the references that were chosen where soft priors say are those that would be chosen anywhere."""
    material = search.material
    if material is None or material.choice is None or material.basis != search.attempt.basis.but(where=Where.LIKELY):
        return False
    return not _outside(search, material.choice, tier)


def _outside(search: Search, choice: Choice, tier: Tier) -> list[tuple[str, int]]:
    """Ids of references that resemble the photograph and were not chosen, with their rank among all."""
    inside = {it.reference_id for it in choice.references}
    with search.context.stage("retrieval"):
        assert search.material is not None
        alike = _shortlisted(search, search.material.views, search.query.narrowing.limits, tier).references
    return [(it.reference_id, rank) for rank, it in enumerate(alike) if it.reference_id not in inside]


def _named(search: Search, views: QueryViews, tier: Tier) -> Material:
    # References come first: a wrong name is found before the photograph is described.
    scene, references = _load(search, search.query.reference_ids, tier)
    attributes = attributes_of(search, scene)
    view = views.view(tier.extractor, search.context)
    return Material(search.attempt.basis, views, view, references, scene, attributes)


def _chosen(search: Search, views: QueryViews, tier: Tier, any_roll: int | None) -> Material:
    """Chooses, among the references that resemble the photograph most, those with the most matches."""
    query, context = search.query, search.context
    choice = _rolled_choice(search, any_roll) or _shortlisted(search, views, _narrowing_of(search), tier)
    scene, shortlist = load_chosen(search, [it.reference_id for it in choice.references], tier)
    attributes = attributes_of(search, scene)
    view = views.view(tier.extractor, context)

    def choose(indices: Sequence[int], match_counts: Sequence[int]) -> list[int]:
        centres = [shortlist[i].world_from_camera.translation for i in indices]
        return [indices[i] for i in spread_choice(match_counts, centres, query.reference_count)]

    with context.stage("shortlist"):
        matcher = tier.pipeline.matcher
        known = None if search.group is None else search.group.compared_with(view)
        matches = matcher.match_best(view, shortlist, query.reference_count, choose, context.check, known)
    chosen, query_matches = tuple(shortlist[i] for i in matches), tuple(matches.values())
    return Material(search.attempt.basis, views, view, chosen, scene, attributes, choice, query_matches)


def _rolled_choice(search: Search, any_roll: int | None) -> Choice | None:
    """The references chosen by what matches at any roll, for the photograph turned as it was found to be rolled."""
    attempt, by_others = search.attempt, zip(search.materials, search.found, strict=True)
    chosen = [
        material.choice
        for material, found in by_others
        if found.attempt.raster is Raster.AS_IS
        and found.attempt.features == any_roll
        and found.attempt.where is attempt.where
    ]
    return chosen[-1] if attempt.angles_deg and chosen else None


def _shortlisted(search: Search, views: QueryViews, narrowing: Narrowing, tier: Tier) -> Choice:
    """Chooses the shortlist of references within limits and likely values of the pose."""
    query = search.query
    selection = Selection(SHORTLIST * query.reference_count, narrowing, query.reference_ids, THINNED_LATER)
    return search.source.choose(query.scene_key, views, selection, search.context, tier.extractor)


def _load(search: Search, reference_ids: Sequence[str], tier: Tier) -> Loaded:
    """Loads references; SceneMadeAnew unless they are of the scene that the search's other references are of."""
    loaded = search.source.load(search.query.scene_key, reference_ids, tier.extractor, search.context)
    used = {it.scene.create_time_us for it in (search.material, *search.materials) if it is not None}
    if used - {loaded[0].create_time_us}:
        raise SceneMadeAnew
    return loaded


def _mirrored(most: int, not_mirrored: int, reference: str) -> Rejection:
    message = (
        "the photograph is mirrored, or shows another side of something symmetric: its mirror image has "
        f"{most} matches with a reference, as it is at most {not_mirrored}"
    )
    advice = (
        "Send the photograph as the camera took it: previews of front cameras and some videos exchange left and right "
        "(if so, the principal point is at width - 1 - x). If it is as taken, add references of this side."
    )
    return Rejection(RejectionReason.GATE, message, Hint(MIRROR, Advice.CHECK_CALIBRATION, advice, reference))


def _most_matches(search: Search, views: QueryViews, tier: Tier) -> tuple[int, str]:
    """Most matches of the photograph with one of the references that it resembles, or of those named; its name."""
    query = search.query
    with search.context.stage(MIRROR):
        view = views.view(tier.extractor, search.context)
    if query.chooses:
        chosen = _shortlisted(search, views, _narrowing_of(search), tier).references[:MIRROR_REFERENCES]
        references = load_chosen(search, [it.reference_id for it in chosen], tier)[1]
    else:
        references = _load(search, query.reference_ids, tier)[1]
    with search.context.stage(MIRROR):
        matches = tier.pipeline.matcher.match_quickly(view, references, search.context.check)
    counts = list(map(len, matches))
    best = max(range(len(counts)), key=counts.__getitem__, default=None)
    return (0, "") if best is None else (counts[best], references[best].name)
