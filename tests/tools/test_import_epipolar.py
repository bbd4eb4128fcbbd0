"""Matches that one fundamental matrix explains, and how far they are from satisfying given poses."""

from dataclasses import replace

import numpy as np
from support.scenes import SceneOptions, make_scene, random_for

from mapless_tools.ingest.check.errors import consistent_matches, pair_error_px, sampson_px


def test_a_moved_keypoints_error_is_its_displacement() -> None:
    """Sampson's distance is to first order how far both keypoints must move: one alone, moved, at most as far."""
    options = SceneOptions(noise_px=0.0, reference_count=2, distractor_count=0, seen_share=1.0)
    first, second = make_scene(random_for("sampson"), options).references
    matches = consistent_matches(first.view, second.view)
    assert len(matches) > 300
    assert sampson_px(first, second, matches).max() < 1e-3
    features = second.view.features
    keypoints = features.keypoints + np.array([0.0, 2.0], np.float32)  # across the lines, which are almost level
    moved = replace(second, view=replace(second.view, features=replace(features, keypoints=keypoints)))
    np.testing.assert_allclose(np.median(sampson_px(first, moved, matches)), 2 / np.sqrt(2), rtol=0.05)


def test_two_photographs_at_one_place_have_no_epipolar_error() -> None:
    first, second = make_scene(random_for("one place"), SceneOptions(reference_count=2)).references
    matches = consistent_matches(first.view, second.view)
    assert np.isnan(pair_error_px(first, replace(second, world_from_camera=first.world_from_camera), matches))
    assert np.isnan(pair_error_px(first, second, matches[:0]))
