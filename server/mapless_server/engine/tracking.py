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
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapless_server.method.bundle.estimate import PosedSupport
from mapless_server.method.coarse.geometric import GeometricReconstructor
from mapless_server.method.features.limits import EPIPOLAR_PX
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.judge.hypothesis import Doubt, Found, Hypothesis
from mapless_server.method.options import DoubtOptions
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pairs.epipolar import epipolar_distance_px
from mapless_server.scenes import Choice, RankedReference

from .query import Tier

MAX_PIXELS = 384 * 288
"""Size of the reduced photograph, for less processor time. Evidence: tracking."""

REFERENCES = 8
"""Largest number of references near the prior. Evidence: tracking."""

OTHERS = 2
"""References elsewhere that are compared."""

RIVAL_SHARE = 0.5
"""A reference elsewhere contradicts a pose by so many matches off their epipolar lines, as a share of the matches with
the best reference; as in `judge.judge`."""

_GEOMETRIC = GeometricReconstructor()


def tracking_tier(tier: Tier) -> Tier:
    """The tier with the backend that triangulates."""
    return replace(tier, pipeline=replace(tier.pipeline, reconstructor=_GEOMETRIC))


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
    return far[:OTHERS]


def is_contradicted(found: Found, view: View, others: Sequence[PosedView], matcher: Matcher) -> bool:
    """Whether other references share much with the photograph that does not fit the pose of a hypothesis."""
    assert isinstance(found, Hypothesis)
    posed = PosedView("", "", view, found.world_from_camera)
    many = RIVAL_SHARE * max(found.answer.reference_match_counts)
    matches = zip(others, matcher.match_quickly(view, others), strict=True)
    return any((epipolar_distance_px(posed, it, pairs) >= EPIPOLAR_PX).sum() >= many for it, pairs in matches)
