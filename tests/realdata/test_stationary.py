"""Keypoints that poses predict at the same pixels are kept: a drive, where nothing is fixed to the camera."""

from collections.abc import Callable

import pytest

from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.pairs.stationary import StationaryOptions
from mapless_tools.dataset import Dataset
from research.evidence.stationary import clean, ignored_share, windows
from research.places import DRIVE

from .conftest import DATA

pytestmark = [pytest.mark.realdata, pytest.mark.nightly]


def test_a_drive_keeps_its_far_points(photographs: Callable[[str], Dataset]) -> None:
    photographs(DRIVE)
    assert ignored_share(windows(clean(DATA, DRIVE, SiftExtractor())), StationaryOptions()) <= 0.01
