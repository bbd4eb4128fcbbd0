"""Weights and images that are functions of a name alone, which the fixtures of the official networks were made with.

A name's SHA-256 seeds PCG64; its raw output, cut to 24 bits, is mapped to [-1, 1). Nothing but integers, float32
products and one square root, so that it is the same to the bit everywhere.
"""

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor

from mapless_server.networks.checkpoint import load_strictly
from mapless_server.networks.mapanything import MapAnything, MapAnythingSizes
from mapless_server.networks.network import IMAGE_MEAN, IMAGE_STD, Network
from mapless_server.networks.pi3 import Pi3, Pi3X, Sizes

SMALL_PI3 = Sizes(64, 4, encoder_depth=3, decoder_depth=4, head_depth=2, camera_width=32)
SMALL_PI3X = Sizes(64, 4, 3, 10, 2, 32, (64, 32, 16), 8, metric_width=32, metric_heads=2, metric_depth=2)
SMALL_MAPANYTHING = MapAnythingSizes(
    width=96,
    encoder_heads=4,
    encoder_depth=4,
    heads=6,
    depth=6,
    taps=(1, 3),
    map_widths=(40, 48, 56),
    vector_widths=(16, 24, 32),
    dense_map_widths=(8, 16, 24, 32),
    dense_width=32,
    dense_hidden=16,
)

CONSTANTS = {"image_mean": IMAGE_MEAN, "image_std": IMAGE_STD}
TOKENS = ("cls_token", "pos_embed", "register_tokens", "register_token", "metric_token", "depth_emb")
GAMMA = {"decoder": 0.03, "pose_inject_blk": 0.1}
NORM_SCALE = {r"\.[qk]_norm\.weight$": 1.5, r"^(depth_)?encoder\.norm\.weight$": 0.1}
GAIN = {
    r"^(encoder\.patch_embed|depth_encoder\.patch_embed|ray_embed)\.proj\.weight$": 0.1,
    r"^((point_head|conf_head)\.proj|metric_head)\.weight$": 0.3,
    r"_head\.output_block\.\d+\.2\.weight$": 0.5,
}


def uniform(name: str, count: int) -> NDArray[np.float32]:
    """Float32 values (count,) in [-1, 1), multiples of 2^-23."""
    seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:16], "little")
    raw = np.random.PCG64(seed).random_raw(count)
    return (raw >> np.uint64(40)).astype(np.float32) * np.float32(2.0**-23) - np.float32(1.0)


def images(tag: str, shape: Sequence[int]) -> NDArray[np.float32]:
    """Images of a shape, in [0, 1)."""
    return (uniform(f"image:{tag}", math.prod(shape)).reshape(shape) + np.float32(1.0)) * np.float32(0.5)


MAPANYTHING_OFFSET = {"dense_head.1.conv2.2.bias": (0, 0, 1, 0.5, 0, 0), "pose_head.fc_rot.bias": (0, 0, 0, 1)}
"""Keep rays pointing forwards, and quaternions away from zero."""
MAPANYTHING_GAIN = {
    r"^encoder\.model\.patch_embed\.proj\.weight$": 0.05,
    r"^\w+_encoder\.encoder\.[12]\.weight$": 0.2,
    r"^dense_head\.1\.conv2\.2\.weight$": 0.5,
}
MAPANYTHING_BIAS = {
    r"^fusion_norm_layer\.|\.norm_layer\.": 0.02,
    r"^\w+_encoder\.encoder\.[12]\.bias$": 0.1,
    r"^\w+_encoder\.": 0.5,
    r"": 0.05,
}


