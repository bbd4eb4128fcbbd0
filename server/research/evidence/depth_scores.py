"""Poses from one reference with measured depth: scores of right ones, on places left out, and radii of wrong ones.

Pairs of photographs, half of the reference's depth visible, EdgePoint2 and SIFT; and photographs of other places.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapless.geometry import Array
from mapless_server.engine.query import Tier
from mapless_server.method.bundle.estimate import accuracy_from_covariance
from mapless_server.method.features.views import PosedView
from mapless_server.method.judge.judge import LEVELS, MAX_ONE_REFERENCE_RADIUS_SHARE
from mapless_server.method.pose.by_depths import Found, MatchedDepths, solve_by_depths
from mapless_server.serve.features import make_tiers
from mapless_server.settings import load_settings
from mapless_tools.ingest.formats.cameras import read_folder

from ..depth_places import CACHE, SCALES, SENSORS, DepthFrames, known, posed, with_cache
from ..depth_tables import WRONG_SHARE
from .page import Measurement, Row

FEATURES = ("edgepoint2-l64", "sift")
PAIRS, ELSEWHERE = 60, 30
LIMITS = (0.02, 0.03, 0.04, 0.05, 0.06, 0.08, np.inf)
COVERAGE = 0.95
ACCEPTED = 1 - COVERAGE


@dataclass(frozen=True)
class Posed:
    """A pose: of which place and features, its score, its 95 % radius and error by the distance; infinite elsewhere."""

    place: str
    features: str
    score: float
    radius: float
    error: float

    @property
    def is_right(self) -> bool:
        """Whether it is off by less than a wrong one."""
        return self.error < WRONG_SHARE


def poses(scenes: Path) -> Iterator[Posed]:
    """Those of all pairs that give one."""
    for features in FEATURES:
        tier = with_cache(make_tiers(load_settings({"features": features}).settings)[0], CACHE)
        frames = {p: [known(it, p) for it in read_folder(scenes / "depth" / p).frames] for p in SENSORS}
        references = {place: posed(place, its, tier) for place, its in frames.items()}
        for place, its in references.items():
            depths = DepthFrames(frames[place])
            for i, j in depths.pairs(PAIRS):
                yield from _posed(tier, features, place, its[i], its[j], depths.median_m(i))
            others = [it for other in references if other != place for it in references[other][:: len(its) // 4]]
            for k in range(ELSEWHERE):
                reference, query = its[3 * k % len(its)], others[k % len(others)]
                yield from _posed(tier, features, place, reference, query, 0.0)


def _posed(
    tier: Tier, features: str, place: str, reference: PosedView, query: PosedView, median_m: float
) -> Iterator[Posed]:
    (matches,) = tier.pipeline.matcher.correspond(query.view, [reference]).query_matches
    depths = reference.depths
    assert depths is not None
    sigma = float(np.nanmedian(depths.relative_sigma))
    matched = MatchedDepths(depths.depth[matches[:, 1]].astype(np.float64), sigma, depths.common_sigma)
    fixed = tier.pipeline.matcher.pairs.stationary
    found = solve_by_depths(query.view, [reference], [matches], [matched], None, np.zeros(3), fixed)
    if not isinstance(found, Found):
        return
    centre, error = reference.world_from_camera.translation, np.inf
    if median_m:
        step = SCALES.get(place, 1.0) * (found.support.estimate.world_from_camera.translation - centre)
        error = float(np.linalg.norm(centre + step - query.world_from_camera.translation)) / median_m
    radius = accuracy_from_covariance(found.own_covariance).position_95_m / found.support.distance_m()
    yield Posed(place, features, found.score, radius, error)


def by_place(found: Sequence[Posed]) -> Iterator[Row]:
    """For each place: what quantiles of the others would accept of it, and the quantiles themselves."""
    certain = [it for it in found if it.radius <= MAX_ONE_REFERENCE_RADIUS_SHARE]
    chosen = _hardest(found, list(SENSORS))
    for place in SENSORS:
        limit = np.interp(ACCEPTED, LEVELS, _hardest(found, [it for it in SENSORS if it != place]))
        its = [it for it in certain if it.place == place]
        yield {
            "place": place,
            "5 %, 50 % of right scores, EdgePoint2": _quantiles(found, place, FEATURES[0]),
            "SIFT": _quantiles(found, place, FEATURES[1]),
            "limit by the other places": f"{limit:.0f}",
            "right accepted by it": _accepted([it for it in its if it.is_right], float(limit)),
            "by all places": _accepted([it for it in its if it.is_right], float(np.interp(ACCEPTED, LEVELS, chosen))),
            "wrong": _accepted([it for it in its if not it.is_right], float(np.interp(ACCEPTED, LEVELS, chosen))),
            "largest score elsewhere": f"{max((it.score for it in its if np.isinf(it.error)), default=0):.0f}",
        }
    print("scores:", ", ".join(f"{it:.1f}" for it in chosen))


def by_radius(found: Sequence[Posed]) -> Iterator[Row]:
    """For each limit of the radius: right and wrong poses that it leaves, of those that the scores accept."""
    limit = float(np.interp(ACCEPTED, LEVELS, _hardest(found, list(SENSORS))))
    accepted = [it for it in found if it.score >= limit]
    for radius in LIMITS:
        kept = [it.is_right for it in accepted if it.radius <= radius]
        right = sum(it.is_right for it in accepted)
        yield {
            "95 % radius, share of the distance": f"{radius:g}",
            "right": f"{sum(kept)} of {right}",
            "wrong": f"{len(kept) - sum(kept)} of {len(accepted) - right}",
        }


def _hardest(found: Sequence[Posed], places: Sequence[str]) -> Array:
    """Quantiles, at `LEVELS`, of the right scores of the place where they are least; features count alike."""
    place = min(places, key=lambda p: float(np.median(_scores(found, p))))
    sets = [_scores(found, place, features) for features in FEATURES]
    scores, weights = np.concatenate(sets), np.concatenate([np.full(len(it), 1 / len(it)) for it in sets])
    order = np.argsort(scores)
    shares = np.cumsum(weights[order]) / weights.sum()
    return np.asarray(np.interp(LEVELS, [0.0, *shares], [scores.min(), *scores[order]]))


def _scores(found: Sequence[Posed], place: str, features: str = "") -> Array:
    return np.array([it.score for it in found if it.is_right and it.place == place and features in (it.features, "")])


def _quantiles(found: Sequence[Posed], place: str, features: str) -> str:
    low, middle = np.quantile(_scores(found, place, features), [ACCEPTED, 0.5])
    return f"{low:.0f}, {middle:.0f}"


def _accepted(found: Sequence[Posed], limit: float) -> str:
    return f"{sum(it.score >= limit for it in found)} of {len(found)}"


MEASUREMENTS = {
    "depth-scores": Measurement(lambda scenes: by_place(list(poses(scenes)))),
    "depth-radius": Measurement(lambda scenes: by_radius(list(poses(scenes)))),
}
