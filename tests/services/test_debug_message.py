"""A pose's support in pixels of the photographs as sent, against a planted scene.

The points, put through the pose and the intrinsics as they were sent, fall on the pixels.
"""

from dataclasses import replace

import numpy as np
import pytest
from support.planted import true_structure
from support.scenes import CAMERA, SceneOptions, SyntheticScene, make_scene, random_for

from mapless.geometry import Array, Camera, RigidTransform, Similarity
from mapless.lenses import Fisheye, RadialTangential
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.method.bundle.estimate import PosedSupport, PoseEstimate, PoseStage, Support
from mapless_server.method.features.tracks import Tracks
from mapless_server.method.features.views import DepthSource, KeypointDepths, Photograph, PosedView, View
from mapless_server.method.pose.pnp import PnpOptions
from mapless_server.method.structure.model import DepthPlanes, MetricScale, ScaleStage
from mapless_server.services.messages.debug import MAX_MATCHES, debug_to_message

ORIGIN = np.array([4000.0, -200.0, 30.0])
SENT = CAMERA.resized(2400, 1800)
LENSES = {
    "pinhole": None,
    "radial": RadialTangential(-0.12, 0.03, 0.001, -0.002, 0.0),
    "fisheye": Fisheye(0.02, -0.01, 0.003, 0.0),
}


def sent(view: View, camera: Camera) -> View:
    """The same view, as what is left of a larger photograph by another lens."""

    def read() -> np.ndarray:
        raise AssertionError("the pixels are not needed")

    return replace(view, photograph=Photograph(str, camera, read))


def support_of(
    scene: SyntheticScene, camera: Camera, world_from_query: RigidTransform | None, wrong_count: int = 0
) -> Support:
    """The true matches of photographs of this camera, some of them mixed up."""
    structure, matches = true_structure(scene)
    mixed_up = np.concatenate([np.roll(matches.keypoint[:wrong_count], 1), matches.keypoint[wrong_count:]])
    matches = replace(matches, keypoint=mixed_up)
    query = sent(scene.query, camera)
    references = tuple(PosedView(r.key, r.name, sent(r.view, camera), r.world_from_camera) for r in scene.references)
    estimate = None
    if world_from_query is not None:
        errors = matches.seen(query, structure.x_in_world).errors_px(world_from_query)
        inliers = errors < PnpOptions().inlier_px
        estimate = PoseEstimate(world_from_query, PoseStage.REFINED, inliers, errors, np.eye(6))
    support = Support(query, references, structure, matches, ORIGIN)
    return support if estimate is None else support.posed(estimate)


def columns(*values: object) -> Array:
    return np.stack([np.array(v, float) for v in values], axis=1)


def query_px(debug: pb.Debug) -> Array:
    return columns(debug.query_x_px, debug.query_y_px)


def points_m(debug: pb.Debug) -> Array:
    return columns(debug.point_x_m, debug.point_y_m, debug.point_z_m)


@pytest.mark.parametrize("lens", LENSES)
def test_points_fall_on_pixels_of_the_photograph_as_sent(lens: str) -> None:
    scene = make_scene(random_for("debug", lens), SceneOptions(noise_px=0.0))
    camera = replace(SENT, distortion=LENSES[lens])
    debug = debug_to_message(support_of(scene, camera, scene.world_from_query))

    assert len(debug.query_x_px) > 300
    in_camera = scene.world_from_query.shifted(ORIGIN).inverse().apply(points_m(debug))
    np.testing.assert_allclose(camera.project(in_camera), query_px(debug), atol=2e-3)
    assert all(debug.is_inlier)
    assert max(debug.error_px) < 1e-3

    shown = columns(debug.reference_x_px, debug.reference_y_px)
    for number, reference in enumerate(scene.references):
        rows = np.array(debug.reference) == number
        pose = reference.world_from_camera.shifted(ORIGIN)
        np.testing.assert_allclose(camera.project(pose.inverse().apply(points_m(debug)[rows])), shown[rows], atol=2e-3)


def test_the_reported_error_is_that_in_the_reduced_photograph() -> None:
    scene = make_scene(random_for("debug errors"), SceneOptions(noise_px=0.8))
    debug = debug_to_message(support_of(scene, SENT, scene.world_from_query, wrong_count=100))
    projected = SENT.project(scene.world_from_query.shifted(ORIGIN).inverse().apply(points_m(debug)))
    reduced = np.linalg.norm(projected - query_px(debug), axis=1) * CAMERA.width_px / SENT.width_px
    np.testing.assert_allclose(reduced, debug.error_px, atol=1e-3)
    assert 90 <= len(reduced) - sum(debug.is_inlier) <= 100
    np.testing.assert_array_equal(np.array(debug.is_inlier), reduced < PnpOptions().inlier_px)


def test_each_point_is_shown_where_it_is_seen_best() -> None:
    scene = make_scene(random_for("debug best"), SceneOptions(noise_px=0.8))
    support = support_of(scene, CAMERA, scene.world_from_query)
    debug = debug_to_message(support)
    shown = columns(debug.reference_x_px, debug.reference_y_px)
    tracks = support.structure.tracks
    for row, point in enumerate(support.matches.point):
        errors = {}
        for view, keypoint in zip(
            tracks.view[tracks.point == point], tracks.keypoint[tracks.point == point], strict=True
        ):
            reference = scene.references[view]
            pixel = reference.view.features.keypoints[keypoint]
            x = reference.world_from_camera.inverse().apply(support.structure.x_in_world[point])
            errors[int(view)] = float(np.linalg.norm(CAMERA.project(x) - pixel)), pixel
        best = min(errors, key=lambda view: errors[view][0])
        assert debug.reference[row] == best
        np.testing.assert_allclose(shown[row], errors[best][1], atol=1e-3)


