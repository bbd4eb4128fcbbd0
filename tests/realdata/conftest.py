"""Photographs from outside the repository: beside it, or in the folder of TEST_DATA."""

import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from mapless_tools.dataset import Dataset
from mapless_tools.ingest.formats.cameras import read_folder
from research.described import Described, read_place

DATA = Path(os.environ.get("TEST_DATA") or Path(__file__).parents[3] / "shared" / "data")


@cache
def read_place_once(name: str) -> Described:
    """A scene with the features of its photographs, for all tests."""
    return read_place(DATA / name)


@pytest.fixture(scope="session")
def photographs() -> Callable[[str], Dataset]:
    """Reads a scene's folder; skips the test where there is none."""

    def read(folder: str) -> Dataset:
        if not (DATA / folder / "cameras.json").is_file():
            pytest.skip(f"needs real photographs, {DATA / folder} is absent (TEST_DATA names another place)")
        return read_folder(DATA / folder)

    return read
