"""Gravity on real photographs: a good answer keeps every bit, and an upside-down prior is reported."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.answer import Localization
from mapless_server.method.priors.known import NO_PRIORS, GravityPrior, Priors
from mapless_tools.dataset import Dataset
from research.places import Measured, Pair, Place, answered, right_pairs

from .conftest import read_place_once

pytestmark = pytest.mark.realdata

FOUNTAIN, OFFICE = "fountain-P11", "tum-fr3-office"
SENSORS = {"none": 0.0, "1°": 1.0, "upside down": -1.0}
"""Signs of what an accelerometer with a noise of 1 degree measures; without one, 0."""


def sensed(query: int, world_from_camera: RigidTransform, down_in_world: Array, sign: float) -> Priors:
    if not sign:
        return NO_PRIORS
    right = world_from_camera.rotation.T @ down_in_world
    noise = np.random.default_rng(query).normal(0, math.radians(1.0), 3)
    down = sign * rotation_from_vector(noise - right * (right @ noise)) @ right
    return Priors(gravity=GravityPrior(down / np.linalg.norm(down), down_in_world, 1.0))


def measured(pairs: Sequence[Pair], place: Place, names: Sequence[str]) -> dict[str, list[Measured]]:
    """Down is what most photographs of the place call down."""
    down = np.mean([pose.rotation[:, 1] for pose in place.poses.values()], axis=0)
    down /= np.linalg.norm(down)

    def with_priors(sign: float) -> Iterator[Pair]:
        for i, pair in enumerate(pairs):
            assert pair.true_pose is not None
            yield replace(pair, priors=sensed(i, pair.true_pose, down, sign))

    return {name: list(answered(with_priors(SENSORS[name]))) for name in names}


def is_right(it: Measured) -> bool:
    return it.right and isinstance(it.answer.outcome, Localization)


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
        assert none.off
        assert right.off
        assert right.off[0] == pytest.approx(none.off[0], abs=1e-3)
        assert upside_down.off == none.off


def test_a_weak_answer_gains(photographs: Callable[[str], Dataset]) -> None:
    """No reference within three frames: with gravity more of these photographs are localized."""
    photographs(OFFICE)
    place = read_place_once(OFFICE)
    found = measured(list(right_pairs(place, None, (5,), frames_apart=3))[2:6], place, ("none", "1°"))
    assert sum(map(is_right, found["1°"])) > sum(map(is_right, found["none"]))
