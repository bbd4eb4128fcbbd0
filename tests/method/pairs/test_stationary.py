"""Keypoints fixed to the camera are found between references with different poses; those that poses predict are not."""

from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import CAMERA, SceneOptions, look_at, make_scene, random_for, unit_rows

from mapless.geometry import Array, Camera, RigidTransform, rotation_from_vector
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.features.matching import mutual_matches
from mapless_server.method.features.views import Features, PosedView, View
from mapless_server.method.judge.answer import Localization
from mapless_server.method.localize import localize
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pairs.pair import PairMatches
from mapless_server.method.pairs.stationary import (
    IgnoredKeypoints,
    StationaryOptions,
    distance_from_explained_px,
    stationary_matches,
)
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.rejection import Rejection
from mapless_tools.dataset import Frame
from mapless_tools.ingest.formats.cameras import read_folder
from research.evidence.overlays import OVERLAYS, Image, Overlay
from research.evidence.stationary import ROOM
from research.rendered_room.photographs import REFERENCE_CAMERA

BADGE_PX = np.array([240.0, 160.0])
"""Size of a badge in the upper left corner."""


def view_of(keypoints: Array, descriptors: Array | None = None) -> View:
    n = len(keypoints)
    descriptors = np.eye(n, max(n, 2)) if descriptors is None else descriptors
    features = Features(keypoints.astype(np.float32), descriptors.astype(np.float32), np.ones(n, np.float32))
    return View(CAMERA, features)


def posed(name: str, pose: RigidTransform, keypoints: Array, descriptors: Array | None = None) -> PosedView:
    return PosedView(name, name, view_of(keypoints, descriptors), pose)


def all_matches(n: int) -> NDArray[np.int32]:
    return np.repeat(np.arange(n, dtype=np.int32)[:, None], 2, axis=1)


def with_badge(view: View, random: np.random.Generator, count: int = 120, noise_px: float = 0.2) -> View:
    """The same photograph with a badge: its own keypoints there are covered."""
    planted = random_for("badge")
    keypoints = planted.random((count, 2)) * BADGE_PX
    descriptors = unit_rows(planted.standard_normal((count, view.features.descriptors.shape[1])))
    seen = view.features
    free = (seen.keypoints > BADGE_PX).any(axis=1)
    noise = unit_rows(random.standard_normal(descriptors.shape)) * 0.2
    features = Features(
        np.concatenate([seen.keypoints[free], keypoints + random.normal(0, noise_px, (count, 2))]).astype(np.float32),
        np.concatenate([seen.unit_descriptors()[free], unit_rows(descriptors + noise)]).astype(np.float32),
        np.ones(int(free.sum()) + count, np.float32),
    )
    return replace(view, features=features)


@pytest.mark.parametrize("case", range(6))
def test_distance_is_that_to_the_nearest_pixel_of_any_depth(case: int) -> None:
    random = random_for("explained", case)
    first = posed("a", RigidTransform(np.eye(3), np.zeros(3)), np.zeros((1, 2)))
    turn = rotation_from_vector(random.normal(0, [0.02, 0.3, 1.5][case % 3], 3))
    second = posed("b", RigidTransform(turn, random.normal(0, 1.0, 3)), np.zeros((1, 2)))
    pixels, others = random.random((2, 50, 2)) * (960, 720)
    inverse_depth = np.concatenate([[0.0], np.geomspace(1e-5, 1e5, 40_000)])
    for pixel, other, found in zip(
        pixels, others, distance_from_explained_px(first, second, pixels, others), strict=True
    ):
        ray = CAMERA.rays(pixel[None])[0]
        # Homogeneous: the point at 1 / inverse_depth along the ray.
        in_second = (ray - inverse_depth[:, None] * second.world_from_camera.translation) @ turn
        ahead = in_second[:, 2] > 1e-9
        seen = CAMERA.project(in_second[ahead])
        expected = np.linalg.norm(seen - other, axis=1).min() if ahead.any() else np.inf
        assert found == pytest.approx(expected, abs=0.5, rel=0.01)


