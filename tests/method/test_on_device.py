"""The stages on the device against those on the host; none of them waits for a value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch", reason="the networks' extra is not installed")

import torch
from support.device import CASES, VARIANTS, Case, Watch, assert_same, case_of
from support.scenes import SceneOptions, random_for
from torch import Tensor

from mapless import geometry
from mapless.geometry import Array
from mapless_server.method.arrays import (
    AnyArray,
    median,
    normalize,
    normalize_jacobian,
)
from mapless_server.method.coarse.device import DeviceReconstruction
from mapless_server.method.correspond import Correspondences
from mapless_server.method.match import one_to_one as one_to_one_on_host
from mapless_server.method.on_device import match as device_match
from mapless_server.method.on_device import prepare
from mapless_server.method.on_device.compute import Inputs, Options, compute
from mapless_server.method.on_device.transfer import upload
from mapless_server.method.options import ScaleStrategy
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.scale_equations import ScaleOptions

# The host's results


@pytest.mark.parametrize(
    ("case", "variant"),
    [
        *((case, variant) for case in CASES for variant in ("full", "best")),
        *(("noise", variant) for variant in VARIANTS),
    ],
)
def test_every_variant_equals_the_hosts_result(case: str, variant: str) -> None:
    options = (ScaleOptions(), *VARIANTS[variant])
    assert_same(CASES[case].on_device(*options), CASES[case].on_host(*options))


@pytest.mark.parametrize("strategy", ScaleStrategy)
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_every_scale_strategy_equals_the_hosts_result(case: Case, strategy: ScaleStrategy) -> None:
    assert_same(case.on_device(ScaleOptions(strategy)), case.on_host(ScaleOptions(strategy)))


def test_options_of_the_scale_equal_the_hosts_result() -> None:
    case = CASES["noise"]
    for scale in (
        ScaleOptions(max_deviation=0.0),
        ScaleOptions(min_ratios=10_000),
        ScaleOptions(max_matches=50, inlier_distance_m=0.01),
        ScaleOptions(min_parallax_deg=8.0),
        ScaleOptions(max_pair_cameras=2),
    ):
        assert_same(case.on_device(scale), case.on_host(scale))


@pytest.mark.parametrize("variant", ["no_structure", "full", "best"])
def test_without_matches_the_result_is_the_hosts(variant: str) -> None:
    """No matches at all, between references, of the query, or no keypoints in it."""
    case = CASES["noise"]
    none = np.empty((0, 2), np.int32)
    pairs, matches = case.correspondences.reference_pairs, case.correspondences.query_matches
    features = case.scene.query.features
    blank = replace(
        case.scene.query,
        features=replace(
            features,
            keypoints=features.keypoints[:0],
            descriptors=features.descriptors[:0],
            sizes_px=features.sizes_px[:0],
        ),
    )
    unmatched = Correspondences(pairs, tuple(none for _ in matches))
    for changed in (
        replace(case, correspondences=Correspondences(dict.fromkeys(pairs, none), matches)),
        replace(case, correspondences=unmatched),
        replace(case, correspondences=unmatched, scene=replace(case.scene, query=blank)),
    ):
        scale = ScaleOptions(ScaleStrategy.TRAJECTORY)
        assert_same(changed.on_device(scale, *VARIANTS[variant]), changed.on_host(scale, *VARIANTS[variant]))


def test_a_search_in_chunks_equals_the_whole_search(monkeypatch: pytest.MonkeyPatch) -> None:
    case, scale = CASES["noise"], ScaleOptions()
    monkeypatch.setattr(device_match, "CHUNK_ELEMENTS", 5000)
    assert_same(case.on_device(scale, *VARIANTS["best"]), case.on_host(scale, *VARIANTS["best"]))


def test_one_to_one_equals_the_hosts() -> None:
    """Also among equal scores, of which votes have many."""
    random = random_for("one to one")
    for _ in range(50):
        keypoints, points = 8, 6
        pairs = np.unique(random.integers(0, (keypoints, points), (30, 2)), axis=0)[: random.integers(1, 25)]
        score = random.integers(1, 4, len(pairs)).astype(float)
        keypoint, point = one_to_one_on_host(pairs[:, 0], pairs[:, 1], score)
        group, candidate, of = (torch.from_numpy(array) for array in (pairs[:, 0], pairs[:, 1], score))
        best = device_match.best_by_group(group, candidate, of, keypoints, points)
        found = device_match.one_to_one(*best, points).numpy()
        np.testing.assert_array_equal(np.flatnonzero(found < keypoints), point)
        np.testing.assert_array_equal(found[point], keypoint)


# Nothing waits


def arguments_of(case: Case, variant: str) -> tuple[DeviceReconstruction, Inputs, Options]:
    options = Options(ScaleOptions(), *VARIANTS[variant])
    job = prepare(
        case.reconstruction.reference_cameras, case.scene.query, case.scene.references, case.correspondences, options
    )
    return case.reconstruction, job.inputs, options


@pytest.mark.parametrize("variant", ["coarse", "full", "best"])
def test_compute_stays_on_the_device_and_reads_no_value(variant: str) -> None:
    reconstruction, inputs, options = arguments_of(CASES["noise"], variant)
    meta = torch.device("meta")
    there = replace(
        reconstruction,
        point_maps=reconstruction.point_maps.to(meta),
        confidence=reconstruction.confidence.to(meta),
        local_from_camera=reconstruction.local_from_camera.to(meta),
    )
    uploaded = upload(inputs, meta)
    with Watch("meta") as watch:
        outputs = compute(there, uploaded, CASES["noise"].scene.query.camera, options)
    assert outputs.candidates.metres_per_unit.device == meta
    assert watch.launched.total() < 3500  # at a few microseconds each


# Rejections


def distant_case(baseline_m: float) -> Case:
    far = SceneOptions(point_count=50, box_m=(100.0, 60.0, 50.0), distance_m=150.0, reference_count=3)
    return case_of("distant", replace(far, baseline_m=baseline_m))


REJECTED: dict[str, tuple[Case, ScaleOptions]] = {
    "one place": (case_of("one place", SceneOptions(point_count=50, baseline_m=1e-3)), ScaleOptions()),
    "too close for the depth": (distant_case(0.2), ScaleOptions()),
    "few matches": (CASES["noise"], ScaleOptions(ScaleStrategy.TRIANGULATION, min_ratios=10_000)),
}


def without_references(case: Case, count: int) -> Case:
    scene, reconstruction = case.scene, case.reconstruction
    poses = reconstruction.local_from_camera
    return Case(
        replace(scene, references=scene.references[:count]),
        Correspondences({}, case.correspondences.query_matches[:count]),
        replace(
            reconstruction,
            reference_cameras=reconstruction.reference_cameras[:count],
            point_maps=reconstruction.point_maps[:count],
            confidence=reconstruction.confidence[:count],
            local_from_camera=torch.cat([poses[:count], poses[-1:]]),
        ),
    )


REJECTED["no reference"] = (without_references(CASES["noise"], 0), ScaleOptions())
REJECTED["one reference"] = (without_references(CASES["noise"], 1), ScaleOptions())


@pytest.mark.parametrize("variant", ["coarse", "full", "best"])
@pytest.mark.parametrize(("case", "scale"), REJECTED.values(), ids=REJECTED)
def test_rejections_equal_the_hosts(case: Case, scale: ScaleOptions, variant: str) -> None:
    expected = case.on_host(scale, *VARIANTS[variant])
    assert isinstance(expected, Rejection)
    assert case.on_device(scale, *VARIANTS[variant]) == expected


def test_poses_predicted_at_one_place_are_rejected_as_on_host() -> None:
    case = CASES["noise"]
    poses = case.reconstruction.local_from_camera.clone()
    poses[:, :3, 3] = 0
    case = replace(case, reconstruction=replace(case.reconstruction, local_from_camera=poses))
    for strategy in ScaleStrategy:
        for scale in (ScaleOptions(strategy), ScaleOptions(strategy, min_radius_per_depth=0.0)):
            expected = case.on_host(scale)
            if isinstance(expected, Rejection):
                assert case.on_device(scale, *VARIANTS["best"]) == expected
            else:
                assert_same(case.on_device(scale), expected)


Change = Callable[[Tensor, Tensor, Tensor], object]
"""Of points, confidences and poses."""


def broken(change: Change) -> DeviceReconstruction:
    """The reconstruction of a case after a change to copies of its tensors."""
    good = CASES["dense maps"].reconstruction
    points, confidence, poses = (t.clone() for t in (good.point_maps, good.confidence, good.local_from_camera))
    change(points, confidence, poses)
    return DeviceReconstruction(good.reference_cameras, good.query_camera, points, confidence, poses, "pi3")


BREAKS: dict[str, Change] = {
    "a pose": lambda points, confidence, poses: poses[1].fill_(torch.nan),
    "the query's pose": lambda points, confidence, poses: poses[-1, :3, 3].fill_(torch.inf),
    "all poses": lambda points, confidence, poses: poses.fill_(torch.nan),
    "one pixel": lambda points, confidence, poses: points[0, 5, 5, 2].fill_(torch.nan),
    "an infinite depth": lambda points, confidence, poses: points[1, 0, 0, 2].fill_(-torch.inf),
    "a pixel's x": lambda points, confidence, poses: points[1, 0, 0, 0].fill_(torch.nan),
    "all maps": lambda points, confidence, poses: points.fill_(torch.nan),
    "one confidence": lambda points, confidence, poses: confidence[0, 0, 0].fill_(torch.nan),
    "depths behind": lambda points, confidence, poses: points.neg_(),
    "everything": lambda points, confidence, poses: [t.fill_(torch.nan) for t in (points, confidence, poses)],
}


@pytest.mark.parametrize("variant", ["coarse", "best"])
@pytest.mark.parametrize("change", BREAKS.values(), ids=BREAKS)
def test_output_that_is_not_finite_is_rejected_and_logged(
    change: Change, variant: str, caplog: pytest.LogCaptureFixture
) -> None:
    case = replace(CASES["dense maps"], reconstruction=broken(change))
    found = case.on_device(ScaleOptions(), *VARIANTS[variant])
    assert isinstance(found, Rejection)
    assert found.reason is RejectionReason.SCALE_UNRELIABLE
    assert found.message.startswith("pi3: ")
    (record,) = caplog.records
    assert (record.levelname, record.getMessage()) == ("WARNING", found.message)


@pytest.mark.parametrize("name", ["a pose", "the query's pose", "all poses", "all maps", "depths behind", "everything"])
def test_messages_about_broken_output_equal_the_hosts(name: str) -> None:
    case = replace(CASES["dense maps"], reconstruction=broken(BREAKS[name]))
    expected, found = case.on_host(ScaleOptions()), case.on_device(ScaleOptions())
    assert isinstance(expected, Rejection)
    assert isinstance(found, Rejection)
    assert (found.reason, found.message.removeprefix("pi3: ")) == (expected.reason, expected.message)


def test_pixels_of_zero_confidence_are_not_broken() -> None:
    """A pixel of confidence 0 has no prediction."""
    assert CASES["noise"].reconstruction.point_maps.isnan().any()
    assert CASES["noise"].reconstruction.broken_pixels() == 0


# The reconstruction


# Functions of both kinds of arrays


KINDS: dict[str, Callable[[NDArray[np.generic]], AnyArray]] = {"numpy": lambda array: array, "torch": torch.from_numpy}
POINTS = np.concatenate([random_for("points").normal(size=(20, 3)), [[1.0, 2.0, 0.0], [1.0, 2.0, np.nan]]])

every_kind = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
Kind = Callable[[NDArray[np.generic]], AnyArray]


@every_kind
@pytest.mark.parametrize("size", [0, 1, 2, 7, 8])
def test_masked_median_is_that_of_the_chosen_values(kind: Kind, size: int) -> None:
    random = random_for("median", size)
    for chosen_count in range(size + 1):
        values, where = random.normal(size=size), random.permutation(size) < chosen_count
        expected = np.median(values[where]) if chosen_count else np.nan
        np.testing.assert_array_equal(np.asarray(median(kind(values), kind(where))), expected)


@every_kind
def test_projection_equals_the_clients(kind: Kind) -> None:
    """Also behind the camera, beside it and for NaN."""
    points = kind(POINTS)
    np.testing.assert_array_equal(np.asarray(normalize(points)), geometry.normalize(POINTS))
    expected: Array = geometry.normalize_jacobian(POINTS)
    np.testing.assert_allclose(np.asarray(normalize_jacobian(points)), expected, rtol=1e-15)
