"""Reports of scenes: photographs become counts by place, and counts become suggestions; planted values."""

from collections.abc import Mapping

import numpy as np
import pytest

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.rejection import RejectionReason
from mapless_server.scenes.report import renewal
from mapless_server.scenes.report.counting import Places, Sighting, counted
from mapless_server.scenes.report.renewal import added_days
from mapless_server.scenes.report.summary import Cluster, Period, PlaceCounts, Recent, recent_of, suggestions
from mapless_server.scenes.retrieval.index import SceneIndex
from mapless_server.store.counts import DAY_US, LOCALIZED, CountKey, Sums
from mapless_server.store.records import Adopted, IndexedReference, SceneChanges
from mapless_server.store.reporting import Answered, Days, OutcomeSums, PeriodSums
from mapless_server.store.surveys import Surveyed

DAY = 20_000
LOW, GATE, DARK = (it.value for it in (RejectionReason.LOW_OVERLAP, RejectionReason.GATE, RejectionReason.LOW_TEXTURE))


def at(x_m: float, turned_deg: float = 0.0) -> RigidTransform:
    return RigidTransform(rotation_from_vector([0.0, np.radians(turned_deg), 0.0]), np.array([x_m, 0.0, 0.0]))


POSES = {"a": at(0.0), "b": at(10.0), "adopted": at(9.0)}


@pytest.fixture
def places() -> Places:
    """Two surveyed references, 10 m apart, and one that was adopted between them, at the place of b."""
    index = SceneIndex(4)
    added = tuple(IndexedReference(name, f"key-{name}", pose, None) for name, pose in POSES.items())
    index.apply(SceneChanges(1, added, frozenset(), True))
    return Places(index.entries(), [Adopted("adopted", "key-adopted", "key-b", 0.5, False)])


def seen(outcome: str = LOW, position: Array | None = None, forward: Array | None = None, like: str = "") -> Sighting:
    return Sighting(DAY * DAY_US + 5, outcome, position, None, forward, like)


def by_prior(position: list[float], sigmas_m: list[float], like: str) -> Sighting:
    return Sighting(DAY * DAY_US, LOW, np.array(position), np.diag(np.square(sigmas_m)), None, like)


@pytest.mark.parametrize(
    ("sighting", "place_key"),
    [
        (seen(position=np.array([4.0, 0.0, 0.0])), "key-a"),
        (seen(position=np.array([8.9, 0.0, 0.0])), "key-b"),
        (seen(position=np.array([4.0, 0.0, 0.0]), like="b"), "key-a"),
        (seen(like="b"), "key-b"),
        (seen(like="adopted"), "key-b"),
        (seen(like="gone"), ""),
        (seen(), ""),
    ],
)
def test_a_photograph_counts_at_its_place(places: Places, sighting: Sighting, place_key: str) -> None:
    (key,) = counted([sighting], places)
    assert key == CountKey(DAY, place_key, LOW)


def test_rejected_positions_are_summed_around_their_place(places: Places) -> None:
    found = counted([seen(position=np.array([12.0, y, 0.0]), forward=np.array([0, 0, 1.0])) for y in (-1, 1)], places)
    cluster = Cluster.of(found[CountKey(DAY, "key-b", LOW)], POSES["b"])
    assert cluster is not None
    np.testing.assert_allclose(cluster.position, [12.0, 0.0, 0.0])
    assert cluster.spread_m == pytest.approx(1.0)
    assert cluster.forward is not None
    np.testing.assert_allclose(cluster.forward, [0.0, 0.0, 1.0])


def test_the_surveyed_share_is_that_of_the_matches(places: Places) -> None:
    pose = POSES["b"]
    it = Sighting(5, LOCALIZED, pose.translation, None, pose.rotation[:, 2], "b", 80, 0.02, {"b": 60, "adopted": 20})
    other = Sighting(5, LOCALIZED, pose.translation, None, pose.rotation[:, 2], "b", 40, 0.08, {"b": 40})
    jointly = Sighting(5, LOCALIZED, reference_id="b", radius_m=0.04)
    ((key, sums),) = counted([it, other, jointly], places).items()
    found = period({key.outcome: Answered(*(getattr(sums, name) for name in Answered._fields))})
    assert found.localized.photograph_count == 3
    assert found.means == pytest.approx((0.875, 0.04, 60.0))  # the geometric mean of the radii


