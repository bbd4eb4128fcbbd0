"""Pi3 and Pi3X have the output of the official networks, for weights and images made by a rule.

The small fixtures lie here, thinned out; those beside the repository are complete, and some of them full-size.
"""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.parity_rule import deviation, existing, images, network_without_weights, ruled_network, weights
from support.parity_rule import full_network as make_full_network
from torch import Tensor

from mapless_server.networks.conditions import normalize_poses
from mapless_server.networks.heads import nearest_rotation
from mapless_server.networks.network import Network, NetworkOutput, patch_grid
from mapless_server.networks.pi3 import UNUSED, Pi3X

HERE = Path(__file__).parents[1] / "fixtures" / "networks"
BESIDE = Path(os.environ.get("TEST_PARITY") or Path(__file__).parents[3] / "shared" / "pi3parity")
TOLERANCE = 5e-5
METRIC_TOLERANCE = 1e-5

SMALL_CASES = sorted(path.stem for path in HERE.glob("*.npz"))
FULL_CASES = [("pi3", "pi3_full"), ("pi3x", "pi3x_full_plain"), ("pi3x", "pi3x_full_pose_refs")]


@pytest.fixture(scope="module")
def small_networks() -> dict[str, Network]:
    return {name: ruled_network(name) for name in ("pi3", "pi3x")}


@pytest.mark.parametrize("case", SMALL_CASES)
def test_a_small_network_has_the_official_output(case: str, small_networks: dict[str, Network]) -> None:
    check(small_networks[network_of(case)], fixture(case))


@pytest.mark.parametrize("name", ["pi3", "pi3x"])
def test_small_networks_have_the_official_entries(name: str) -> None:
    shapes = json.loads((HERE / f"{name}_small_shapes.json").read_text())
    used = {key: shape for key, shape in shapes.items() if not key.startswith(UNUSED)}
    assert {key: list(value.shape) for key, value in network_without_weights(name).state_dict().items()} == used


@pytest.mark.parametrize("name", ["pi3", "pi3x"])
def test_full_networks_have_the_official_entries(name: str) -> None:
    official = json.loads(existing(BESIDE / f"{name}_state_dict.json").read_text())["keys"]
    entries = {key: entry for key, entry in official.items() if not key.startswith(UNUSED)}
    state = network_without_weights(name, small=False).state_dict()
    assert {key: list(value.shape) for key, value in state.items()} == {k: e["shape"] for k, e in entries.items()}
    for key in list(entries)[::40]:
        values = weights(key, entries[key]["shape"])
        assert hashlib.sha256(values.tobytes()).hexdigest().startswith(entries[key]["rule_sha256"]), key


@pytest.fixture(scope="module")
def full_network(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Network:
    existing(BESIDE)
    return make_full_network(request.param, tmp_path_factory.mktemp("full"))


@pytest.mark.nightly
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("full_network", "case"), FULL_CASES, indirect=["full_network"])
def test_a_full_network_has_the_official_output(case: str, full_network: Network) -> None:
    check(full_network, fixture(case))


def network_of(case: str) -> str:
    return case.split("_")[0]


def fixture(case: str) -> dict[str, NDArray[Any]]:
    """The complete one if it is there."""
    path = BESIDE / f"{case}.npz"
    with np.load(existing(path if path.exists() else HERE / f"{case}.npz")) as arrays:
        return dict(arrays)


def check(network: Network, case: dict[str, NDArray[Any]]) -> None:
    """Every output of the fixture, to its tolerance."""
    given = images(str(case["image_tag"]), case["image_shape"].tolist())
    assert hashlib.sha256(given.tobytes()).hexdigest() == str(case["image_sha256"])
    answer = run(network, torch.from_numpy(given), case)
    stride = int(case.get("stride", 1))
    found = {
        "local_points": answer.local_points[:, :, ::stride, ::stride],
        "conf": answer.confidence_logits[:, :, ::stride, ::stride, None],
        "camera_poses": answer.camera_poses,
    }
    for name, values in found.items():
        assert deviation(values, case[name]) <= TOLERANCE, name
    if "metric" in case:
        assert deviation(metric(network, torch.from_numpy(given), case), case["metric"]) <= METRIC_TOLERANCE


@torch.no_grad()
def run(network: Network, given: torch.Tensor, case: dict[str, NDArray[Any]]) -> NetworkOutput:
    """Scenes whose views all have intrinsics or none, and of which at least two have a pose or none is used."""
    scenes, views = given.shape[:2]
    layout = network.layout(patch_grid(given))
    inputs = {name.removeprefix("in_"): torch.from_numpy(a) for name, a in case.items() if name.startswith("in_")}
    intrinsics = inputs["intrinsics"].flatten(0, 1) if "intrinsics" in inputs else None
    poses = posed = None
    if "poses" in inputs and inputs["mask_add_pose"].sum() > 1:
        poses, posed = normalize_poses(inputs["poses"]), inputs["mask_add_pose"][0].nonzero().mT
    tokens = network.encode(given.flatten(0, 1), layout, intrinsics).unflatten(0, (scenes, views))
    return network.reconstruct(tokens, layout, views, poses, posed)


