"""Adoption of localized photographs, and retirement of references: decisions on planted values."""

from collections.abc import Mapping

import cv2
import numpy as np
import pytest

from mapless import AdoptionPolicy
from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.scenes.adoption import policy as rules
from mapless_server.scenes.adoption.policy import AdoptionOptions, Evidence, Refusal
from mapless_server.scenes.adoption.viewpoints import Viewpoints, surveyed_viewpoints
from mapless_server.scenes.retrieval.index import SceneIndex
from mapless_server.security import Principal, Role
from mapless_server.store.records import IndexedReference, SceneChanges, Standing

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
    share = 0.0 if surveyed is None else surveyed.inlier_count / answered.inlier_count
    assert rules.refusal(POLICY, answered, surveyed, share, OPTIONS) == refused


def test_more_matches_of_what_the_survey_explains_leave_its_share() -> None:
    """So adopted references, which find more of what has not changed, make no survey look outdated."""
    surveyed, size = np.array([[100.0, 100.0], [400.0, 300.0]]), (640, 480)
    nearby = np.concatenate([surveyed + [dx, dy] for dx in (-2, 0, 2) for dy in (-2, 0, 2)])
    assert rules.surveyed_share(size, nearby, surveyed, OPTIONS) > 0.8
    elsewhere = np.concatenate([nearby, nearby + [120.0, 60.0]])
    assert 0.4 < rules.surveyed_share(size, elsewhere, surveyed, OPTIONS) < 0.5
    assert rules.surveyed_share(size, surveyed, np.empty((0, 2)), OPTIONS) == 0.0
    assert rules.surveyed_share(size, np.empty((0, 2)), surveyed, OPTIONS) == 0.0


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


def test_only_what_looks_about_the_same_way_should_show_it() -> None:
    centres = np.array([[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0]])
    axes = np.array([[0.0, 0, -1], [0.0, 0, 1], [0.0, 0, 1]])
    np.testing.assert_array_equal(rules.should_show(centres, axes, at(0.8), 2.0, OPTIONS), [1])
    assert not len(rules.should_show(centres, axes, at(0.8, 20.0), 2.0, OPTIONS))


def shown(known: Standing, share: float, days: int, *holders: str, each: int = 1) -> Standing:
    """The standing of a place after photographs on so many further days, `each` of each of these holders."""
    first = int(known.surveyed_by[-1].partition(":")[0]) + 1 if known.surveyed_by else 10_000
    for day in range(first, first + days):
        for holder in holders * each:
            known = rules.with_share(known, share, day * rules.DAY_US, holder, OPTIONS)
    return known


@pytest.mark.parametrize(
    ("days", "holders", "is_outdated"),
    [
        (5, ("",), True),
        (4, ("",), False),  # one of each holder counts a day
        (3, ("one", "two"), True),
        (2, ("one", "two", "three"), False),  # on two days
        (1000, ("one",), False),  # of one holder
    ],
)
def test_photographs_of_days_and_holders_outdate_a_place(
    days: int, holders: tuple[str, ...], is_outdated: bool
) -> None:
    known = shown(Standing(), 0.1, days, *holders, each=20)
    assert rules.needs_survey(known, POLICY, OPTIONS) is is_outdated


def test_one_holder_outdates_no_place_that_others_confirm() -> None:
    known = Standing()
    for _ in range(20):
        known = shown(known, 0.0, 1, "attacker", each=20)
        known = shown(known, 0.9, 1, "one")
    assert not rules.needs_survey(known, POLICY, OPTIONS)
    assert known.surveyed_share == pytest.approx(0.45)


def test_one_holder_keeps_no_place_current_that_two_see_changed() -> None:
    known = Standing()
    for _ in range(10):
        known = shown(known, 1.0, 1, "attacker", each=20)
        known = shown(known, 0.1, 1, "one", "two")
    assert rules.needs_survey(known, POLICY, OPTIONS)


def test_a_busy_day_leaves_days_before_remembered() -> None:
    known = shown(Standing(), 0.1, 4, *(f"holder-{i}" for i in range(100)))
    assert len({it.partition(":")[0] for it in known.surveyed_by}) >= OPTIONS.contradicting_days
    assert rules.needs_survey(known, POLICY, OPTIONS)


