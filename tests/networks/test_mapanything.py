"""MapAnything has the output of the official network, for weights and inputs made by a rule; and laws for any weights.

The fixtures beside the repository are complete, and some of them full-size; a few lie here, thinned out.
"""

import hashlib
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from support.parity_rule import (
    deviation,
    existing,
    images,
    mapanything_weights,
    network_without_weights,
    ruled_network,
)
from support.parity_rule import full_network as make_full_network
from torch import Tensor

from bench.network.subject import Work, flop_of
from mapless_server.networks.checkpoint import load_strictly
from mapless_server.networks.mapanything import UNUSED, Decoded, MapAnything, as_output, canonical_name
from mapless_server.networks.view_conditions import (
    RelativePoses,
    pinhole_rays,
    quaternions_from_rotations,
    relative_poses,
    rotations_from_quaternions,
)
from mapless_server.networks.weights import CheckpointError

HERE = Path(__file__).parents[1] / "fixtures" / "networks" / "mapanything"
BESIDE = Path(os.environ.get("TEST_MAPANYTHING") or Path(__file__).parents[3] / "shared" / "mapanythingparity")
TOLERANCE = 5e-5
POSE_TOLERANCE = 1e-5
SLOW = {"small_square518"}
WITH_DEPTHS = {
    "small_batch2_dropped",
    "small_depth_part",
    "small_depth_pose",
    "small_depth_pose_nonmetric",
    "small_mixed",
}
CASES = sorted({path.stem for folder in (HERE, BESIDE) for path in folder.glob("small_*.npz")} - WITH_DEPTHS)

Fixture = dict[str, NDArray[Any]]


@pytest.fixture(scope="module")
def network() -> MapAnything:
    return small_network()


def small_network() -> MapAnything:
    network = ruled_network("mapanything")
    assert isinstance(network, MapAnything)
    return network


def fixture(case: str) -> Fixture:
    """The complete one if it is there."""
    path = BESIDE / f"{case}.npz"
    with np.load(existing(path if path.exists() else HERE / f"{case}.npz")) as arrays:
        return dict(arrays)


def inputs_of(case: Fixture) -> tuple[Tensor, dict[str, Tensor]]:
    given = images(str(case["image_tag"]), case["image_shape"].tolist())
    assert hashlib.sha256(given.tobytes()).hexdigest() == str(case["image_sha256"])
    tensors = {name: torch.from_numpy(values) for name, values in case.items() if values.dtype.kind in "fb"}
    return torch.from_numpy(given), tensors


def rays_of(case: dict[str, Tensor], height: int, width: int) -> Tensor:
    if "in_intrinsics" in case:
        return pinhole_rays(case["in_intrinsics"].flatten(0, 1), height, width)
    return torch.nn.functional.normalize(case["in_ray_directions"].flatten(0, 1), dim=-1)


def poses_of(case: dict[str, Tensor]) -> RelativePoses | None:
    if not case["has_pose"].any():
        return None
    if "in_quats" in case:
        return relative_poses(case["in_quats"], case["in_trans"], case["has_pose"])
    poses = case["in_camera_poses"]
    return relative_poses(quaternions_from_rotations(poses[..., :3, :3]), poses[..., :3, 3], case["has_pose"])


@torch.no_grad()
def run(network: MapAnything, case: Fixture) -> Decoded:
    given, tensors = inputs_of(case)
    (scenes, views), (height, width) = given.shape[:2], given.shape[-2:]
    layout = network.layout((height // 14, width // 14))
    encoded, has_rays = network.encode_views(given.flatten(0, 1)), tensors["has_rays"].flatten()
    if has_rays.any():
        with_rays = rays_of(tensors, height, width)[has_rays]
        encoded[has_rays] = network.encode_views(given.flatten(0, 1)[has_rays], with_rays)
    tokens = encoded.unflatten(0, (scenes, views))
    return network.decode(tokens, layout, views, poses_of(tensors), tensors["has_pose"], tensors["is_metric_scale"])


def check(network: MapAnything, case: Fixture) -> None:
    """Every output of the fixture, to its tolerance."""
    decoded = run(network, case)
    scale = decoded.scale[..., None]
    maps = {
        "ray_directions": decoded.rays,
        "depth_along_ray": scale[..., None] * decoded.depths,
        "conf": 1 + decoded.confidence_logits.exp(),
        "mask_logits": decoded.mask_logits,
    }
    down, right = case["stride"].tolist() if "stride" in case else (1, 1)
    for name, values in maps.items():
        assert deviation(values[:, :, ::down, ::right], case[name]) <= TOLERANCE, name
    assert deviation(scale * decoded.translations, case["cam_trans"]) <= POSE_TOLERANCE
    assert deviation(decoded.quaternions, case["cam_quats"]) <= POSE_TOLERANCE
    assert deviation(decoded.scale, case["metric_scale"]) <= POSE_TOLERANCE
    if "pts3d" in case:
        output = as_output(decoded)
        rotations, centres = output.camera_poses[..., :3, :3], output.camera_poses[:, :, None, None, :3, 3]
        points = torch.einsum("bnij,bnhwj->bnhwi", rotations, output.local_points) + centres
        assert deviation(points[:, :, ::down, ::right], case["pts3d"]) <= TOLERANCE
        assert deviation(output.camera_poses, case["camera_poses"]) <= POSE_TOLERANCE


# The official output


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.nightly) if case in SLOW else case for case in CASES]
)
def test_a_small_network_has_the_official_output(case: str, network: MapAnything) -> None:
    check(network, fixture(case))


