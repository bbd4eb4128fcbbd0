"""Tracking: a photograph whose pose prior says which references are near is localized by these, in less time.

A robot or a headset sends its previous answer, moved by its odometry, as the pose prior of each photograph. Then
nothing has to be found: the references near the prior are used, the same ones all around a place, so that what depends
on them alone is in the caches; the photograph is reduced; and the points are triangulated, whichever backend the server
has. If that leaves any doubt, the search follows as for any photograph, without what tracking has found.

Beyond its part in every answer the prior chooses the references, and nothing else. Matches are searched in the whole
photograph, which takes less time than to gather those near each point's projection, and leaves the evidence as it is:
matches that a wrong prior has selected agree with it. Gate, judge and checks are those of every answer. In one way a
prior could make a wrong answer likelier: the references near it may show a copy of what the photograph shows. So
references elsewhere that resemble the photograph, wherever the prior is, must not contradict the pose.
"""

import math

import numpy as np

from mapless_server.engine.photo_views import RasterForm
from mapless_server.engine.search import Material
from mapless_server.method import pipeline
from mapless_server.method.bundle.estimate import PosedSupport
from mapless_server.method.judge.hypothesis import Doubt, Found, Hypothesis
from mapless_server.method.options import DoubtOptions
from mapless_server.method.rejection import Rejection
from mapless_server.method.solve import solve
from mapless_server.scenes import Choice, RankedReference, Selection

from . import choosing
from .query import TRACK
from .search import Search
from .verdicts import Verdicts

MAX_PIXELS = 384 * 288
"""Size of the reduced photograph, for less processor time. Evidence: tracking."""

REFERENCES = 8
"""Largest number of references near the prior. Evidence: tracking."""


def doubts_of_tracked(found: Hypothesis, options: DoubtOptions) -> Doubt:
    """The doubts that a pose from references near the prior leaves beside those of any pose.

    It must agree with the priors, and have enough inliers that no initial pose has led to.
    """
    support = found.answer.support
    if not found.is_accepted or not isinstance(support, PosedSupport):
        return found.doubts | Doubt.CHANCE
    doubts = found.doubts
    if any(check.conflict for check in support.estimate.prior_checks):
        doubts |= Doubt.LIKE_ELSEWHERE
    alone = support.estimate.inliers & ~support.matches.guided
    return doubts | (Doubt.FEW_INLIERS if int(alone.sum()) < options.inliers else Doubt.NONE)


def elsewhere(near: Choice, alike: Choice) -> list[RankedReference]:
    """The first of the references that resemble the photograph and are further away than all those near the prior."""
    centres = np.stack([it.world_from_camera.translation for it in near.references])
    extent_m = float(np.linalg.norm(centres - centres[0], axis=1).max())
    far = [it for it in alike.references if math.dist(it.world_from_camera.translation, centres[0]) > extent_m]
    return far[: choosing.OTHERS]


def track(search: Search, verdicts: Verdicts) -> tuple[Search, Found] | None:
    """Localizes a photograph by the references near its pose prior, see above; None if that leaves any doubt."""
    query, context, prior = search.query, search.context, search.query.priors.pose
    assert prior is not None
    with context.stage(TRACK):
        selection = Selection(min(REFERENCES, query.reference_count), near=prior)
        near = search.source.choose(query.scene_key, search.views, selection, context)
    if len(near.references) < 2:
        return None
    tier, views = verdicts.tier(search.attempt), search.views.in_form(RasterForm(max_pixels=MAX_PIXELS))
    scene, references = choosing.load_chosen(search, [it.reference_id for it in near.references], tier)
    view, matcher = views.view(tier.extractor, context), tier.pipeline.matcher
    with context.stage("correspond"):
        matches = tuple(matcher.match_quickly(view, references, context.check))
    attributes = choosing.attributes_of(search, scene)
    material = Material(search.attempt.basis, views, view, references, scene, attributes, near, matches)
    search = search.but(material=material)
    given = view, references, verdicts.pipeline(search, tier)
    prepared = pipeline.prepare(*given, query.options, context, matches, query.priors)
    if isinstance(prepared, Rejection):
        return None
    (coarse,) = pipeline.reconstruct([prepared])
    if isinstance(coarse, Exception):
        raise coarse
    doubt = verdicts.doubt_in(search)
    found = verdicts.within_limits(search, solve(coarse, search.attempt, doubt))
    if not isinstance(found, Hypothesis) or doubts_of_tracked(found, doubt):
        return None
    selection = Selection(query.reference_count, query.narrowing.limits)
    alike = search.source.choose(query.scene_key, views, selection, context)
    others = [it.reference_id for it in elsewhere(near, alike)]
    with context.stage(TRACK):
        rivals = choosing.load_chosen(search, others, tier)[1] if others else ()
        is_contradicted = choosing.is_contradicted(found, view, rivals, matcher)
    return None if is_contradicted else (search, found)
