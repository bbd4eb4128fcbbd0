"""What a single reference gives where a network predicts metric depths: errors, radii, and the quantiles of trust.

    python -m research.one_reference ../shared/data

No network runs: depths at a reference's keypoints are triangulated from other photographs of its place, and get an
error common to all of them and one of each. Prints errors and the share of radii that hold for each place, the share of
right and wrong poses accepted with the quantiles of all other places, and `OneReferenceOptions.scores`.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.correspond import Matcher, make_matcher
from mapless_server.method.observations import triangulate
from mapless_server.method.one_reference import Found, OneReferenceOptions, solve_one_reference, trust_of_score
from mapless_server.method.results import MetricScale
from mapless_server.method.scale import network_scale
from mapless_server.method.structure import StructureOptions, observe, refine_points, tracks_of
from mapless_server.method.tracks import Tracks
from mapless_server.method.trust.judge import LEVELS
from mapless_server.method.uncertainty.radii import accuracy_from_covariance
from mapless_server.method.views import PosedView, ReconstructedView, Reconstruction, View
from mapless_tools.evaluate.metrics import pose_error

from .places import KITCHEN, RIGHT_DEG, RIGHT_SHARE, Place, read_places, spread, weights_alike

NAMES = (
    *("fountain-P11", "herz-jesus-P8", KITCHEN, "tum-fr3-office", "kitti-drive-a", "meeting-room", "studio-flat"),
    *("fox-portrait", "euroc-v101-drone"),
)
QUERIES, NEIGHBOURS, LARGEST_TURN_DEG = 20, 6, 50.0
SCALE_SIGMA, DEPTH_SIGMA = 0.03, 0.05
COVERAGE = 0.97


@dataclass(frozen=True)
class Case:
    """A pose from one reference, and whether its position is within its radius of 68 %.

    `off` is the error of the position, as a share of the distance to what the reference shows; infinite for another
    place.
    """

    place: str
    score: float
    off: float
    off_deg: float
    holds: bool

    @property
    def right(self) -> bool:
        """Whether it is near enough to the truth."""
        return self.off < RIGHT_SHARE and self.off_deg < RIGHT_DEG


def near(place: Place, pose: RigidTransform, others: Sequence[int]) -> list[int]:
    """The nearest of some photographs that look in about the same direction."""
    alike = [
        i for i in others if pose.rotation[:, 2] @ place.poses[i].rotation[:, 2] > np.cos(np.deg2rad(LARGEST_TURN_DEG))
    ]
    return sorted(alike, key=lambda i: float(np.linalg.norm(place.poses[i].translation - pose.translation)))[
        :NEIGHBOURS
    ]


def shifted(references: Sequence[PosedView], origin: Array) -> tuple[PosedView, ...]:
    """In a world with another origin."""
    return tuple(replace(it, world_from_camera=it.world_from_camera.shifted(-origin)) for it in references)


def triangulated_depth(references: Sequence[PosedView], matcher: Matcher) -> Array | None:
    """Depth (N,) at the first one's keypoints, NaN where the others do not show it; None without any."""
    views, options = shifted(references, references[0].world_from_camera.translation), StructureOptions()
    nothing = [np.zeros((0, 2), np.int32)] * len(views)
    tracks = tracks_of(views, matcher.correspond(views[0].view, views, True, lambda: None, nothing), options)
    if not tracks.point_count:
        return None
    observations = observe(tracks, views, options.first_noise)
    refined = refine_points(observations, triangulate(observations), options)
    observed = refined.observations.tracks
    assert isinstance(observed, Tracks)
    left = observed.select(refined.trusted)
    seen = left.view == 0
    x = views[0].world_from_camera.inverse().apply(refined.x_in_world[refined.trusted][left.point[seen]])
    depth = np.full(len(views[0].view.features), np.nan)
    depth[left.keypoint[seen]] = x[:, 2]
    return depth