@pytest.mark.parametrize(("small", "file"), [(True, "small_state_dict"), (False, "mapanything_state_dict")])
def test_networks_have_all_official_entries_by_name(small: bool, file: str) -> None:
    entries = json.loads(existing(BESIDE / f"{file}.json").read_text())["keys"]
    assert all(canonical_name(key) == entry.get("alias_of", key) for key, entry in entries.items())
    state = network_without_weights("mapanything", small).state_dict()
    used = {key: it for key, it in entries.items() if "alias_of" not in it and not key.startswith(UNUSED)}
    expected = {key: entry["shape"] for key, entry in used.items()}
    assert {key: list(value.shape) for key, value in state.items()} == expected
    for key in list(expected)[:: 9 if small else 80]:
        digest = hashlib.sha256(mapanything_weights(key, expected[key]).tobytes()).hexdigest()
        assert digest.startswith(entries[key]["rule_sha256"]), key


@pytest.fixture(scope="module")
def full_network(tmp_path_factory: pytest.TempPathFactory) -> MapAnything:
    existing(BESIDE)
    network = make_full_network("mapanything", tmp_path_factory.mktemp("full"))
    assert isinstance(network, MapAnything)
    return network


@pytest.mark.nightly
@pytest.mark.timeout(900)
@pytest.mark.parametrize("case", ["full_plain", "full_pose_refs"])
def test_a_full_network_has_the_official_output(case: str, full_network: MapAnything) -> None:
    check(full_network, fixture(case))


def test_geometry_equals_the_official() -> None:
    given = {name: torch.from_numpy(it) for name, it in fixture("geometry").items() if it.dtype.kind == "f"}

    def differs(found: Tensor, name: str) -> bool:
        return deviation(found, given[name].numpy()) > 1e-6

    assert not differs(quaternions_from_rotations(given["rot_in"]), "rot_to_quat")
    assert not differs(rotations_from_quaternions(given["quat_in"]), "quat_to_rot")
    quaternions, places = (torch.stack([given[f"rel_{it}{i}"] for i in (1, 2)], dim=1) for it in ("quat", "trans"))
    relative = relative_poses(quaternions, places, torch.ones(20, 2, dtype=torch.bool))
    assert not differs(relative.quaternions[:, 1], "rel_quat_out")
    assert not differs(relative.translations[:, 1] * relative.scale[:, None], "rel_trans_out")
    assert not differs(pinhole_rays(given["rays_K"], 84, 126)[:, ::5, ::7], "rays_unit")


WORKS = {
    "no_dense_head_for_query": Work(11, 10),
    "cached_refs__no_dense_head_for_query": Work(1, 10),
}


