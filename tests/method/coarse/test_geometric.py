"""The geometric backend: reconstructs planted scenes like a network, and rejects what it cannot reconstruct."""

from dataclasses import replace

import numpy as np
from support.compare import assert_pose_close
from support.planted import true_correspondences
from support.scenes import SceneOptions, SyntheticScene, make_scene, random_for

from mapless.geometry import Similarity
from mapless_server.method.coarse import Request, Triangulation, reconstruct_one
from mapless_server.method.coarse.geometric import GeometricReconstructor, point_maps
from mapless_server.method.features.views import PosedView, Reconstruction, View
from mapless_server.method.pairs.correspond import Correspondences, Matcher
from mapless_server.method.rejection import Rejection, RejectionReason

EXACT = SceneOptions(noise_px=0.0, point_count=300, reference_count=4)


def reconstruct(scene: SyntheticScene, references: tuple[PosedView, ...] | None = None) -> Reconstruction:
    references = references or scene.references
    outcome = reconstruct_one(GeometricReconstructor(), scene.query, references, true_correspondences(scene))
    assert isinstance(outcome, Triangulation), outcome
    return point_maps(outcome, scene.query, references)


def rejection_of(query: View, references: tuple[PosedView, ...], correspondences: Correspondences) -> Rejection:
    outcome = reconstruct_one(GeometricReconstructor(), query, references, correspondences)
    assert isinstance(outcome, Rejection)
    return outcome


def world_from_local(scene: SyntheticScene, reconstruction: Reconstruction) -> Similarity:
    """From the first reference and the distance to the last."""
    local = [view.local_from_camera for view in reconstruction.references]
    world = [reference.world_from_camera for reference in scene.references]
    scale = float(
        np.linalg.norm(world[-1].translation - world[0].translation)
        / np.linalg.norm(local[-1].translation - local[0].translation)
    )
    rotation = world[0].rotation @ local[0].rotation.T
    return Similarity(scale, rotation, world[0].translation - scale * rotation @ local[0].translation)


def test_poses_and_depths_are_true_up_to_one_scale() -> None:
    scene = make_scene(random_for("truth"), EXACT)
    reconstruction = reconstruct(scene)
    similarity = world_from_local(scene, reconstruction)
    parts = [(reconstruction.query, scene.query, scene.query_points, scene.world_from_query)]
    parts += [
        (part, r.view, shown, r.world_from_camera)
        for part, r, shown in zip(reconstruction.references, scene.references, scene.reference_points, strict=True)
    ]
    for part, view, shown, world_from_camera in parts:
        assert_pose_close(
            similarity.transform_pose(part.local_from_camera), world_from_camera, metres=1e-4, degrees=1e-3
        )
        depth_m = similarity.scale * part.depth_at(view.features.keypoints, view.camera)
        known = np.isfinite(depth_m) & (shown >= 0)
        assert known.sum() > 0.8 * (shown >= 0).sum()
        true_m = world_from_camera.inverse().apply(scene.x_in_world[shown[known]])[:, 2]
        assert np.median(np.abs(depth_m[known] - true_m)) < 1e-4
        assert np.mean(np.abs(depth_m[known] - true_m) < 1e-3) > 0.97  # now and then two keypoints share a cell


def test_maps_are_nan_where_there_is_no_point() -> None:
    scene = make_scene(random_for("maps"), EXACT)
    reconstruction = reconstruct(scene)
    for part in (reconstruction.query, *reconstruction.references):
        assert part.point_map.shape == (360, 480, 3)
        assert part.point_map.dtype == part.confidence.dtype == np.float32
        known = np.isfinite(part.point_map).all(axis=2)
        np.testing.assert_array_equal(part.confidence, known.astype(np.float32))
        np.testing.assert_array_equal(np.isfinite(part.point_map).any(axis=2), known)
        assert 100 < known.sum() < 300
        assert (part.point_map[known][:, 2] > 0).all()


def test_wrong_matches_do_not_change_the_pose() -> None:
    scene = make_scene(random_for("outliers"), SceneOptions(outlier_share=0.4))
    outcome = reconstruct_one(
        GeometricReconstructor(), scene.query, scene.references, Matcher().correspond(scene.query, scene.references)
    )
    assert isinstance(outcome, Triangulation)
    assert_pose_close(outcome.world_from_query, scene.world_from_query, metres=0.02, degrees=0.2)


def test_queries_in_a_batch_equal_single_ones_and_fail_alone() -> None:
    scenes = [make_scene(random_for("together", seed), EXACT) for seed in range(2)]
    requests = [Request(it.query, it.references, true_correspondences(it)) for it in scenes]
    without = replace(requests[0], correspondences=None)
    first, failed, second = GeometricReconstructor().reconstruct_many([requests[0], without, requests[1]])
    assert isinstance(failed, ValueError)
    for outcome, scene in ((first, scenes[0]), (second, scenes[1])):
        assert isinstance(outcome, Triangulation)
        again = point_maps(outcome, scene.query, scene.references)
        np.testing.assert_array_equal(again.query.point_map, reconstruct(scene).query.point_map)


# Rejections


def test_references_without_common_points_are_rejected() -> None:
    scene = make_scene(random_for("share nothing"), EXACT)
    correspondences = true_correspondences(scene)
    alone = {pair: np.empty((0, 2), np.int32) for pair in correspondences.reference_pairs}
    rejection = rejection_of(scene.query, scene.references, replace(correspondences, reference_pairs=alone))
    assert rejection.reason is RejectionReason.NO_USABLE_REFERENCES


def test_a_query_without_matches_is_rejected_as_low_overlap() -> None:
    scene = make_scene(random_for("matches nothing"), EXACT)
    correspondences = true_correspondences(scene)
    for kept in (0, 1, 3):
        few = tuple(m[:kept] for m in correspondences.query_matches[:1])
        none = tuple(m[:0] for m in correspondences.query_matches[1:])
        rejection = rejection_of(scene.query, scene.references, replace(correspondences, query_matches=few + none))
        assert rejection.reason is RejectionReason.LOW_OVERLAP, kept
