"""Trust in the joint pose of a group, as in `judge`, from the evidence of all photographs together.

The photographs count as one camera with several images, mounted as the joint pose says: shares are computed from sums
over the photographs (that of matches on epipolar lines is a mean weighted by inliers), the covered parts of the
images are added, and halves of all matches, or of all references, give poses by generalized PnP. With one
photograph this is the evidence of `judge`, so that trust means the same for both. A photograph whose own pose is by
depths has evidence that needs no second reference: where its inliers agree with the joint pose, the trust in this is as
large at least.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform

from ..features.limits import MIN_INLIERS
from ..judge.evidence import (
    NO_AGREEMENT,
    PNP,
    SPLITS,
    Evidence,
    epipolar_share,
    expected_share,
    half_of_references,
    votes_of,
)
from ..judge.judge import JudgeOptions, low_trust, trust_of
from ..judge.references import Supporters, disagreeing_references, stated_px
from ..pose.generalized import CameraMatches, rig_ransac
from ..rejection import Rejection
from .images import PosedImage


def trust_of_group(matched: Sequence[PosedImage], coverage: float) -> tuple[float, Rejection | None]:
    """Computes the trust, 0 to 1, and a rejection GATE if it is less than 1 - coverage or the references do not agree.

    The photographs have joint poses, and together at least four inliers. The coverage is the share of right answers to
    accept, above 0 and at most 1.
    """
    evidence = _evidence_of([it.without_own_depth() for it in matched])
    by_depths = [it.source.own_trust for it in matched if it.keeps_own_answer()]
    trust = max(trust_of(evidence, JudgeOptions()), *by_depths, 0.0)
    return trust, disagreeing_references(supporters_of_group(matched)) or low_trust(evidence, trust, coverage)


def _evidence_of(matched: Sequence[PosedImage]) -> Evidence:
    """The evidence of all photographs together; the least there is with fewer than four inliers.

    Points at a photograph's own depth do not count.
    """
    sources = [it.source for it in matched]
    inliers, match_count = [int(it.inliers.sum()) for it in matched], sum(len(it.matches) for it in matched)
    if sum(inliers) < MIN_INLIERS:
        return Evidence(sum(inliers), match_count, 0.0, 0.0, 0.0, 0.0, NO_AGREEMENT, NO_AGREEMENT)
    findable = [it.findable_count() for it in matched]
    expected = [expected_share(it.structure, it.references) for it in sources]
    distance_m = _distance_m(matched)
    return Evidence(
        sum(inliers),
        match_count,
        min(1.0, sum(inliers) / max(1, sum(findable))),
        float(np.average(expected, weights=np.maximum(findable, 1))),
        min(1.0, sum(it.hull_share() for it in matched)),
        float(np.average([_epipolar_share(it) for it in matched], weights=np.maximum(inliers, 1))),
        _matches_apart(matched, distance_m),
        _references_apart(matched, distance_m),
    )


def supporters_of_group(matched: Sequence[PosedImage]) -> list[Supporters]:
    """The references that support the joint poses of photographs."""
    found, distance_m = [], _distance_m(matched)
    for it in matched:
        names, error_px = [r.name for r in it.source.references], it.source.reference_error_px
        stated = stated_px(it.source.references, distance_m)
        found.append(Supporters(names, it.inliers_by_reference(), error_px, stated))
    return found


def _distance_m(matched: Sequence[PosedImage]) -> float:
    """Median depth of the inliers in their photographs, metres."""
    depths = []
    for it in matched:
        points = it.source.structure.x_in_world[it.matches.point[it.inliers]]
        depths.append(it.world_from_camera.inverse().apply(points)[:, 2])
    return max(float(np.median(np.concatenate(depths))), np.finfo(float).tiny)


def _matches_apart(matched: Sequence[PosedImage], distance_m: float) -> float:
    """`evidence.disagreement_of_matches` for all photographs together."""
    seen = [it.matches.unguided().seen(it.source.query, it.source.structure.x_in_world) for it in matched]
    cameras = list(map(CameraMatches, seen, _mounting(matched)))

    def half(random: np.random.Generator) -> list[NDArray[np.bool_]]:
        return [np.asarray(random.permutation(len(it.seen)) % 2 == 0) for it in cameras]

    return _median_disagreement(cameras, half, distance_m, None)


def _references_apart(matched: Sequence[PosedImage], distance_m: float) -> float:
    """`evidence.disagreement_of_references` for all photographs; a reference is in the same half for all of them."""
    votes = [votes_of(it.source) for it in matched]
    cameras = list(map(CameraMatches, [it.seen for it in votes], _mounting(matched)))
    names: dict[str, int] = {}
    owners = []
    for it, its_votes in zip(matched, votes, strict=True):
        number = np.array([names.setdefault(r.key, len(names)) for r in it.source.references], np.intp)
        owners.append(number[its_votes.reference])
    counts = np.bincount(np.concatenate(owners), minlength=len(names))

    def half(random: np.random.Generator) -> list[NDArray[np.bool_]]:
        in_first = half_of_references(counts, random)
        return [np.asarray(in_first[it]) for it in owners]

    return _median_disagreement(cameras, half, distance_m, [it.keypoint for it in votes])


def _epipolar_share(matched: PosedImage) -> float:
    source = matched.source
    counts, pose = matched.inliers_by_reference(), matched.world_from_camera
    return epipolar_share(source.query, source.references, source.query_matches, counts, pose)


def _mounting(matched: Sequence[PosedImage]) -> list[RigidTransform]:
    """Pose of each camera in the frame of the last one."""
    last = matched[-1].world_from_camera.inverse()
    return [last.compose(it.world_from_camera) for it in matched]


def _median_disagreement(
    cameras: Sequence[CameraMatches],
    draw_half: Callable[[np.random.Generator], list[NDArray[np.bool_]]],
    distance_m: float,
    keypoints: Sequence[NDArray[np.intp]] | None,
) -> float:
    """Median over the splits of the distance between the two halves' poses, as a share of `distance_m`; at most 1."""
    random, apart = np.random.default_rng(0), []
    for _ in range(SPLITS):
        in_first = draw_half(random)
        centres: list[Array | None] = []
        for halves in (in_first, [~it for it in in_first]):
            rows = [np.flatnonzero(it) for it in halves]
            if keypoints is not None:
                rows = [r[np.unique(k[r], return_index=True)[1]] for r, k in zip(rows, keypoints, strict=True)]
            some = [it[r] for it, r in zip(cameras, rows, strict=True) if len(r)]
            pose = rig_ransac(some, PNP) if sum(map(len, rows)) >= MIN_INLIERS else None
            centres.append(None if pose is None else pose.translation)
        first, second = centres
        apart.append(NO_AGREEMENT if first is None or second is None else math.dist(first, second) / distance_m)
    return min(NO_AGREEMENT, float(np.median(apart)))