def metric(network: Network, given: torch.Tensor, case: dict[str, NDArray[Any]]) -> torch.Tensor:
    """The metric scale (B,) that the network multiplies with."""
    assert isinstance(network, Pi3X)
    seen: list[torch.Tensor] = []
    handle = network.metric_head.register_forward_hook(lambda _module, _inputs, output: seen.append(output))
    try:
        run(network, given, case)
    finally:
        handle.remove()
    return torch.cat(seen).exp()[:, 0]


# Laws for any weights


GRID = (4, 5)


@pytest.fixture(scope="module", params=["pi3", "pi3x"])
def network(request: pytest.FixtureRequest) -> Network:
    return ruled_network(request.param)


def some_images(views: int, grid: tuple[int, int] = GRID) -> Tensor:
    return torch.from_numpy(images("laws", (views, 3, grid[0] * 14, grid[1] * 14)))


def reconstruct(network: Network, given: Tensor, mapped: int, poses: Tensor | None = None) -> NetworkOutput:
    layout = network.layout(patch_grid(given))
    posed = None if poses is None else torch.arange(len(given))[None]
    return network.reconstruct(network.encode(given, layout)[None], layout, mapped, poses, posed)


def assert_close(found: Tensor, expected: Tensor, tolerance: float = 1e-5) -> None:
    assert (found - expected).abs().max() <= tolerance * expected.abs().max()


def test_omitted_maps_do_not_change_the_rest(network: Network) -> None:
    given = some_images(4)
    everything, some = reconstruct(network, given, 4), reconstruct(network, given, 2)
    assert some.local_points.shape[1] == some.confidence_logits.shape[1] == 2
    assert_close(some.local_points, everything.local_points[:, :2])
    assert_close(some.confidence_logits, everything.confidence_logits[:, :2])
    torch.testing.assert_close(some.camera_poses, everything.camera_poses, rtol=0, atol=0)
    assert reconstruct(network, given, 0).local_points.shape[1] == 0


def test_in_low_precision_only_the_main_residual_stays_float32() -> None:
    network = ruled_network("pi3")
    network.set_compute_type(torch.bfloat16)
    parts = ("encoder.blocks.1", "decoder.2", "decoder.3", "point_decoder.blocks.1", "point_head", "camera_head")
    seen: dict[str, torch.dtype] = {}
    for name, module in network.named_modules():
        if name in parts:
            module.register_forward_hook(lambda _m, _i, out, name=name: seen.update({name: out.dtype}))
    given = some_images(3)
    low = reconstruct(network, given, 3)
    assert seen.pop("point_decoder.blocks.1") is torch.bfloat16
    assert set(seen.values()) == {torch.float32}
    assert len(seen) == 5
    high = reconstruct(ruled_network("pi3"), given, 3)
    assert 1e-5 < (low.local_points - high.local_points).norm() / high.local_points.norm() < 0.05


def random_matrices(count: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(0).normal(size=(count, 3, 3)))


def test_the_nearest_rotation_equals_that_of_the_svd() -> None:
    matrices = random_matrices(2000)
    u, s, vt = torch.linalg.svd(matrices)
    sign = torch.det(u @ vt)
    expected = u @ torch.diag_embed(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], -1)) @ vt
    assert (sign < 0).sum() > 500, "mirrored ones among them"
    unique = s[:, 1] + sign * s[:, 2] > 1e-3 * s[:, 0]
    torch.testing.assert_close(nearest_rotation(matrices)[unique], expected[unique], rtol=0, atol=1e-9)


def poses_at(*positions: tuple[float, float, float]) -> Tensor:
    poses = torch.eye(4).repeat(1, len(positions), 1, 1)
    poses[0, :, :3, :3] = nearest_rotation(random_matrices(len(positions))).float()
    poses[0, :, :3, 3] = torch.tensor(positions)
    return poses


def test_normalized_poses_do_not_depend_on_frame_or_unit() -> None:
    poses = poses_at((1, 2, 3), (2, 2, 3), (1, 5, 3))
    moved = poses_at((9, -4, 0))[:, :1] @ poses
    moved[..., :3, 3] *= 30
    expected = normalize_poses(poses)
    torch.testing.assert_close(normalize_poses(moved), expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(expected[0, 0], torch.eye(4), rtol=0, atol=1e-6)
    torch.testing.assert_close(expected[0, 1:, :3, 3].norm(dim=-1).mean(), torch.tensor(1.0))