def predicted(
    reference: PosedView, query: View, world_from_query: RigidTransform, depth: Array, random: np.random.Generator
) -> Reconstruction:
    """What a network would predict, with errors."""
    camera, keypoints = reference.view.camera, reference.view.features.keypoints.astype(np.float64)
    scale, known = np.exp(SCALE_SIGMA * random.normal()), np.isfinite(depth)
    noisy = depth * scale * np.exp(DEPTH_SIGMA * random.normal(size=len(depth)))
    rays = camera.rays(keypoints)
    column, row = np.clip(np.rint(keypoints[known]).astype(int), 0, [camera.width_px - 1, camera.height_px - 1]).T
    points = np.full((camera.height_px, camera.width_px, 3), np.nan, np.float32)
    points[row, column] = (rays / rays[:, 2:] * noisy[:, None])[known]
    local = reference.world_from_camera.inverse().compose(world_from_query)
    moved = scale * local.translation + random.normal(0, 0.03 * float(np.nanmedian(depth)), 3)
    turned = rotation_from_vector(random.normal(0, 0.02, 3)) @ local.rotation
    nothing = np.full((2, 2, 3), np.nan, np.float32)
    of_query = ReconstructedView(query.camera, nothing, np.zeros((2, 2), np.float32), RigidTransform(turned, moved))
    identity = RigidTransform(np.eye(3), np.zeros(3))
    of_reference = ReconstructedView(camera, points, np.isfinite(points[..., 2]).astype(np.float32), identity)
    return Reconstruction(of_query, (of_reference,), SCALE_SIGMA)


def cases(place: Place, matcher: Matcher, random: np.random.Generator, other: Place | None = None) -> Iterator[Case]:
    """Poses of photographs of a place, or of another one, from one reference of this place each."""
    indices = sorted(place.views)
    for query in spread(sorted((other or place).views), QUERIES if other is None else NEIGHBOURS):
        own = [] if other else [query]
        chosen = indices if other else near(place, place.poses[query], [i for i in indices if i != query])
        if not chosen:
            continue
        index = chosen[random.integers(len(chosen))]
        around = near(place, place.poses[index], [i for i in indices if i not in (index, *own)])
        depth = triangulated_depth(place.posed([index, *around]), matcher) if len(around) > 1 else None
        if depth is None:
            continue
        origin = place.poses[index].translation
        (reference,) = shifted(place.posed([index]), origin)
        truth = reference.world_from_camera if other else place.poses[query].shifted(-origin)
        view = (other or place).views[query]
        found = solved(view, reference, predicted(reference, view, truth, depth, random), matcher)
        if found is None or found.support.estimate is None:
            continue
        pose, covariance = found.support.estimate.world_from_camera, found.support.estimate.covariance
        off, off_deg = (np.inf, np.inf) if other else pose_error(truth, pose)
        holds = off <= accuracy_from_covariance(covariance).position_68_m
        yield Case(place.name, found.score, off / float(np.nanmedian(depth)), off_deg, bool(holds))


def solved(query: View, reference: PosedView, reconstruction: Reconstruction, matcher: Matcher) -> Found | None:
    """The pose, accepted or not."""
    scale, matches = network_scale(reconstruction, reference), matcher.match_query(query, [reference], lambda: None)
    if not isinstance(scale, MetricScale):
        return None
    options = OneReferenceOptions()
    found = solve_one_reference(query, [reference], reconstruction, scale, matches, np.zeros(3), options)
    return found if isinstance(found, Found) else None


def quantiles(right: Sequence[Case]) -> tuple[float, ...]:
    """Of the scores at `LEVELS`; every place counts alike."""
    order = np.argsort([it.score for it in right])
    scores = np.array([it.score for it in right])[order]
    weights = weights_alike([it.place for it in right])[order]
    middle = np.cumsum(weights) - weights / 2
    found = np.interp(LEVELS, [0, *middle, 1], [scores[0], *scores, scores[-1]])
    return tuple(np.round(found, 1).tolist())


def main() -> None:
    """Prints everything."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    places = list(read_places(parser.parse_args().data, NAMES).values())
    matcher, random = make_matcher("sift", 1), np.random.default_rng(1)
    all_cases, in_other = list[Case](), list[Case]()
    for i, place in enumerate(places):
        made = list(cases(place, matcher, random))
        in_other += cases(place, matcher, random, places[(i + len(places) // 2) % len(places)])
        all_cases += made
        medians = (100 * np.median([it.off for it in made]), 100 * np.mean([it.holds for it in made]))
        print(f"{place.name}: {sum(it.right for it in made)} of {len(made)} right, off {medians[0]:.2f} %, "
              f"{medians[1]:.0f} % within the radius of 68 %", flush=True)  # fmt: skip
    for place in places:
        options = OneReferenceOptions(scores=quantiles([it for it in all_cases if it.right and it.place != place.name]))
        accepted = [
            it for it in all_cases if it.place == place.name and trust_of_score(it.score, options) >= 1 - COVERAGE
        ]
        right = sum(it.right for it in accepted)
        print(f"{place.name}: accepted {right} right, {len(accepted) - right} wrong")
    print(f"photographs of other places: {len(in_other)} poses")
    print(quantiles([it for it in all_cases if it.right]))


if __name__ == "__main__":
    main()
