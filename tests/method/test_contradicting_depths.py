"""References with wrong poses where each is enough for a pose alone, by depths of either side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import SceneOptions, SyntheticScene, make_scene, random_for

from mapless.geometry import RigidTransform
from mapless_server.method.features.views import DepthSource, KeypointDepths, PosedView, View
from mapless_server.method.judge.answer import Localization
from mapless_server.method.judge.hypothesis import Attempt, Solver
from mapless_server.method.options import DoubtOptions, LocalizeOptions, StageContext
from mapless_server.method.pipeline import Coarse, Pipeline, Prepared, prepare, reconstruct
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.solve import solve

OFF_M = 0.8
ORDERS = [(0, 1, 2, 3), (2, 3, 0, 1), (1, 3, 0, 2)]
BY_DEPTHS = Attempt(solver=Solver.DEPTHS)
SIDES = pytest.mark.parametrize("own", [True, False], ids=["depth of the photograph", "depth of references"])


def depths_at(scene: SyntheticScene, pose: RigidTransform, points: np.ndarray) -> KeypointDepths:
    """The depths of a view's keypoints, with an error of a hundredth."""
    depth = pose.inverse().apply(scene.x_in_world[points])[:, 2]
    depth = np.where(points < 0, np.nan, depth * np.exp(random_for(1).normal(0, 0.01, len(points))))
    return KeypointDepths(depth.astype(np.float32), np.full(len(points), 0.01, np.float32), 0.02, DepthSource.MEASURED)


def given(seed: int, own: bool) -> tuple[SyntheticScene, View, list[PosedView]]:
    """A scene, its photograph and references; one side has depth."""
    scene = make_scene(random_for("contradicting", seed), SceneOptions(point_count=400, reference_count=4))
    if own:
        depths = depths_at(scene, scene.world_from_query, scene.query_points)
        return scene, replace(scene.query, depths=depths), list(scene.references)
    references = [
        replace(it, depths=depths_at(scene, it.world_from_camera, points))
        for it, points in zip(scene.references, scene.reference_points, strict=True)
    ]
    return scene, scene.query, references


def by_depths(query: View, references: list[PosedView]) -> Localization | Rejection:
    """The outcome of the rung from depths."""
    prepared = prepare(query, references, Pipeline(), LocalizeOptions(), StageContext())
    assert isinstance(prepared, Prepared)
    (coarse,) = reconstruct([prepared])
    assert isinstance(coarse, Coarse)
    return solve(coarse, BY_DEPTHS, DoubtOptions()).answer.outcome


@SIDES
@pytest.mark.parametrize("order", ORDERS)
def test_references_that_contradict_give_two_poses(own: bool, order: tuple[int, ...]) -> None:
    _, query, references = given(0, own)
    wrong = np.array([OFF_M, 0.0, 0.0])
    references[2:] = [replace(it, world_from_camera=it.world_from_camera.shifted(wrong)) for it in references[2:]]
    outcome = by_depths(query, [references[i] for i in order])
    assert isinstance(outcome, Rejection), outcome
    assert outcome.reason is RejectionReason.AMBIGUOUS
    centres = [it.world_from_camera.translation for it in outcome.hypotheses]
    assert np.linalg.norm(centres[0] - centres[1]) == pytest.approx(OFF_M, abs=0.1)


@SIDES
def test_references_that_agree_give_one_pose_in_any_order(own: bool) -> None:
    scene, query, references = given(0, own)
    for order in ORDERS:
        outcome = by_depths(query, [references[i] for i in order])
        assert isinstance(outcome, Localization), outcome
        assert np.linalg.norm(outcome.world_from_camera.translation - scene.world_from_query.translation) < 0.03