@pytest.mark.parametrize(
    ("size", "name"),
    [
        pytest.param(size, name, marks=[] if (size, work.encoded) == ("392x518", 1) else pytest.mark.nightly)
        for size in ("392x518", "294x392", "518x518")
        for name, work in WORKS.items()
    ],
)
def test_operations_are_the_counted_ones(size: str, name: str) -> None:
    """11 views of 392x518: 37.8 TFLOP, 21.4 with the references' tokens kept."""
    remaining = json.loads(existing(BESIDE / "flops.json").read_text())["by_size_HxW"][size]["remaining"]
    height, width = map(int, size.split("x"))
    work = replace(WORKS[name], views=11, grid=(height // 14, width // 14))
    assert flop_of("mapanything", work) == pytest.approx(remaining[name], rel=1e-4)


# Laws

GRID = (3, 4)


def scene(network: MapAnything, views: int = 4) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    """Tokens of one scene, and poses of all its views but the last."""
    given = torch.from_numpy(images("laws", (views, 3, 42, 56)))
    k = torch.tensor([[50.0, 0.0, 28.0], [0.0, 50.0, 21.0], [0.0, 0.0, 1.0]]).repeat(views, 1, 1)
    tokens = network.encode(given, network.layout(GRID), k)[None]
    quaternions = torch.from_numpy(images("laws of poses", (1, views, 4))) - 0.5
    poses = torch.eye(4).repeat(1, views, 1, 1)
    poses[..., :3, :3] = rotations_from_quaternions(quaternions)
    poses[..., :3, 3] = 3 * torch.from_numpy(images("laws of places", (1, views, 3)))
    return tokens, (poses, torch.arange(views)[None] < views - 1, torch.ones(1, views, dtype=torch.bool))


def assert_close(found: Tensor, expected: Tensor, tolerance: float = 1e-5) -> None:
    assert (found - expected).abs().max() <= tolerance * expected.abs().max()


def test_the_intrinsics_of_all_networks_have_one_convention(network: MapAnything) -> None:
    """`encode` takes (0.5, 0.5) as the centre of the top-left pixel, `pinhole_rays` (0, 0)."""
    given = torch.from_numpy(images("laws", (1, 3, 42, 56)))
    k = torch.tensor([[[50.0, 0.0, 28.5], [0.0, 50.0, 21.5], [0.0, 0.0, 1.0]]])
    k_at_zero = k - torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    rays = pinhole_rays(k_at_zero, 42, 56)
    assert torch.equal(network.encode(given, network.layout(GRID), k), network.encode_views(given, rays))


def test_values_of_an_unknown_pose_have_no_effect(network: MapAnything) -> None:
    tokens, (poses, posed, metric) = scene(network)
    broken = poses.clone()
    broken[:, -1] = torch.nan
    layout = network.layout(GRID)
    plain, same = (network.reconstruct(tokens, layout, 3, it, posed, metric) for it in (poses, broken))
    assert torch.equal(plain.camera_poses, same.camera_poses)
    assert torch.equal(plain.local_points, same.local_points)


def test_a_first_view_without_a_pose_is_refused(network: MapAnything) -> None:
    _, (poses, posed, metric) = scene(network)
    with pytest.raises(ValueError, match="the first view must have a pose if any has"):
        network.conditions(poses, posed.flip(1), metric)
    assert network.conditions(poses, torch.zeros_like(posed), metric) is None


def test_a_masked_pixel_has_no_confidence(network: MapAnything) -> None:
    tokens, _ = scene(network)
    decoded = network.decode(tokens, network.layout(GRID), 4)
    confidence = as_output(decoded).confidence_logits.sigmoid()
    shown = decoded.mask_logits > 0
    assert 0.05 < shown.float().mean() < 0.95
    assert (confidence[~shown] == 0).all()
    official = 1 + decoded.confidence_logits.exp()
    torch.testing.assert_close(confidence[shown], (1 - 1 / official)[shown])


def test_in_low_precision_conditions_and_heads_stay_float32() -> None:
    network = small_network()
    network.set_compute_type(torch.bfloat16)
    names = {name for name, it in network.named_parameters() if it.dtype is torch.bfloat16}
    assert {name.split(".")[0] for name in names} == {"encoder", "info_sharing"}
    assert not any("norm" in name or "gamma" in name for name in names)
    seen: dict[str, torch.dtype] = {}
    for name in ("encoder.model.blocks.1", "info_sharing.self_attention_blocks.3", "dense_head.1", "scale_head"):
        network.get_submodule(name).register_forward_hook(lambda _m, _i, out, name=name: seen.update({name: out.dtype}))
    tokens, conditions = scene(network)
    low = network.reconstruct(tokens, network.layout(GRID), 3, *conditions)
    assert set(seen.values()) == {torch.float32}
    exact = small_network()
    high = exact.reconstruct(scene(exact)[0], exact.layout(GRID), 3, *conditions)
    assert 1e-5 < (low.local_points - high.local_points).norm() / high.local_points.norm() < 0.05


# Files


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "model.safetensors"


def test_a_file_with_all_official_names_is_loaded(network: MapAnything, file: Path) -> None:
    tensors = dict(network.state_dict())
    for i in range(4):
        weight = tensors.pop(f"dense_head.0.input_process.{i}.1.weight")
        tensors[f"dpt_feature_head.scratch.layer{i + 1}_rn.weight"] = weight
        tensors[f"dense_head.0.scratch.layer_rn.{i}.weight"] = weight.clone()
    tensors["dpt_regressor_head.conv1.bias"] = tensors.pop("dense_head.1.conv1.bias")
    save_file(tensors, file)
    loaded = network_without_weights("mapanything")
    load_strictly(loaded, file)
    assert all(torch.equal(it, network.state_dict()[name]) for name, it in loaded.state_dict().items())
    tensors["dense_head.0.scratch.layer_rn.2.weight"] += 1
    save_file(tensors, file)
    with pytest.raises(CheckpointError, match=r"holds dense_head.0.input_process.2.1.weight twice"):
        load_strictly(network_without_weights("mapanything"), file)


def test_version_1_is_refused_by_name(network: MapAnything, file: Path) -> None:
    save_file({**network.state_dict(), "scale_token": torch.zeros(768)}, file)
    with pytest.raises(CheckpointError, match="it is version 1 of MapAnything"):
        load_strictly(network_without_weights("mapanything"), file)
