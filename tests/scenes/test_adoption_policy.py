"""Which localized photographs become references, and when references are retired: decisions on planted values."""

from collections.abc import Mapping

import cv2
import numpy as np
import pytest

from mapless import AdoptionPolicy
from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.scenes.adoption import policy as rules
from mapless_server.scenes.adoption.policy import AdoptionOptions, Evidence, Refusal
from mapless_server.security import Principal, Role
from mapless_server.store.records import Standing

POLICY, OPTIONS = AdoptionPolicy(), AdoptionOptions()
HERE = RigidTransform(np.eye(3), np.zeros(3))


def at(x_m: float = 0.0, turned_deg: float = 0.0) -> RigidTransform:
    return RigidTransform(rotation_from_vector([0.0, np.radians(turned_deg), 0.0]), np.array([x_m, 0.0, 0.0]))


def evidence(
    pose: RigidTransform = HERE,
    radius_m: float = 0.01,
    trust: float = 0.8,
    count: int = 100,
    inliers_of: Mapping[str, int] | None = None,
) -> Evidence:
    of = {"a": 60, "b": 40} if inliers_of is None else inliers_of
    return Evidence(pose, radius_m, 2 * radius_m, 0.2, 0.4, trust, count, of, np.eye(6))


@pytest.mark.parametrize(
    ("answered", "surveyed", "refused"),
    [
        (evidence(), evidence(), None),
        (evidence(trust=0.4), evidence(), Refusal.UNCERTAIN),
        (evidence(radius_m=0.04), evidence(), Refusal.UNCERTAIN),
        (evidence(), None, Refusal.UNSUPPORTED),
        (evidence(), evidence(trust=0.4), Refusal.UNSUPPORTED),
        (evidence(), evidence(count=29), Refusal.UNSUPPORTED),
        (evidence(), evidence(inliers_of={"a": 93, "b": 7}), Refusal.UNSUPPORTED),
        (evidence(count=200), evidence(count=59), Refusal.LITTLE_SURVEYED),
        (evidence(count=200), evidence(count=60), None),
        (evidence(), evidence(at(0.07)), Refusal.DISAGREES),
        (evidence(), evidence(at(turned_deg=1.5)), Refusal.DISAGREES),
        (evidence(), evidence(at(0.04, 0.8)), None),
    ],
)
def test_a_photograph_needs_surveyed_support(answered: Evidence, surveyed: Evidence | None, refused: Refusal) -> None:
    assert rules.refusal(POLICY, answered, surveyed, OPTIONS) == refused


def test_what_no_match_explains_is_new() -> None:
    explained = rules.explained((640, 480), np.array([[100.0, 100.0]]), OPTIONS)
    assert explained.sum() == pytest.approx(np.pi * 26**2, rel=0.02)
    keypoints = np.array([[100.0, 110.0], [300.0, 300.0], [639.4, 479.4], [120.0, 100.0]])
    assert rules.novelty(keypoints, explained) == 0.5
    assert rules.novelty(np.empty((0, 2)), explained) == 0.0


def test_a_mask_ignores_what_is_explained() -> None:
    explained = rules.explained((64, 48), np.array([[10.0, 20.0]]), OPTIONS)
    decoded = cv2.imdecode(np.frombuffer(rules.mask_of(explained), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(decoded == 0, explained)


def test_a_place_is_that_of_the_nearest_similar_viewpoint() -> None:
    centres = np.array([[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0]])
    axes = np.array([[0.0, 0, -1], [0.0, 0, 1], [0.0, 0, 1]])
    assert rules.nearest_viewpoint(centres, axes, at(0.2)) == 1
    assert rules.nearest_viewpoint(centres, -np.abs(axes), at(0.2)) == 0
    np.testing.assert_array_equal(rules.should_show(centres, axes, at(0.8), 2.0, OPTIONS), [1])
    assert not len(rules.should_show(centres, axes, at(0.8, 20.0), 2.0, OPTIONS))


def test_a_place_is_outdated_by_several_photographs() -> None:
    known = Standing()
    for _ in range(4):
        known = rules.with_share(known, 0.1, OPTIONS)
    assert not rules.is_outdated(known, POLICY, OPTIONS)
    assert rules.is_outdated(rules.with_share(known, 0.1, OPTIONS), POLICY, OPTIONS)
    for _ in range(10):
        known = rules.with_share(known, 0.9, OPTIONS)
    assert not rules.is_outdated(known, POLICY, OPTIONS)


def contradicted(days: int, *holders: str, each: int = 1) -> Standing:
    """What is known after photographs on so many days, `each` of each of these holders."""
    known = Standing()
    for photograph in range(days * each):
        now_us = 10**15 + photograph // each * rules.DAY_US
        for holder in holders:
            known = rules.with_photograph(known, 0.0, now_us, holder, OPTIONS)
    return known


def test_contradictions_count_in_a_row_one_a_day() -> None:
    known = contradicted(2, "one", each=1000)
    assert known.contradiction_count == 2
    now_us = 10**15 + 2 * rules.DAY_US
    assert rules.with_photograph(known, 0.07, now_us, "one", OPTIONS) == known
    assert rules.with_photograph(known, 0.1, now_us, "one", OPTIONS) == Standing(0, known.contradiction_time_us)


def test_one_holder_or_one_day_retires_no_reference() -> None:
    assert not rules.is_contradicted(contradicted(1000, "one", each=2), OPTIONS)
    assert not rules.is_contradicted(contradicted(2, *"abcdefgh"), OPTIONS)
    assert not rules.is_contradicted(contradicted(2, "one", "two"), OPTIONS)
    assert rules.is_contradicted(contradicted(3, "one", "two"), OPTIONS)
    assert not rules.is_contradicted(contradicted(4, ""), OPTIONS)
    assert rules.is_contradicted(contradicted(5, ""), OPTIONS)


def test_a_holder_is_a_token_of_a_tenant() -> None:
    named = Principal("acme", Role.LOCALIZE, "robot")
    assert rules.holder_of(named) != rules.holder_of(Principal("other", Role.LOCALIZE, "robot"))
    assert rules.holder_of(named) != rules.holder_of(Principal("acme", Role.LOCALIZE, "robot2"))
    assert rules.holder_of(Principal("acme", Role.WRITE, "operator")) == ""


def test_usefulness_is_a_running_mean() -> None:
    assert rules.with_usefulness(0.2, 0.0, OPTIONS) == pytest.approx(0.18)
