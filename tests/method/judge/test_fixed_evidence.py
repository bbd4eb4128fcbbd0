"""Matches that may be fixed to the camera are no evidence for a pose; the same view from the same place is."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import CAMERA, random_for

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.bundle.estimate import PosedSupport, PoseEstimate, PoseStage, Support
from mapless_server.method.features.tracks import Tracks
from mapless_server.method.features.views import Features, PosedView, View
from mapless_server.method.judge.references import moved_matches, unmoved_failure
from mapless_server.method.pairs.stationary import StationaryOptions, show_same_view, stationary_matches
from mapless_server.method.structure.model import PointMatches, Structure
from mapless_server.method.structure.observations import FIRST_GUESS

OPTIONS = StationaryOptions()
COUNT = 200


def view_of(keypoints: Array, scale: float = 1.0) -> View:
    n = len(keypoints)
    camera = CAMERA.resized(round(scale * CAMERA.width_px), round(scale * CAMERA.height_px))
    pixels = (keypoints + 0.5) * scale - 0.5
    return View(camera, Features(pixels.astype(np.float32), np.eye(n, dtype=np.float32), np.ones(n, np.float32)))


def posed(keypoints: Array, turn_deg: float = 0.0, scale: float = 1.0) -> PosedView:
    pose = RigidTransform(rotation_from_vector([0, np.radians(turn_deg), 0]), np.zeros(3))
    return PosedView(str(turn_deg), str(turn_deg), view_of(keypoints, scale), pose)


def pairs(n: int) -> NDArray[np.int32]:
    return np.repeat(np.arange(n, dtype=np.int32)[:, None], 2, axis=1)


def support_of(query: Array, seen: list[Array], matched: int) -> PosedSupport:
    """Every keypoint is an inlier on a point that all references see at the same index; so many match a reference."""
    n, references = len(query), tuple(posed(it, i) for i, it in enumerate(seen))
    point, view = np.repeat(np.arange(n), len(seen)), np.tile(np.arange(len(seen)), n)
    structure = Structure(np.zeros((n, 3)), Tracks(point, view, point), FIRST_GUESS)
    matches = PointMatches(np.arange(n), np.arange(n), np.zeros(n, bool), 0.0)
    pose = RigidTransform(np.eye(3), np.zeros(3))
    estimate = PoseEstimate(pose, PoseStage.REFINED, np.ones(n, bool), np.zeros(n), np.eye(6))
    of_query = tuple(pairs(matched) for _ in seen)
    return Support(view_of(query), references, structure, matches, np.zeros(3), of_query).posed(estimate)


def pixels(seed: str, size: tuple[float, float] = (960.0, 720.0), n: int = COUNT) -> Array:
    return np.asarray(random_for(seed).random((n, 2)) * size)


def test_matches_at_the_pixels_of_all_references_are_not_moved() -> None:
    badge, place = pixels("badge", (200, 150), 20), pixels("place", n=20)
    seen = [np.concatenate([badge, place + (30.0 * i, 0)]) for i in (1, 2)]
    support = support_of(np.concatenate([badge + 1.5, place]), seen, 40)
    np.testing.assert_array_equal(moved_matches(support, OPTIONS), np.repeat([False, True], 20))


def test_another_pixel_in_one_reference_is_evidence() -> None:
    place = pixels("place")
    support = support_of(place, [place, place + (30.0, 0)], 0)
    assert unmoved_failure(support, 12.0, OPTIONS) is None


@pytest.mark.parametrize("references", [1, 3])
def test_a_badge_alone_is_no_evidence_for_a_pose(references: int) -> None:
    badge, elsewhere = pixels("badge", (200, 150)), pixels("elsewhere")
    support = support_of(np.concatenate([badge, elsewhere]), [np.concatenate([badge, elsewhere])] * references, COUNT)
    others = [replace(it, view=view_of(np.concatenate([badge, pixels("place")]))) for it in support.references]
    support = replace(support, references=tuple(others), matches=support.matches.select(np.arange(2 * COUNT) < COUNT))
    assert support.estimate is not None
    support = replace(support, estimate=replace(support.estimate, inliers=np.ones(COUNT, bool)))
    failure = unmoved_failure(support, 12.0, OPTIONS)
    assert failure
    assert failure.startswith(f"{COUNT} matches are at the same pixels as in the references")


def test_a_photograph_at_the_pose_of_its_only_reference_is_evidence() -> None:
    place = pixels("place")
    assert unmoved_failure(support_of(place + 0.3, [place], COUNT), 12.0, OPTIONS) is None


def test_many_keypoints_in_a_corner_are_not_the_same_view() -> None:
    badge = pixels("badge", (200, 150), 900)
    first, second = (view_of(np.concatenate([badge, pixels(seed, n=100)])) for seed in ("here", "there"))
    assert not show_same_view(first, second, pairs(900), OPTIONS)


def test_few_keypoints_all_over_the_image_are_the_same_view() -> None:
    first = view_of(pixels("place", n=1000))
    some = np.arange(0, 1000, 4, dtype=np.int32)
    assert show_same_view(first, first, np.stack([some, some], axis=1), OPTIONS)


def test_photographs_of_different_sizes_share_pixels() -> None:
    badge = pixels("badge", (200, 150), 40)
    first, second = (
        posed(np.concatenate([badge, pixels(str(turn), n=200)]), turn, scale) for turn, scale in ((0, 1.0), (20, 0.5))
    )
    assert stationary_matches(first, second, pairs(40), OPTIONS).all()
