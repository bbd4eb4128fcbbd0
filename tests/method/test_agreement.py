"""Halves of the data: a right pose is found again from each of them, a wrong one is not."""

from dataclasses import replace

import numpy as np
import pytest
from support.planted import true_correspondences, true_structure
from support.scenes import SceneOptions, SyntheticScene, make_scene, random_for

from mapless_server.method.pnp import PnpOptions, solve_pose
from mapless_server.method.results import PoseEstimate, Support
from mapless_server.method.trust import evidence
from mapless_server.method.trust.evidence import (
    NO_AGREEMENT,
    AgreementOptions,
    disagreement_of_matches,
    disagreement_of_references,
    votes_of,
)

OPTIONS = AgreementOptions()
DISTANCE_M = 4.0


def planted(case: object, **options: object) -> SyntheticScene:
    return make_scene(random_for("agreement", case), replace(SceneOptions(point_count=300), **options))  # type: ignore[arg-type]


def solved(scene: SyntheticScene) -> Support:
    structure, matches = true_structure(scene)
    estimate = solve_pose(scene.query, structure, matches, scene.world_from_query, PnpOptions())
    assert isinstance(estimate, PoseEstimate)
    return Support(scene.query, scene.references, structure, matches, estimate, np.zeros(3))


def both(scene: SyntheticScene, support: Support) -> tuple[float, float]:
    votes = votes_of(support, true_correspondences(scene).query_matches)
    return (
        disagreement_of_matches(support, DISTANCE_M, OPTIONS),
        disagreement_of_references(support, votes, DISTANCE_M, OPTIONS),
    )


@pytest.mark.parametrize("outlier_share", [0.0, 0.3])
def test_halves_of_a_right_pose_agree(outlier_share: float) -> None:
    for case in range(5):
        scene = planted(case, outlier_share=outlier_share)
        assert max(both(scene, solved(scene))) < 0.01


def test_small_motions_of_halves_are_those_of_ransac(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = [planted(case, outlier_share=0.3, noise_px=1.0) for case in range(5)]
    supports = [solved(scene) for scene in scenes]
    moved = [both(*it) for it in zip(scenes, supports, strict=True)]
    monkeypatch.setattr(evidence, "MAJORITY", 1.0)
    found = [both(*it) for it in zip(scenes, supports, strict=True)]
    assert moved != found
    np.testing.assert_allclose(moved, found, rtol=0.1, atol=2e-4)  # a thousandth counts as nothing


def test_a_line_of_points_does_not_say_that_halves_agree() -> None:
    scene = planted("line")
    support = solved(scene)
    along = np.linspace(0, 1, len(support.structure.x_in_world))[:, None]
    x_in_world = scene.world_from_query.apply(np.array([-1.0, 0, 4]) + along * np.array([2.0, 0, 1]))
    pixels = scene.query.camera.project(scene.world_from_query.inverse().apply(x_in_world)).astype(np.float32)
    keypoints = scene.query.features.keypoints.copy()
    keypoints[support.matches.keypoint] = pixels[support.matches.point]
    query = replace(scene.query, features=replace(scene.query.features, keypoints=keypoints))
    line = replace(support, query=query, structure=replace(support.structure, x_in_world=x_in_world))
    assert disagreement_of_matches(line, DISTANCE_M, OPTIONS) > 0.1


def test_halves_of_random_matches_disagree() -> None:
    scene = planted("random")
    support = solved(scene)
    shuffled = random_for("shuffled").permutation(support.matches.point)
    wrong = replace(support, matches=replace(support.matches, point=shuffled))
    assert disagreement_of_matches(wrong, DISTANCE_M, OPTIONS) > 0.1


def test_halves_of_references_with_wrong_poses_disagree() -> None:
    """Points seen by references of one half are where those references were moved to."""
    scene = planted("moved")
    support = solved(scene)
    votes = votes_of(support, true_correspondences(scene).query_matches)
    shift = np.array([1.0, 0.0, 0.0])
    moved = replace(votes, x_in_world=votes.x_in_world + np.where((votes.reference % 2 == 0)[:, None], shift, 0.0))
    assert disagreement_of_references(support, votes, DISTANCE_M, OPTIONS) < 0.01
    assert disagreement_of_references(support, moved, DISTANCE_M, OPTIONS) > 0.05


def test_fewer_matches_than_two_poses_need_give_none() -> None:
    scene = planted("few", point_count=60)
    support, few = solved(scene), slice(0, 6)
    matches = support.matches
    kept = replace(matches, point=matches.point[few], keypoint=matches.keypoint[few], guided=matches.guided[few])
    assert disagreement_of_matches(replace(support, matches=kept), DISTANCE_M, OPTIONS) == NO_AGREEMENT


def test_guided_matches_take_no_part_beside_others() -> None:
    scene = planted("guided")
    support = solved(scene)
    wrong = random_for("guided").permutation(support.matches.point)
    guided = np.arange(len(wrong)) % 3 > 0
    point = np.where(guided, wrong, support.matches.point)
    mixed = replace(support, matches=replace(support.matches, point=point, guided=guided))
    assert disagreement_of_matches(mixed, DISTANCE_M, OPTIONS) < 0.01
    only = replace(support, matches=replace(support.matches, guided=np.ones(len(wrong), bool)))
    assert disagreement_of_matches(only, DISTANCE_M, OPTIONS) < 0.01
