"""Gravity on real photographs: a good answer keeps every bit, and an upside-down prior is reported."""

from collections.abc import Callable, Sequence

import pytest

from mapless_server.method.answer import Localization
from mapless_tools.dataset import Dataset
from research.gravity import SENSORS, error_of, is_right, sensed
from research.places import Measured, Pair, Place, answered, right_pairs

from .conftest import read_place_once

pytestmark = pytest.mark.realdata

FOUNTAIN, OFFICE = "fountain-P11", "tum-fr3-office"


def measured(pairs: Sequence[Pair], place: Place, names: Sequence[str]) -> dict[str, list[Measured]]:
    return {name: list(answered(sensed(pairs, place, SENSORS[name]))) for name in names}


def checks(it: Measured) -> tuple[bool, bool]:
    """Whether a prior contradicts the answer, and whether one was used."""
    assert isinstance(it.answer.outcome, Localization)
    found = it.answer.outcome.prior_checks
    return any(check.conflict for check in found), any(check.used for check in found)


def test_gravity_neither_moves_nor_loses_a_good_answer(photographs: Callable[[str], Dataset]) -> None:
    photographs(FOUNTAIN)
    place = read_place_once(FOUNTAIN)
    found = measured(list(right_pairs(place, None, (3,)))[::4], place, ("none", "1°", "upside down"))
    for none, right, upside_down in zip(*found.values(), strict=True):
        assert is_right(none)
        assert (checks(right)[0], checks(upside_down)) == (False, (True, False))
        assert error_of(right)[0] == pytest.approx(error_of(none)[0], abs=1e-3)
        assert error_of(upside_down) == error_of(none)


def test_a_weak_answer_gains(photographs: Callable[[str], Dataset]) -> None:
    """No reference within three frames: with gravity more of these photographs are localized."""
    photographs(OFFICE)
    place = read_place_once(OFFICE)
    found = measured(list(right_pairs(place, None, (5,), frames_apart=3))[2:6], place, ("none", "1°"))
    assert sum(map(is_right, found["1°"])) > sum(map(is_right, found["none"]))
