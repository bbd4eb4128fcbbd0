"""Reconstructions on a device, the stages there and on the host, and what can be seen of the work."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from mapless.geometry import Array
from mapless_server.method.coarse.device import DeviceReconstruction
from mapless_server.method.correspond import Correspondences
from mapless_server.method.match import PAPER_MATCH, MatchOptions, match_points
from mapless_server.method.on_device import Refined, launch_on_device
from mapless_server.method.on_device.compute import Options
from mapless_server.method.rejection import Rejection
from mapless_server.method.results import MetricScale, PointMatches, Structure
from mapless_server.method.scale import estimate_scale
from mapless_server.method.scale_equations import ScaleOptions
from mapless_server.method.structure import PAPER_STRUCTURE, StructureOptions, build_structure
from mapless_server.method.views import Matches, Reconstruction
from support.fake_network import FakeNetwork, FakeNetworkOptions
from support.planted import true_correspondences
from support.scenes import SceneOptions, SyntheticScene, make_scene, random_for, unit_rows

VARIANTS: dict[str, tuple[StructureOptions | None, MatchOptions | None]] = {
    "coarse": (None, None),
    "no_structure": (replace(PAPER_STRUCTURE, optimize=False), PAPER_MATCH),
    "full": (PAPER_STRUCTURE, PAPER_MATCH),
    "best": (StructureOptions(), MatchOptions()),
    "best without a limit": (StructureOptions(max_residual_sigma=None), MatchOptions(radius_px=15.0)),
}


def on_device(reconstruction: Reconstruction, backend: str = "fake") -> DeviceReconstruction:
    """The same as tensors, as a network would leave it."""
    views = (*reconstruction.references, reconstruction.query)
    return DeviceReconstruction(
        tuple(view.camera for view in reconstruction.references),
        reconstruction.query.camera,
        torch.from_numpy(np.stack([view.point_map for view in reconstruction.references])),
        torch.from_numpy(np.stack([view.confidence for view in reconstruction.references])),
        torch.from_numpy(np.stack([view.local_from_camera.matrix() for view in views]).astype(np.float32)),
        backend,
    )


@dataclass(frozen=True, eq=False)
class Case:
    """A scene, what is matched in it, and what a network says of it."""

    scene: SyntheticScene
    correspondences: Correspondences
    reconstruction: DeviceReconstruction

    def on_device(
        self, scale: ScaleOptions, structure: StructureOptions | None = None, match: MatchOptions | None = None
    ) -> Refined | Rejection:
        scene, options = self.scene, Options(scale, structure, match)
        return launch_on_device(self.reconstruction, scene.query, scene.references, self.correspondences, options)()

    def on_host(
        self, scale_options: ScaleOptions, structure: StructureOptions | None = None, match: MatchOptions | None = None
    ) -> Refined | Rejection:
        scene, correspondences, reconstruction = self.scene, self.correspondences, self.reconstruction.fetch()
        scale = estimate_scale(reconstruction, scene.references, correspondences, scale_options)
        if isinstance(scale, Rejection) or structure is None or match is None:
            return scale if isinstance(scale, Rejection) else Refined(scale, None, None)
        points = build_structure(reconstruction, scale, scene.references, correspondences, structure)
        pose = scale.world_from_query
        return Refined(scale, points, match_points(scene.query, scene.references, points, correspondences, pose, match))


def case_of(name: str, scene: SceneOptions | None = None, network: FakeNetworkOptions | None = None) -> Case:
    """A case with small maps, in which a fifth of the matches is wrong."""
    made = make_scene(random_for("on device", name), scene or SceneOptions(point_count=150, reference_count=4))
    small = replace(network or FakeNetworkOptions(), map_width_px=96, map_height_px=72)
    predicted = FakeNetwork(made, 0, small).reconstruct(made.query, made.references)
    return Case(made, spoilt(true_correspondences(made), name), on_device(predicted))


def spoilt(true: Correspondences, name: str) -> Correspondences:
    random = random_for("spoilt", name)

    def spoil(matches: Matches) -> Matches:
        wrong = random.random(len(matches)) < 0.2
        matches = matches.copy()
        matches[wrong, 1] = random.permutation(matches[wrong, 1])
        return matches[random.random(len(matches)) < 0.8]

    pairs = {pair: spoil(matches) for pair, matches in true.reference_pairs.items()}
    return Correspondences(pairs, tuple(spoil(matches) for matches in true.query_matches))


CASES = {
    "noise": case_of("noise", None, FakeNetworkOptions(0.02, pose_noise_m=0.005, pose_noise_deg=0.1)),
    "dense maps": case_of("dense maps", None, FakeNetworkOptions(dense=True)),
    "the trajectory wins": case_of(
        "trajectory",
        SceneOptions(point_count=150, reference_count=6),
        FakeNetworkOptions(0.01, 0.7, (1.4, 1.4), pose_noise_m=0.005),
    ),
    "bad depths and poses": case_of(
        "bad",
        SceneOptions(point_count=150, reference_count=6, outlier_share=0.15),
        FakeNetworkOptions(0.05, 0.3, pose_noise_m=0.01, bad_pose_count=1, bad_pose_m=0.3),
    ),
    "another anchor": case_of(
        "anchor", None, FakeNetworkOptions(0.01, dense=True, reference_confidences=(0.2, 0.9, 0.4, 0.9))
    ),
    "two references": case_of("two", SceneOptions(point_count=100, reference_count=2)),
}


def assert_same_scale(actual: MetricScale, expected: MetricScale) -> None:
    assert (actual.stage, actual.anchor) == (expected.stage, expected.anchor)
    assert actual.metres_per_unit == pytest.approx(expected.metres_per_unit, rel=1e-9)
    assert actual.deviation == pytest.approx(expected.deviation, rel=1e-9, abs=1e-9)
    for mine, theirs in (
        (actual.world_from_query, expected.world_from_query),
        (actual.world_from_local, expected.world_from_local),
    ):
        np.testing.assert_allclose(mine.rotation, theirs.rotation, atol=1e-9)
        np.testing.assert_allclose(mine.translation, theirs.translation, atol=1e-9)


def homogeneous(points: Array) -> Array:
    """Unit vectors (P, 4) of points (P, 3)."""
    return unit_rows(np.concatenate([points, np.ones((len(points), 1))], axis=1))


def assert_same_structure(actual: Structure | None, expected: Structure | None) -> None:
    assert actual is not None
    assert expected is not None
    for name in ("point", "view", "keypoint"):
        np.testing.assert_array_equal(getattr(actual.tracks, name), getattr(expected.tracks, name))
    # The last steps lower the cost by its rounding, if at all: whether they are taken is not the same everywhere. In
    # the paper's form wrong matches also send points to infinity, where hardly anything holds them.
    difference = np.abs(homogeneous(actual.x_in_world) - homogeneous(expected.x_in_world))
    assert (difference > 1e-7).sum() <= 0.05 * difference.size
    assert difference.max(initial=0.0) < 1e-4
    assert actual.noise.level_px == pytest.approx(expected.noise.level_px, rel=1e-6)
    assert actual.noise.slope == expected.noise.slope


def assert_same_matches(actual: PointMatches | None, expected: PointMatches | None) -> None:
    assert actual is not None
    assert expected is not None
    for name in ("point", "keypoint", "guided"):
        np.testing.assert_array_equal(getattr(actual, name), getattr(expected, name))
    assert actual.radius_px == expected.radius_px


def assert_same(actual: Refined | Rejection, expected: Refined | Rejection) -> None:
    assert isinstance(actual, Refined), actual
    assert isinstance(expected, Refined), expected
    assert_same_scale(actual.scale, expected.scale)
    if expected.structure is None:
        assert actual.structure is None
        assert actual.matches is None
    else:
        assert_same_structure(actual.structure, expected.structure)
        assert_same_matches(actual.matches, expected.matches)


class Watch(TorchDispatchMode):
    """Fails at any operation that reads or writes a tensor outside one device.

    On the meta device, whose tensors have shapes and no values, an operation that needs a value fails by itself: what
    runs there never waits for a value.

    Attributes:
        launched: how often each operation ran, but for mere views.
    """

    def __init__(self, device: str) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.device = torch.device(device)
        self.launched: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        for value in tree_leaves((args, kwargs, result)):
            if isinstance(value, Tensor) and value.device.type != self.device.type:
                raise AssertionError(f"{func} touches a tensor {tuple(value.shape)} on {value.device}")
        if not func.is_view:
            self.launched[str(func)] += 1
        return result