@pytest.fixture
def upstairs() -> Places:
    """Nine surveyed references on a floor at a height of 9 m, every 2 m along x, and as many on that at 0 m."""
    index = SceneIndex(4)
    poses = {f"{z}-{x}": RigidTransform(np.eye(3), np.array([x, 0.0, z])) for z in (9, 0) for x in range(0, 18, 2)}
    added = tuple(IndexedReference(name, f"key-{name}", pose, None) for name, pose in poses.items())
    index.apply(SceneChanges(1, added, frozenset(), True))
    return Places(index.entries(), [])


@pytest.mark.parametrize(
    ("sighting", "position"),
    [
        (by_prior([4.0, 0, 0], [0.1, 0.1, 1000], "9-6"), [4.0, 0, 9]),  # a receiver that gives no height
        (by_prior([4.0, 1, 9], [0.1, 0.1, 0.1], "9-16"), [4.0, 1, 9]),
        (by_prior([0.0, 0, 0], [300, 300, 1000], "9-6"), [6.0, 0, 9]),  # an address
        (by_prior([4.0, 0, 0], [0.1, 0.1, 0.1], ""), [4.0, 0, 0]),
        (by_prior([4.0, 0, 0], [0.1, 0.1, 1000], ""), None),
        (by_prior([900.0, 0, 9], [0.1, 0.1, 0.1], "9-6"), None),  # wrong
    ],
)
def test_a_prior_counts_as_far_as_it_is_certain(
    upstairs: Places, sighting: Sighting, position: list[float] | None
) -> None:
    found = upstairs.position(sighting)
    assert found == (None if position is None else pytest.approx(np.array(position), abs=0.02))


def test_one_wrong_prior_does_not_move_the_mean(upstairs: Places) -> None:
    right = [by_prior([8.0, 3, 9], [0.01] * 3, "9-8")] * 9
    found = counted([*right, by_prior([2000.0, 0, 9], [0.01] * 3, "9-8")], upstairs)
    sums = found[CountKey(DAY, "key-9-8", LOW)]
    cluster = Cluster.of(sums, RigidTransform(np.eye(3), np.array([8.0, 0, 9])))
    assert cluster is not None
    assert (sums.photograph_count, cluster.count) == (10, 9)
    np.testing.assert_allclose(cluster.position, [8, 3, 9], atol=0.01)


def test_a_scene_without_surveyed_references_has_no_places() -> None:
    index = SceneIndex(4)
    index.apply(SceneChanges(1, (), frozenset(), True))
    found = counted([seen(position=np.zeros(3)), seen(like="a")], Places(index.entries(), []))
    assert found == {CountKey(DAY, "", LOW): Sums(photograph_count=2)}


def period(of_outcome: Mapping[str, Answered]) -> Period:
    counts = PlaceCounts()
    for outcome, answered in of_outcome.items():
        counts.add(PeriodSums("p", 0, outcome, answered, 0.0))
    return counts.period(0, Days(DAY, DAY, 1))


def test_periods_end_with_the_last_day() -> None:
    found = [PlaceCounts().period(age, Days(DAY - 9, DAY, 7)) for age in (1, 0)]
    assert [(it.first_day - DAY, it.last_day - DAY) for it in found] == [(-9, -7), (-6, 0)]


def test_the_commonest_rejection_comes_first() -> None:
    found = period({LOW: Answered(2), GATE: Answered(5), LOCALIZED: Answered(9)})
    assert found.rejections == [(RejectionReason.GATE, 5), (RejectionReason.LOW_OVERLAP, 2)]


def recent(*outcomes: tuple[float, str, int]) -> Recent:
    """Photographs with so many half-lives of age, an outcome and a number each."""
    found = [OutcomeSums("p", it, Sums(n), Sums(2.0**-age * n)) for age, it, n in outcomes]
    return recent_of(found)["p"]


