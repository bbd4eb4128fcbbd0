"""Entries of a catalogue of weights, and their planted files."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mapless_server.networks.weights.catalogue import HubFile, Licence, Weights
from support.safetensors_files import safetensors

CONTENT = safetensors({"a.weight": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.zeros(2, np.float16)})


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def entry_of(content: bytes = CONTENT, **changes: Any) -> Weights:
    """A catalogue entry whose official file is this."""
    weights = Weights(
        "net", "net.safetensors", "tests", Licence("MIT", "url"), HubFile("o/n"), len(content), sha256(content)
    )
    return replace(weights, **changes)


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())
