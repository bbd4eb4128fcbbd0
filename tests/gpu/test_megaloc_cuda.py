"""MegaLoc on a GPU gives the CPU's vectors up to rounding."""

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch", reason="the networks' extra is not installed")

import numpy as np
import torch
from safetensors.torch import save_file
from support.images import textured
from support.small_networks import SMALL_MEGALOC, photograph, ruled_megaloc, view_of

from mapless_server.networks import blocks
from mapless_server.scenes.retrieval.megaloc import MegaLocDescriptor

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]

VIEWS = [view_of(photograph(textured(80 + 8 * i, 60, seed=i))) for i in range(7)]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "megaloc.safetensors"
    save_file(ruled_megaloc().state_dict(), path)
    return path


def test_vectors_are_the_cpus_but_for_rounding(file: Path) -> None:
    on_host, on_device = (MegaLocDescriptor(file, device, SMALL_MEGALOC, 24, 3) for device in ("cpu", "cuda"))
    assert (on_host.dtype, on_device.dtype) == (torch.float32, torch.bfloat16)
    assert on_host.name == on_device.name
    expected, found = on_host.describe_many(VIEWS), on_device.describe_many(VIEWS)
    assert np.linalg.norm(expected - found, axis=1).max() < 0.1 * np.linalg.norm(expected[0] - expected[1])


def test_without_flash_attention_it_computes_in_full_precision(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: Any) -> Any:
        raise RuntimeError("no such kernel")

    monkeypatch.setattr(blocks, "flash_attention", missing)
    on_host, on_device = (MegaLocDescriptor(file, device, SMALL_MEGALOC, 24, 3) for device in ("cpu", "cuda"))
    assert on_device.dtype == torch.float32
    np.testing.assert_allclose(on_device.describe_many(VIEWS), on_host.describe_many(VIEWS), rtol=0, atol=1e-3)