def test_far_points_of_a_drive_are_no_evidence() -> None:
    random = random_for("drive")
    ahead = RigidTransform(np.eye(3), np.array([0.0, 0.0, 2.0]))
    x_in_world = np.concatenate(
        [
            random.uniform([-900, -300, 1500], [900, 300, 3000], (60, 3)),
            random.uniform([-1, -1, 60], [1, 1, 90], (60, 3)),
        ]
    )
    first = posed("a", RigidTransform(np.eye(3), np.zeros(3)), CAMERA.project(x_in_world))
    second = posed("b", ahead, CAMERA.project(ahead.inverse().apply(x_in_world)))
    moved = np.linalg.norm(first.view.features.keypoints - second.view.features.keypoints, axis=1)
    assert (moved < 1).sum() > 60
    assert not stationary_matches(first, second, all_matches(120), StationaryOptions()).any()


def test_a_bonnet_is_found_where_a_drive_turns() -> None:
    pixels = random_for("bonnet").random((40, 2)) * (900, 100) + (30, 600)
    straight = posed("a", RigidTransform(np.eye(3), np.zeros(3)), pixels)
    turned = posed("b", RigidTransform(rotation_from_vector([0, np.radians(3), 0]), np.array([0.1, 0, 2.0])), pixels)
    found = stationary_matches(straight, turned, all_matches(40), StationaryOptions(same_view_share=1))
    assert found.mean() > 0.9


@pytest.mark.parametrize("turn_deg", [0.0, 0.1])
def test_a_camera_that_stands_still_is_no_evidence(turn_deg: float) -> None:
    pixels = random_for("still").random((80, 2)) * (960, 720)
    poses = [RigidTransform(rotation_from_vector([0, a, 0]), np.zeros(3)) for a in (0.0, np.radians(turn_deg))]
    first, second = (posed(str(i), pose, pixels) for i, pose in enumerate(poses))
    assert not stationary_matches(first, second, all_matches(80), StationaryOptions(same_view_share=1)).any()


def test_one_view_at_two_poses_is_no_evidence() -> None:
    pixels = random_for("tracker drifts").random((80, 2)) * (960, 720)
    first = posed("a", RigidTransform(np.eye(3), np.zeros(3)), pixels)
    second = posed("b", RigidTransform(rotation_from_vector([0.1, 0.2, 0]), np.ones(3)), pixels)
    assert not stationary_matches(first, second, all_matches(80), StationaryOptions()).any()


def test_keypoints_beside_fixed_ones_are_ignored_too() -> None:
    line = np.stack([np.arange(100.0, 300.0, 8.0), np.full(25, 650.0)], axis=1)
    beside, far = line + (4.0, 6.0), line - (0.0, 60.0)
    poses = [RigidTransform(rotation_from_vector([0, 0.4 * i, 0]), np.zeros(3)) for i in range(3)]
    references = [posed(str(i), pose, np.concatenate([line, beside, far])) for i, pose in enumerate(poses)]
    matches = {pair: all_matches(25) for pair in combinations(range(3), 2)}
    ignored = IgnoredKeypoints(references, matches, StationaryOptions())
    np.testing.assert_array_equal(ignored.of(references[0].view), np.repeat([True, True, False], 25))
    other = replace(references[0].view, camera=replace(CAMERA, focal_x_px=900.0, focal_y_px=900.0))
    assert not ignored.of(other).any()


def test_two_single_matches_are_no_evidence() -> None:
    pixels = np.array([[100.0, 100.0], [500.0, 400.0]])
    references = [posed(str(i), look_at([i, 0.0, -4.0], [0.0, 0.0, 0.0]), pixels) for i in range(2)]
    assert not IgnoredKeypoints(references, {(0, 1): all_matches(2)}, StationaryOptions())


