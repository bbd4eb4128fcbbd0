"""Rigs of photographs whose points are by depths of a single reference, or their own: planted points and poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import random_for

from mapless.geometry import Array, Camera, RigidTransform, rotation_from_vector
from mapless_server.method.features.views import DepthSource, Features, KeypointDepths, PosedView, View
from mapless_server.method.groups.images import GroupImage
from mapless_server.method.groups.rig import RigEstimate, solve_rig
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.pairs.stationary import StationaryOptions
from mapless_server.method.pose.by_depths import Found, MatchedDepths, solve_by_depths
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.structure.match import MatchOptions
from mapless_server.method.structure.model import ScaleSource

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
COMMON = 0.02
DEPTH_SIGMA = 0.01
RIG = (RigidTransform.identity(), RigidTransform(rotation_from_vector([0.0, 0.1, 0.0]), np.array([0.2, 0.0, 0.0])))
MATCH = MatchOptions()


def view_at(pixels: Array, depths: KeypointDepths | None = None) -> View:
    count = len(pixels)
    descriptors = np.eye(128, dtype=np.float32)[np.arange(count) % 128]
    return View(CAMERA, Features(pixels.astype(np.float32), descriptors, np.full(count, 4, np.float32)), depths=depths)


def answered(
    random: np.random.Generator, world_from_query: RigidTransform, factor: float, own: bool, wrong: float = 0.0
) -> Answer:
    """A photograph's own answer by one reference at the origin, with depths of either, longer by a factor.

    `wrong` is the share of wrong matches.
    """
    pixels = random.uniform(10, [310, 230], (500, 2))
    rays = CAMERA.rays(pixels)
    x = rays / rays[:, 2:] * random.uniform(2, 6, (500, 1))
    in_query = world_from_query.inverse().apply(x)
    seen = CAMERA.project(in_query)
    both = np.flatnonzero(((seen > 0) & (seen < [319, 239])).all(axis=1) & (in_query[:, 2] > 0))[:120]
    z = (in_query if own else x)[both, 2] * factor * np.exp(DEPTH_SIGMA * random.normal(size=len(both)))
    sigma = np.full(len(both), DEPTH_SIGMA, np.float32)
    depths = KeypointDepths(z.astype(np.float32), sigma, COMMON, DepthSource.MEASURED)
    noise = [random.normal(0, 0.5, (len(both), 2)) for _ in range(2)]
    query = view_at(seen[both] + noise[0], depths if own else None)
    reference = PosedView("k", "r", view_at(pixels[both] + noise[1]), RigidTransform.identity())
    matches = np.repeat(np.arange(len(both), dtype=np.int32)[:, None], 2, axis=1)
    is_wrong = random.permutation(len(both))[: round(wrong * len(both))]
    matches[is_wrong, 1] = np.roll(matches[is_wrong, 1], 1)
    unknown = MatchedDepths(np.full(len(both), np.nan), None, 0.0)
    known = unknown if own else MatchedDepths(z, DEPTH_SIGMA, COMMON)
    found = solve_by_depths(query, [reference], [matches], [known], None, np.zeros(3), StationaryOptions())
    assert isinstance(found, Found), found
    localization = replace(Localization.of(found.support.estimate, 0.5), scale_source=ScaleSource.DEPTH)
    return Answer(localization, support=found.support)


@pytest.mark.parametrize("own", [True, False], ids=["depth of the photographs", "depth of the reference"])
def test_a_rig_is_posed_by_depths_within_honest_radii(own: bool) -> None:
    off, sigma = [], []
    for seed in range(8):
        random = random_for(seed)
        factor = float(np.exp(COMMON * random.normal()))
        step = random.normal(size=3) * [1, 0.5, 0.5]
        truth = RigidTransform(rotation_from_vector(random.normal(0, 0.1, 3)), 0.8 * step / np.linalg.norm(step))
        answers = [answered(random, truth.compose(it), factor, own) for it in RIG]
        found = solve_rig([GroupImage(it, MATCH) for it in answers], RIG)
        assert isinstance(found, RigEstimate), found
        assert found.trust == 0.5
        off.append(float(np.linalg.norm(found.world_from_rig.translation - truth.translation)))
        sigma.append(float(np.sqrt(np.trace(found.covariance[:3, :3]))))
    assert np.median(off) < 0.03
    assert np.mean(np.array(off) < 2 * np.array(sigma)) >= 0.75
    assert np.median(sigma) < 0.1


def test_wrong_matches_at_its_own_depth_are_no_inliers() -> None:
    truth = RigidTransform(np.eye(3), np.array([0.6, 0.2, 0.1]))
    answers = [answered(random_for(i), truth.compose(it), 1.0, True, wrong=0.7) for i, it in enumerate(RIG)]
    found = solve_rig([GroupImage(it, MATCH) for it in answers], RIG)
    assert isinstance(found, RigEstimate), found
    assert all(it.inliers.sum() <= 0.3 * 120 + 2 for it in found.matched)
    assert found.trust == 0.5, "that of the photographs' own answers"
    assert np.linalg.norm(found.world_from_rig.translation - truth.translation) < 0.05


def test_a_rejected_photographs_own_depth_gives_no_pose() -> None:
    """Neither does it add to the evidence of another photograph."""
    truth = RigidTransform(np.eye(3), np.array([0.6, 0.2, 0.1]))
    answers = [answered(random_for(i), truth.compose(it), 1.0, True, wrong=0.7) for i, it in enumerate(RIG)]
    refused = [replace(it, outcome=Rejection(RejectionReason.GATE, "too little")) for it in answers]
    assert isinstance(solve_rig([GroupImage(it, MATCH) for it in refused], RIG), Rejection)
    found = solve_rig([GroupImage(it, MATCH) for it in (answers[0], refused[1])], RIG)
    assert isinstance(found, RigEstimate), found
    assert [it.source.image for it in found.matched] == [0]


def test_a_pose_that_loses_an_answers_inliers_has_no_evidence_of_it() -> None:
    truth = RigidTransform(np.eye(3), np.array([0.6, 0.2, 0.1]))
    answer = answered(random_for(0), truth, 1.0, True)
    assert isinstance(answer.outcome, Localization)
    many = replace(answer, outcome=replace(answer.outcome, inlier_count=10 * answer.outcome.inlier_count))
    found = solve_rig([GroupImage(many, MATCH)], RIG[:1])
    assert isinstance(found, Rejection), found
    assert found.reason is RejectionReason.GATE
