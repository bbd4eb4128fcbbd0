"""LightGlue for SuperPoint, from the file that transformers reads: the same network with its tensors cut otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor
from transformers import LightGlueConfig, LightGlueForKeypointMatching

from mapless_server.networks.checkpoint import load_strictly

from .lightglue import LightGlue


def load_superpoint_lightglue(weights: Path, config: LightGlueConfig | None = None) -> LightGlue:
    """The network with the weights of a file.

    Args:
        weights: safetensors file with transformers' names. What it holds of SuperPoint itself is not used.
        config: of transformers' network; None is that of the published weights.

    Raises:
        CheckpointError: the weights do not fit.
    """
    theirs = LightGlueForKeypointMatching(config or LightGlueConfig())
    load_strictly(theirs, weights, optional={})
    ours = LightGlue(theirs.descriptor_dim, theirs.num_layers)
    ours.load_state_dict(_translated(theirs.state_dict(), theirs.num_layers), strict=True)
    return ours


def _translated(theirs: Mapping[str, Tensor], layers: int) -> dict[str, Tensor]:
    """Their tensors under our names."""
    ours = {"posenc.Wr.weight": theirs["positional_encoder.projector.weight"]}
    for i in range(layers):
        layer, to = f"transformer_layers.{i}", f"transformers.{i}"
        for kind in ("weight", "bias"):
            q, k, v = (theirs[f"{layer}.self_attention.{part}_proj.{kind}"] for part in "qkv")
            # Ours has query, key and value of each channel of each head side by side.
            ours[f"{to}.self_attn.Wqkv.{kind}"] = torch.stack([q, k, v], dim=1).flatten(end_dim=1)
            for our_name, their_name in (
                ("self_attn.out_proj", "self_attention.o_proj"),
                # Across photographs queries and keys are made alike, and theirs are the same tensor twice.
                ("cross_attn.to_qk", "cross_attention.q_proj"),
                ("cross_attn.to_v", "cross_attention.v_proj"),
                ("cross_attn.to_out", "cross_attention.o_proj"),
                *(
                    (f"{here}_attn.ffn.{index}", f"{here}_mlp.{part}")
                    for here in ("self", "cross")
                    for index, part in ((0, "fc1"), (1, "layer_norm"), (3, "fc2"))
                ),
            ):
                ours[f"{to}.{our_name}.{kind}"] = theirs[f"{layer}.{their_name}.{kind}"]
            head = f"match_assignment_layers.{i}"
            ours[f"log_assignment.{i}.final_proj.{kind}"] = theirs[f"{head}.final_projection.{kind}"]
            ours[f"log_assignment.{i}.matchability.{kind}"] = theirs[f"{head}.matchability.{kind}"]
            if i < layers - 1:
                ours[f"token_confidence.{i}.token.0.{kind}"] = theirs[f"token_confidence.{i}.token.{kind}"]
    return ours
