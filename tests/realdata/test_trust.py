"""Acceptance at a stated coverage on real photographs: right answers, and almost nothing else."""

from collections.abc import Callable
from dataclasses import replace
from itertools import chain, combinations

import numpy as np
import pytest

from mapless_server.method.answer import Localization
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.rejection import Advice, Rejection, RejectionReason
from mapless_tools.dataset import Dataset
from research.places import METRIC, OTHERS, Measured, Place, answered, cross_pairs, right_pairs

from .conftest import read_place_once

pytestmark = pytest.mark.realdata

Photographs = Callable[[str], Dataset]
FOUNTAIN, HERZ = "fountain-P11", "herz-jesus-P8"
ALL = LocalizeOptions(coverage=1.0)
"""Whatever passes the gate is answered, with its trust."""
STRANGER_PARTS = 4


@pytest.mark.nightly
def test_right_answers_are_trusted_and_another_place_is_not(photographs: Photographs) -> None:
    """Two surveyed scenes, each photograph from two others of its own scene, and from those of the other one."""
    photographs(FOUNTAIN), photographs(HERZ)
    places = {name: read_place_once(name) for name in (FOUNTAIN, HERZ)}
    right = list(answered(chain.from_iterable(list(right_pairs(it, None, (2,)))[::2] for it in places.values()), ALL))
    assert all(it.right for it in right)
    assert min(trust_of(it) for it in right) >= 0.05
    others = list(answered(cross_pairs(list(places.values()), 2, 4), ALL))
    assert len(others) == 4
    assert not [it.answer.outcome for it in others if isinstance(it.answer.outcome, Localization)]


def test_a_wrong_focal_length_is_reported_with_the_right_one(photographs: Photographs) -> None:
    """A focal length 15 percent off would move the pose by as much of its distance: nearly all of it is estimated."""
    photographs(FOUNTAIN)
    place = read_place_once(FOUNTAIN)
    pair = list(right_pairs(place, None, (4,)))[5]
    given = pair.query.camera
    for factor in (0.85, 1.15):
        camera = replace(given, focal_x_px=factor * given.focal_x_px, focal_y_px=factor * given.focal_y_px)
        (it,) = answered([replace(pair, query=replace(pair.query, camera=camera))], ALL)
        assert isinstance(it.answer.outcome, Rejection)
        focal, *others = it.answer.outcome.intrinsics_checks
        assert focal.conflict
        assert not any(other.conflict for other in others)
        assert focal.estimated == pytest.approx(given.focal_x_px, abs=3 * focal.estimated_sigma)
        assert focal.estimated_sigma < 0.01 * focal.given
        assert it.answer.outcome.hint is not None
        assert it.answer.outcome.hint.advice is Advice.CHECK_CALIBRATION


def test_a_scene_with_half_its_references_moved_is_ambiguous(photographs: Photographs) -> None:
    """The known poses of every second reference are moved by five metres: both places are reported."""
    photographs(FOUNTAIN)
    place = read_place_once(FOUNTAIN)
    shift = np.array([5.0, 0.0, 0.0])
    poses = {i: pose.shifted(shift) if i % 2 else pose for i, pose in place.poses.items()}
    moved = type(place)(place.name, place.views, poses)
    (it,) = answered(list(right_pairs(moved, None, (10,)))[4:5])
    outcome = it.answer.outcome
    assert isinstance(outcome, Rejection), outcome
    assert outcome.reason is RejectionReason.AMBIGUOUS
    centres = [hypothesis.world_from_camera.translation for hypothesis in outcome.hypotheses]
    true = place.poses[4].translation
    off_m = sorted(min(np.linalg.norm(c - true), np.linalg.norm(c - true - shift)) for c in centres)
    assert off_m[-1] < 0.1
    assert np.linalg.norm(centres[0] - centres[1]) == pytest.approx(5.0, abs=0.1)


def all_places() -> dict[str, Place]:
    """Of all metric scenes, and of the others."""
    return {name: read_place_once(name) for name in dict.fromkeys([*(name for name, _ in METRIC), *OTHERS])}


@pytest.mark.nightly
@pytest.mark.timeout(1800)
def test_at_95_percent_coverage_one_percent_is_wrong(photographs: Photographs) -> None:
    """All metric scenes with 10, 5, 3 and 2 references."""
    for name, _ in METRIC:
        photographs(name)
    pairs = chain.from_iterable(right_pairs(all_places()[name], count, (10, 5, 3, 2)) for name, count in METRIC)
    measured = list(answered(pairs, ALL))
    accepted = [it for it in measured if isinstance(it.answer.outcome, Localization) and trust_of(it) >= 0.05]
    right = [it for it in measured if it.right]
    assert sum(it.right for it in accepted) >= 0.93 * len(right), "coverage as stated, within what a sample may vary"
    assert sum(not it.right for it in accepted) <= 0.01 * len(accepted)


@pytest.mark.nightly
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("part", range(STRANGER_PARTS))
def test_no_query_is_localized_in_another_place(photographs: Photographs, part: int) -> None:
    """A part of over 500 pairs of a query and references of another place: 14 queries of each, or all it has."""
    for name in OTHERS:
        photographs(name)
    pairs_of_places = list(combinations(all_places().values(), 2))[part::STRANGER_PARTS]
    others = list(answered(chain.from_iterable(cross_pairs(pair, 14) for pair in pairs_of_places), ALL))
    assert len(others) == sum(min(14, len(place.views)) for pair in pairs_of_places for place in pair) >= 100
    assert not [it.pair.title for it in others if isinstance(it.answer.outcome, Localization)]


def trust_of(measured: Measured) -> float:
    """Of what is answered; 0 of what is not."""
    outcome = measured.answer.outcome
    return outcome.trust or 0.0 if isinstance(outcome, Localization) else 0.0
