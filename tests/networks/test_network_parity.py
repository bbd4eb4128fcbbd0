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

from mapless_server.networks.conditions import normalize_poses
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
    check(small_networks[network_of(case)], fixture(HERE, case))


@pytest.mark.parametrize("case", SMALL_CASES)
def test_a_small_network_equals_the_official_at_every_pixel(case: str, small_networks: dict[str, Network]) -> None:
    check(small_networks[network_of(case)], fixture(BESIDE, case))


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
    check(full_network, fixture(BESIDE, case))


def network_of(case: str) -> str:
    return case.split("_")[0]


def fixture(folder: Path, case: str) -> dict[str, NDArray[Any]]:
    with np.load(existing(folder / f"{case}.npz")) as arrays:
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
    """Of scenes whose views all have intrinsics or none, and of which at least two have a pose or none is used."""
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
