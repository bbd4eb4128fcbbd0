"""Gravity on real photographs: a good answer keeps every bit, and what is upside down is told."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from mapless_tools.bench.priors import SENSORS, Place, Setting
from mapless_tools.dataset import Dataset

pytestmark = pytest.mark.realdata

FOUNTAIN = "fountain-P11"


def test_gravity_neither_moves_nor_loses_a_good_answer(photographs: Callable[[str], Dataset]) -> None:
    place = Place(photographs(FOUNTAIN))
    for query, references in list(place.queries(Setting(FOUNTAIN, 3), 40))[::4]:
        found = {
            name: place.answer(query, references, measure(query, place.poses[query], place.down))
            for name, measure in SENSORS.items()
        }
        assert found["none"].is_right(metric=True)
        assert (found["1°"].conflict, found["upside down"].conflict) == (False, True)
        assert not found["upside down"].used
        for name in ("1°", "upside down"):
            assert found[name].error_m == pytest.approx(found["none"].error_m, abs=1e-3)
        assert found["upside down"].error_m == found["none"].error_m


def test_a_weak_answer_gains(photographs: Callable[[str], Dataset]) -> None:
    """No reference within three frames: gravity makes more of these photographs answered, and none worse by much."""
    place = Place(photographs("tum-fr3-office"))
    right = {"none": 0, "1°": 0}
    for query, references in list(place.queries(Setting("tum-fr3-office", 5, gap=3), 40))[2:6]:
        for name in right:
            priors = SENSORS[name](query, place.poses[query], place.down)
            right[name] += place.answer(query, references, priors).is_right(metric=True)
    assert right["1°"] > right["none"]
