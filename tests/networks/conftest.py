"""A catalogue of one entry, its file, and a folder of weights."""

from pathlib import Path

import pytest
from support.weights_files import CONTENT, entry_of

from mapless_server.networks.weights import (
    catalogue,
)
from mapless_server.networks.weights.catalogue import Weights


@pytest.fixture
def weights(monkeypatch: pytest.MonkeyPatch) -> Weights:
    weights = entry_of()
    monkeypatch.setattr(catalogue, "CATALOGUE", (weights,))
    return weights


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "given.safetensors"
    path.write_bytes(CONTENT)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "weights"