def mapanything_weights(key: str, shape: Sequence[int]) -> NDArray[np.float32]:
    """The entry of a checkpoint of MapAnything."""
    if key == "info_sharing.view_pos_table":
        return np.broadcast_to(np.arange(shape[-1]) % 2, shape).astype(np.float32)
    noise = uniform(key, math.prod(shape)).reshape(shape)
    name, top = key.rsplit(".", 1)[-1], key.split(".", 1)[0]
    if name in ("cls_token", "pos_embed", "scale_token"):
        return np.float32(0.15) * noise
    if name == "gamma":
        return np.float32(0.06 if top == "info_sharing" else 0.03) * (np.float32(1.0) + np.float32(0.5) * noise)
    if len(shape) == 1 and name == "weight":
        is_small = re.search(r"^fusion_norm_layer\.|\.norm_layer\.", key)
        return np.float32(0.1 if is_small else 1.0) * (np.float32(1.0) + np.float32(0.2) * noise)
    if len(shape) == 1:
        biases = np.float32(_matching(MAPANYTHING_BIAS, key)) * noise
        offset = MAPANYTHING_OFFSET.get(key)
        return biases if offset is None else biases + np.asarray(offset, np.float32)
    transposed = re.search(r"input_process\.[01]\.0\.1\.weight$", key)
    fan_in = shape[0] if transposed else math.prod(shape[1:])
    values = np.float32(_matching(MAPANYTHING_GAIN, key) * math.sqrt(3.0 / fan_in)) * noise
    if key.endswith(".attn.qkv.weight"):
        values[: shape[0] * 2 // 3] *= np.float32(1.5)
    return values


def weights(key: str, shape: Sequence[int]) -> NDArray[np.float32]:
    """The entry of a checkpoint of Pi3 or Pi3X."""
    if key in CONSTANTS:
        return np.asarray(CONSTANTS[key], np.float32).reshape(shape)
    noise = uniform(key, math.prod(shape)).reshape(shape)
    name, top = key.rsplit(".", 1)[-1], key.split(".", 1)[0]
    if name in TOKENS:
        return np.float32(0.3) * noise
    if name == "gamma":
        return np.float32(GAMMA.get(top, 0.05)) * (np.float32(1.0) + np.float32(0.5) * noise)
    if len(shape) == 1 and name == "weight":
        return np.float32(_matching(NORM_SCALE, key)) * (np.float32(1.0) + np.float32(0.2) * noise)
    amplitude = 0.05
    if len(shape) > 1:
        transposed = re.search(r"upsample_blocks\.\d+\.0\.0\.weight$", key)
        fan_in = shape[0] if transposed else math.prod(shape[1:])
        amplitude = _matching(GAIN, key) * math.sqrt(3.0 / fan_in)
    values = np.float32(amplitude) * noise
    if re.search(r"\.attn\.qkv\.(weight|bias)$", key):
        values[: shape[0] * 2 // 3] *= np.float32(0.05 if top in GAMMA else 1.5)
    if re.search(r"\.cross_attn\.[qk]_proj\.(weight|bias)$", key):
        values *= np.float32(1.5)
    return values


def _matching(factors: Mapping[str, float], key: str) -> float:
    return next((factor for pattern, factor in factors.items() if re.search(pattern, key)), 1.0)


def network_without_weights(name: str, small: bool = True) -> Network:
    """A network on the meta device."""
    with torch.device("meta"):
        if name == "mapanything":
            return MapAnything(SMALL_MAPANYTHING if small else None)
        if name == "pi3":
            return Pi3(SMALL_PI3 if small else None)
        return Pi3X(SMALL_PI3X if small else None)


def ruled_network(name: str, small: bool = True) -> Network:
    """A network with the rule's weights."""
    network = network_without_weights(name, small)
    rule = mapanything_weights if name == "mapanything" else weights
    state = {key: torch.from_numpy(rule(key, value.shape)) for key, value in network.state_dict().items()}
    network.load_state_dict(state, assign=True)
    return network.eval().requires_grad_(False)


def full_network(name: str, folder: Path) -> Network:
    """Full-size, loaded strictly from a checkpoint made by the rule."""
    network, rule = (
        network_without_weights(name, small=False),
        mapanything_weights if name == "mapanything" else weights,
    )
    file = folder / "model.safetensors"
    save_file({key: torch.from_numpy(rule(key, it.shape)) for key, it in network.state_dict().items()}, file)
    load_strictly(network, file)
    file.unlink()
    return network.eval().requires_grad_(False)


def existing(path: Path) -> Path:
    """A fixture beside the repository, or where TEST_PARITY or TEST_MAPANYTHING says; skips the test without it."""
    if not path.exists():
        pytest.skip(f"needs the fixtures of the official networks (TEST_PARITY, TEST_MAPANYTHING): {path} is absent")
    return path


def deviation(found: Tensor, expected: NDArray[Any]) -> float:
    """Largest difference as a share of the largest value."""
    assert found.shape == expected.shape
    return float(np.abs(found.numpy() - expected).max() / np.abs(expected).max())