def test_without_a_pose_nothing_agrees_and_errors_are_unknown() -> None:
    scene = make_scene(random_for("debug none"))
    debug = debug_to_message(support_of(scene, SENT, None))
    assert len(debug.query_x_px) > 300
    assert not any(debug.is_inlier)
    assert np.isnan(debug.error_px).all()


def test_where_there_are_too_many_the_inliers_stay() -> None:
    scene = make_scene(random_for("debug many"), SceneOptions(point_count=4000, reference_count=3))
    support = support_of(scene, SENT, scene.world_from_query, wrong_count=1500)
    assert isinstance(support, PosedSupport)
    inliers = int(support.estimate.inliers.sum())
    debug = debug_to_message(support)
    assert inliers < MAX_MATCHES < len(support.matches)
    assert len(debug.query_x_px) == len(debug.reference) == len(debug.error_px) == MAX_MATCHES
    assert sum(debug.is_inlier) == inliers
    assert debug.ByteSize() < 130_000


def with_depths(support: Support, sources: list[DepthSource]) -> Support:
    """The references with depths of these sources, the last of which all others have."""
    given = [*sources, *sources[-1:] * len(support.references)]
    one = np.ones(1, np.float32)
    references = tuple(
        replace(it, depths=KeypointDepths(one, one, 0.02, source))
        for it, source in zip(support.references, given, strict=False)
    )
    return replace(support, references=references)


def seen_alone(support: Support, alone: np.ndarray, planes: DepthPlanes | None) -> Support:
    """The mask (P,) says which points only their first reference observes."""
    tracks = support.structure.tracks
    kept = ~alone[tracks.point]
    kept[tracks.starts] = True
    few = Tracks(tracks.point[kept], tracks.view[kept], tracks.keypoint[kept])
    return replace(support, structure=replace(support.structure, tracks=few, planes=planes))


def test_a_point_has_the_source_of_its_distance() -> None:
    """Every second point is seen by its first reference alone, with a depth: measured of the first, kept of others."""
    scene = make_scene(random_for("debug sources"))
    support = with_depths(support_of(scene, SENT, scene.world_from_query), [DepthSource.MEASURED, DepthSource.NETWORK])
    count, views = len(support.structure.x_in_world), support.structure.tracks.view[support.structure.tracks.starts]
    alone = np.arange(count) % 2 == 1
    planes = replace(DepthPlanes.unknown(count), information=np.ones(count), view=views)
    debug = debug_to_message(seen_alone(support, alone, planes))
    expected = np.where(views == 0, pb.POINT_SOURCE_MEASURED_DEPTH, pb.POINT_SOURCE_KEPT_DEPTH)
    expected = np.where(alone, expected, pb.POINT_SOURCE_TRIANGULATED)
    np.testing.assert_array_equal(debug.source, expected[support.matches.point])
    assert len(set(debug.source)) == 3


@pytest.mark.parametrize(
    ("stage", "kept", "source"),
    [
        (ScaleStage.DEPTH, DepthSource.MEASURED, pb.POINT_SOURCE_MEASURED_DEPTH),
        (ScaleStage.DEPTH, DepthSource.NETWORK, pb.POINT_SOURCE_KEPT_DEPTH),
        (ScaleStage.NETWORK, DepthSource.NETWORK, pb.POINT_SOURCE_NETWORK_DEPTH),
    ],
)
def test_points_by_depth_alone_have_its_source(stage: ScaleStage, kept: DepthSource, source: int) -> None:
    scene = make_scene(random_for("debug one reference"))
    nothing = Similarity(1.0, np.eye(3), np.zeros(3))
    scale = MetricScale(1.0, stage, 0.0, 0, nothing, scene.world_from_query, 0.05)
    support = with_depths(support_of(scene, SENT, scene.world_from_query), [kept])
    alone = seen_alone(support, np.ones(len(support.structure.x_in_world), bool), None)
    assert set(debug_to_message(alone, scale).source) == {source}


def test_points_at_the_photographs_own_depth_have_another_source() -> None:
    """Those of a reference's depth are near a plane."""
    scene = make_scene(random_for("debug own depth"))
    support = with_depths(support_of(scene, SENT, scene.world_from_query), [DepthSource.MEASURED])
    count = len(support.structure.x_in_world)
    has_plane = np.arange(count) % 2 == 1
    planes = replace(DepthPlanes.unknown(count), information=has_plane.astype(float))
    one = np.ones(1, np.float32)
    query = replace(support.query, depths=KeypointDepths(one, one, 0.02, DepthSource.MEASURED))
    debug = debug_to_message(replace(seen_alone(support, np.ones(count, bool), planes), query=query))
    expected = np.where(has_plane, pb.POINT_SOURCE_MEASURED_DEPTH, pb.POINT_SOURCE_PHOTOGRAPH_DEPTH)
    np.testing.assert_array_equal(debug.source, expected[support.matches.point])


def test_no_matches_make_an_empty_message() -> None:
    scene = make_scene(random_for("debug empty"))
    support = support_of(scene, SENT, None)
    nothing = np.empty(0, np.intp)
    empty = replace(support, matches=replace(support.matches, point=nothing, keypoint=nothing))
    assert debug_to_message(empty) == pb.Debug()
