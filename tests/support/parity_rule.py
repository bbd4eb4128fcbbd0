"""Weights and images that are functions of a name alone, which the fixtures of the official networks were made with.

A name's SHA-256 seeds PCG64; its raw output, cut to 24 bits, is mapped to [-1, 1). Nothing but integers, float32
products and one square root, so that it is the same to the bit everywhere.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from mapless_server.networks.network import IMAGE_MEAN, IMAGE_STD, Network, Sizes
from mapless_server.networks.pi3 import Pi3
from mapless_server.networks.pi3x import Pi3X

SMALL_PI3 = Sizes(64, 4, encoder_depth=3, decoder_depth=4, head_depth=2, camera_width=32)
SMALL_PI3X = Sizes(64, 4, 3, 10, 2, 32, (64, 32, 16), 8, metric_width=32, metric_heads=2, metric_depth=2)

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


def weights(key: str, shape: Sequence[int]) -> NDArray[np.float32]:
    """The entry of a checkpoint."""
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
    """Pi3 or Pi3X, on the meta device."""
    with torch.device("meta"):
        if name == "pi3":
            return Pi3(SMALL_PI3 if small else None)
        return Pi3X(SMALL_PI3X if small else None)


def ruled_network(name: str, small: bool = True) -> Network:
    """Pi3 or Pi3X with the rule's weights."""
    network = network_without_weights(name, small)
    state = {key: torch.from_numpy(weights(key, value.shape)) for key, value in network.state_dict().items()}
    network.load_state_dict(state, assign=True)
    return network.eval().requires_grad_(False)