def test_the_place_that_lacks_references_is_suggested_first() -> None:
    """A place that is nearly always localized needs none, none rescues bad photographs, and old ones count less."""
    planted = {
        "corner": recent((0, LOW, 6), (0.1, GATE, 3), (0, LOCALIZED, 1)),
        "covered": recent((0, LOW, 12), (0, LOCALIZED, 400)),
        "dark": recent((0, DARK, 50)),
        "old": recent((2, LOW, 20)),
        "unknown": recent((0, LOW, 90)),
    }
    poses = {name: at(i) for i, name in enumerate(planted) if name != "unknown"}
    found = suggestions(planted, poses)
    assert [it.place_key for it in found] == ["corner", "old"]
    rejected = 6 + 3 * 2**-0.1
    assert found[0].rescued_count == pytest.approx(rejected**2 / (rejected + 1))
    assert found[1].rescued_count == pytest.approx(5.0)
    assert (found[0].reason, found[0].rejected_count, found[0].photograph_count) == (RejectionReason.LOW_OVERLAP, 9, 10)


def test_a_suggestion_is_where_photographs_were_taken() -> None:
    sums = Sums(4, position_count=3, offset_x=9.0, squared_offset=27.0, forward_x=3.0)
    (found,) = suggestions(recent_of([OutcomeSums("p", LOW, sums, sums)]), {"p": at(10.0)})
    np.testing.assert_allclose(found.position, [13.0, 0.0, 0.0])
    np.testing.assert_allclose(found.forward, [1.0, 0.0, 0.0])
    assert [found.distance_m, found.positioned_share] == pytest.approx([3.0, 0.75])


def test_without_positions_it_is_where_the_reference_is() -> None:
    (found,) = suggestions({"p": recent((0, LOW, 4))}, {"p": at(10.0, 90.0)})
    np.testing.assert_allclose(found.position, [10.0, 0.0, 0.0])
    np.testing.assert_allclose(found.forward, [1.0, 0.0, 0.0], atol=1e-12)
    assert found.distance_m == 0


def test_directions_that_cancel_are_unknown() -> None:
    cluster = Cluster.of(Sums(2, position_count=2), at(1.0))
    assert cluster is not None
    assert cluster.forward is None


def test_a_reference_is_added_at_an_older_ones_place() -> None:
    """Two of one day renew no other; what is added later is at the older one that is nearest and looks as it does."""
    stored = {"a": (0, at(0.0)), "b": (0, at(10.0)), "c": (7, at(6.0)), "d": (8, at(9.0, 180.0)), "e": (9, at(6.5))}
    surveyed = [Surveyed(key, (DAY + day) * DAY_US, pose) for key, (day, pose) in stored.items()]
    assert added_days(surveyed, DAY) == {"b": DAY + 8, "c": DAY + 9}
    assert added_days(surveyed[:2], DAY) == added_days([], DAY) == {}


@pytest.mark.parametrize("most", [7, 30, 100])
@pytest.mark.parametrize("first", [0, 5])
def test_many_days_of_adding_are_as_one_by_one(monkeypatch: pytest.MonkeyPatch, most: int, first: int) -> None:
    """Each of the last ones is at the nearest of days before that looks within 60 degrees, or else at the nearest."""
    monkeypatch.setattr(renewal, "MOST_ADDED", most)
    random = np.random.default_rng(most)
    days = random.integers(0, 12, 60).tolist()  # about five a day
    poses = [at(x, turned) for x, turned in random.uniform([-9, -180], [9, 180], (60, 2))]
    surveyed = [Surveyed(f"r{i}", (DAY + days[i]) * DAY_US + 7, poses[i]) for i in range(60)]
    expected, in_order = dict[str, int](), sorted(range(60), key=lambda it: days[it])
    for i in in_order[-most:]:
        before, axis = [it for it in in_order if days[it] < days[i]], poses[i].rotation[:, 2]
        alike = [it for it in before if poses[it].rotation[:, 2] @ axis > 0.5] or before
        if alike and days[i] >= first:
            distances = [np.linalg.norm(poses[it].translation - poses[i].translation) for it in alike]
            expected[surveyed[alike[int(np.argmin(distances))]].key] = DAY + days[i]
    assert added_days(surveyed, DAY + first) == expected