def test_a_pair_is_separated_as_it_was_made() -> None:
    random = random_for("separated")
    scene = make_scene(random)
    first, second = (replace(it, view=with_badge(it.view, random)) for it in (scene.references[0], scene.references[5]))
    matcher = Matcher()
    stored = matcher.pairs.make(first, second)
    parts = PairMatches.of(first, second, stored, matcher.pairs.stationary)
    np.testing.assert_array_equal(parts.all, stored)
    np.testing.assert_array_equal(parts.agreeing, matcher.pairs.match(first, second))
    every = mutual_matches(first.view.features, second.view.features, matcher.options.reference_ratio, True)
    badge = (first.view.features.keypoints[every[:, 0]] <= BADGE_PX).all(axis=1)
    assert len(parts.stationary) > 0.8 * badge.sum() > 50


def ask(query: View, references: list[PosedView], options: StationaryOptions) -> Localization | Rejection:
    pipeline = Pipeline()
    pipeline.matcher.pairs.stationary = options
    return localize(query, references, pipeline, LocalizeOptions()).outcome


class TestBadge:
    """References that all carry a badge."""

    references: list[PosedView]

    @pytest.fixture(autouse=True)
    def scene(self) -> None:
        random = random_for("a badge on all")
        self.planted = make_scene(random, SceneOptions(reference_count=8))
        self.references = [replace(it, view=with_badge(it.view, random)) for it in self.planted.references]

    def test_a_photograph_of_the_place_is_localized(self) -> None:
        query = with_badge(self.planted.query, random_for("of the place"))
        outcome = ask(query, self.references, StationaryOptions())
        assert isinstance(outcome, Localization)
        apart = outcome.world_from_camera.translation - self.planted.world_from_query.translation
        assert np.linalg.norm(apart) < 0.02

    def test_at_the_pose_of_a_reference_too(self) -> None:
        random = random_for("the same pose")
        again = with_badge(self.references[3].view, random)
        noisy = again.features.keypoints + random.normal(0, 0.3, again.features.keypoints.shape)
        again = replace(again, features=replace(again.features, keypoints=noisy.astype(np.float32)))
        outcome = ask(again, self.references, StationaryOptions())
        assert isinstance(outcome, Localization)
        apart = outcome.world_from_camera.translation - self.references[3].world_from_camera.translation
        assert np.linalg.norm(apart) < 0.02


SIZE = 480, 360


@pytest.fixture(scope="module", params=["badge", "time stamp"])
def carried(request: pytest.FixtureRequest) -> Overlay:
    """A picture on all photographs of the demo's room; a time stamp is another one in each."""
    return OVERLAYS[request.param]


@pytest.fixture(scope="module")
def room(carried: Overlay) -> list[PosedView]:
    """References in the demo's room with an overlay."""
    frames = [it for it in read_folder(ROOM).frames if "reference" in it.name][::2]
    return [
        PosedView(it.name, it.name, photographed(image_of(it), it.camera, carried, i), it.world_from_camera)
        for i, it in enumerate(frames)
    ]


def image_of(frame: Frame) -> Image:
    return decode_image(frame.image_path.read_bytes(), ImageLimits())


def photographed(image: Image, camera: Camera, carried: Overlay, number: int) -> View:
    return SiftExtractor().extract(
        carried(np.asarray(cv2.resize(image, SIZE), np.uint8), number)[0], camera.resized(*SIZE)
    )


@pytest.mark.parametrize("case", range(2))
def test_elsewhere_with_the_same_overlay_is_not_localized(room: list[PosedView], carried: Overlay, case: int) -> None:
    shapes = random_for("shapes", case).integers(0, 256, (24, 32, 3)).astype(np.uint8)
    image = np.asarray(cv2.resize(shapes, SIZE, interpolation=cv2.INTER_NEAREST), np.uint8)
    query = photographed(image, REFERENCE_CAMERA, carried, 100 + case)
    assert isinstance(ask(query, room, StationaryOptions()), Rejection)


def test_the_place_itself_is_localized_beside_it(room: list[PosedView], carried: Overlay) -> None:
    frame = next(it for it in read_folder(ROOM).frames if "query" in it.name)
    outcome = ask(photographed(image_of(frame), frame.camera, carried, 100), room, StationaryOptions())
    assert isinstance(outcome, Localization)
    apart = outcome.world_from_camera.translation - frame.world_from_camera.translation
    assert np.linalg.norm(apart) < 0.05
