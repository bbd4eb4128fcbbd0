"""Options check themselves: a value outside its bounds is named with its class, its field and the bound."""

from importlib import import_module
from typing import Any

import pytest

NAN = float("nan")
OUTSIDE: dict[str, list[tuple[str, Any]]] = {
    "method.options.DoubtOptions": [("trust", -1.0), ("radius_m", NAN), ("inliers", -1)],
    "method.bundle.pose_problem.AdjustOptions": [("max_error_px", 0.0), ("iterations", 0), ("loss_scale_sigma", -1.0)],
    "method.coarse.network.NetworkOptions": [("pixel_limit", 10)],
    "method.coarse.token_cache.TokenCacheOptions": [("device_bytes", -1)],
    "method.features.matching.CorrespondOptions": [("reference_ratio", 1.1), ("query_ratio", 0.0), ("epipolar_px", NAN)]
    + [("distinct_ratio", 2.0), ("guided_similarity", -2.0)],
    "method.features.extractors.options.LearnedOptions": [("max_keypoints", 0), ("max_side_px", 8), ("min_score", 1.0)]
    + [("min_score", NAN)],
    "method.features.extractors.sift.SiftOptions": [
        ("max_keypoints", 0),
        ("max_side_px", 8),
        ("contrast_threshold", NAN),
    ],
    "method.features.lightglue_options.LightGlueOptions": [
        ("min_score", 1.0),
        ("max_keypoints", 0),
        ("pairs_at_once", 0),
    ],
    "method.structure.match.MatchOptions": [("radius_px", -1.0), ("min_similarity", 2.0), ("radius_px", NAN)],
    "method.options.IntrinsicsSigma": [("focal_share", 0.0), ("principal_share", -1.0), ("k1", NAN), ("k1", 2.0)],
    "method.pose.pnp.PnpOptions": [("inlier_px", 0.0), ("inlier_px", NAN), ("min_iterations", 10**6)],
    "method.structure.structure.StructureOptions": [
        ("iterations", 0),
        ("loss_scale_sigma", 0.0),
        ("max_residual_sigma", -1.0),
    ]
    + [("min_parallax_deg", 90.0)],
    "method.judge.judge.JudgeOptions": [("scores", (1.0, 0.0) * 10), ("scores", (0.0,))],
    "method.pose.relative.RelativePoseOptions": [("strongest", 0)],
    "method.bundle.dispersion.UncertaintyOptions": [("region_factor", -0.1), ("rotation_factor", 0.0)]
    + [("max_matches", 0), ("position_factor", 0.0)],
    "scenes.retrieval.ranking.RankOptions": [("apart_m", -1.0), ("apart_deg", 181.0), ("nearby_weight", 1.5)]
    + [("nearby_weight", NAN), ("same_place_m", -1.0), ("per_place", 0), ("pool", 0), ("smallest_pool", 0)],
    "scenes.adoption.policy.AdoptionOptions": [
        ("min_matches", 0),
        ("min_novelty", 1.5),
        ("explained_share", 0.0),
        ("same_viewpoint_deg", NAN),
        ("contradicting_days", 0),
    ],
    "scheduling.admission.WorkQueueOptions": [("max_queued_s", 0.0), ("max_bytes", -1)],
}


@pytest.mark.parametrize(("name", "field", "value"), [(name, *it) for name, its in OUTSIDE.items() for it in its])
def test_an_option_outside_its_bounds_is_named(name: str, field: str, value: Any) -> None:
    module, _, kind = name.rpartition(".")
    if kind in ("LearnedOptions", "LightGlueOptions", "NetworkOptions"):
        pytest.importorskip("torch", reason="the networks' extra is not installed")
    options = getattr(import_module(f"mapless_server.{module}"), kind)
    with pytest.raises(ValueError, match=rf"{kind}\.{field} must be") as caught:
        options(**{field: value})
    assert str(caught.value).endswith(f", is {value}")