def test_a_photograph_counts_for_the_places_around_it() -> None:
    centres = np.array([[0.0, 0, 0], [0.5, 0, 0], [1.0, 0, 0], [3.0, 0, 0], [0.1, 0, 0]])
    axes = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, -1]])

    def around(x_m: float, distance_m: float, ahead: float = 1.0) -> list[int]:
        centre, axis = np.array([x_m, 0, 0]), np.array([0.0, np.sqrt(1 - ahead**2), ahead])
        return Viewpoints(centres, axes).around(centre, axis, OPTIONS.places, distance_m)

    assert around(0.1, 2.0) == [0, 1, 2]
    assert around(0.1, 0.2) == [0]
    assert around(0.1, 10.0) == [0, 1, 2, 3]
    assert around(9.0, 1.0) == [3]
    assert around(0.1, 2.0, ahead=0.0) == [4]  # none looks there


def test_places_in_the_tree_are_those_of_all_references() -> None:
    """Planted among 6,000: ties, photographs whose direction few references or none look in, and far ones."""
    generator = np.random.default_rng(8)
    centres = np.repeat(generator.uniform(0, 30, (1500, 3)), 4, axis=0)
    axes = generator.normal(size=centres.shape) * [1, 1, 0.2]
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    viewpoints = Viewpoints(centres, axes)
    for turn in np.linspace(0, np.pi / 2, 40):
        position, forward = generator.uniform(-20, 50, 3), np.array([np.cos(turn), 0, np.sin(turn)])
        distance = np.linalg.norm(centres - position, axis=1)
        looks = axes @ forward > 0.5
        order = np.argsort(np.where(looks, distance, np.inf), kind="stable")[: min(5, looks.sum())]
        assert viewpoints.looking(position, forward, 5).tolist() == order.tolist()
        nearest = order[0] if len(order) else distance.argmin()
        assert (viewpoints.place(position, forward), viewpoints.place(position, None)) == (nearest, distance.argmin())


def test_a_tree_is_made_once_per_generation() -> None:
    index = SceneIndex(4)
    added = [IndexedReference(name, f"key-{name}", HERE, None) for name in "abc"]
    index.apply(SceneChanges(1, tuple(added[:2]), frozenset(), True))
    rows, first = surveyed_viewpoints(index.entries(), lambda: ["key-b"])
    assert rows.tolist() == [0]
    assert surveyed_viewpoints(index.entries(), lambda: ["key-b"])[1] is first
    index.apply(SceneChanges(2, tuple(added[2:]), frozenset(), False))
    assert surveyed_viewpoints(index.entries(), lambda: ["key-b"])[0].tolist() == [0, 2]


def contradicted(days: int, *holders: str, each: int = 1) -> Standing:
    """The standing after photographs on so many days, `each` of each of these holders."""
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
    assert rules.is_contradicted(contradicted(3, *"abcdefgh"), OPTIONS)
    assert not rules.is_contradicted(contradicted(4, ""), OPTIONS)
    assert rules.is_contradicted(contradicted(5, ""), OPTIONS)


@pytest.mark.parametrize("honest", [1, 2])
def test_one_mistake_helps_an_attacker_to_retire_nothing(honest: int) -> None:
    """Two photographs of others are needed, however many an attacker sends, for references and for places."""
    known = contradicted(4, "attacker")
    place = shown(Standing(), 0.1, 8, "attacker")
    for day in range(4, 4 + honest):
        known = rules.with_photograph(known, 0.0, 10**15 + day * rules.DAY_US, "one", OPTIONS)
        place = rules.with_share(place, 0.1, 10**15 + (4 + day) * rules.DAY_US, "one", OPTIONS)
    assert rules.is_contradicted(known, OPTIONS) is rules.needs_survey(place, POLICY, OPTIONS) is (honest == 2)


def test_a_holder_is_a_token_of_a_tenant() -> None:
    named = Principal("acme", Role.LOCALIZE, "robot")
    assert rules.holder_of(named) != rules.holder_of(Principal("other", Role.LOCALIZE, "robot"))
    assert rules.holder_of(named) != rules.holder_of(Principal("acme", Role.LOCALIZE, "robot2"))
    assert rules.holder_of(Principal("acme", Role.WRITE, "operator")) == ""


def test_usefulness_is_a_running_mean() -> None:
    assert rules.with_usefulness(0.2, 0.0, OPTIONS) == pytest.approx(0.18)
    assert rules.with_usefulness(0.1, 1.0, OPTIONS, is_own=True) == pytest.approx(0.11)  # as a new one
    assert rules.with_usefulness(0.8, 1.0, OPTIONS, is_own=True) == 0.8  # as others have found it
