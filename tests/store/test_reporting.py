"""Reports of scenes, for which the database adds counts up, say what their plain twin says; on either database."""

from datetime import date, timedelta

import numpy as np
import pytest
from sqlalchemy import event
from support.plain_reports import plain_period, plain_places, plain_rejected, plain_suggestions, stored_counts
from support.stores import Place, make_reference

from mapless.v1 import localization_service_pb2 as localization_pb
from mapless.v1 import reference_service_pb2 as pb
from mapless_server.method.rejection import RejectionReason
from mapless_server.security import SceneKey
from mapless_server.services import reports
from mapless_server.services.messages.enums import enum_to_message
from mapless_server.services.reports import scene_report
from mapless_server.store import Store, adoption, counts
from mapless_server.store.counts import LOCALIZED, CountKey, Sums, happening

HALL = SceneKey("hall")
FIRST, LAST = 20_000, 20_039
OUTCOMES = (LOCALIZED, "low_overlap", "gate", "low_texture")


def planted(keys: dict[str, str]) -> dict[CountKey, Sums]:
    """Counts of 42 days, of which the report has 40, at places of references, of a deleted one, and of unknown ones."""
    random, found = np.random.default_rng(5), {}
    for day in range(FIRST - 1, LAST + 2):
        for place in (*(keys[it] for it in "abc"), "deleted", "also-deleted", ""):
            for outcome in OUTCOMES:
                n, known = (int(it) for it in random.integers(0, 5, 2))
                sums = random.normal(size=6).tolist()
                if outcome == LOCALIZED:
                    its = Sums(n, n, 0.7 * n, 50 * n, n, -3.0 * n)
                else:
                    x, y, z, *forward = sums
                    its = Sums(n, 0, 0.0, 0, 0, 0.0, min(n, known), x, y, z, 9.0 * n, *forward)
                if n:
                    found[CountKey(day, place, outcome)] = its
        found[CountKey(day, "", happening("adoptions", "adopted"))] = Sums(day % 3 + 1)
    return found


def day_text(day: int) -> str:
    return (date(1970, 1, 1) + timedelta(day)).isoformat()


def day_of(text: str) -> int:
    return (date.fromisoformat(text) - date(1970, 1, 1)).days


def numbers(period: pb.PeriodCounts) -> tuple[dict[str, int], list[float]]:
    """Photographs by outcome, and means."""
    names = {enum_to_message(it, localization_pb.RejectionReason): it.value for it in RejectionReason}
    by_outcome = {names[it.reason]: it.count for it in period.rejections}
    localized = {LOCALIZED: period.localized_count} if period.localized_count else {}
    return by_outcome | localized, [period.surveyed_share, period.position_68_m, period.inlier_count]


@pytest.mark.parametrize("days_per_period", [1, 7, 366])
def test_a_report_is_its_plain_twin(store: Store, monkeypatch: pytest.MonkeyPatch, days_per_period: int) -> None:
    store.create_scene(HALL)
    records = {it.key: it for it in store.add_references(HALL, [make_reference(it) for it in "abc"])}
    keys = {it.reference_id: it.key for it in records.values()}
    counts.add_counts(store.database, {HALL: planted(keys)})
    added = {keys["b"]: FIRST + 9, keys["c"]: LAST}
    monkeypatch.setattr("mapless_server.scenes.report.renewal.added_days", lambda *_: added)
    request = pb.GetSceneReportRequest(first_day=day_text(FIRST), last_day=day_text(LAST))
    request.days_per_period = days_per_period
    report = scene_report(store, HALL, request)

    everything = stored_counts(store, HALL, FIRST, LAST)
    answers = {key: sums for key, sums in everything.items() if ":" not in key.outcome}
    places = plain_places(answers, records)
    ids = [records[it].reference_id if it else "" for it in places]
    assert [it.reference.rpartition("/")[2] for it in report.places] == ids
    of_places = zip((it.periods for it in report.places), places.values(), strict=True)
    for messages, its in [(report.periods, answers), *of_places]:
        for message in messages:
            number, means = plain_period(its, day_of(message.first_day), day_of(message.last_day))
            found, found_means = numbers(message)
            assert found == number
            assert found_means == pytest.approx(means)
    assert sum(it.adoptions["adopted"] for it in report.periods) == sum(
        sums.photograph_count for key, sums in everything.items() if ":" in key.outcome
    )
    assert (report.periods[0].first_day, report.periods[-1].last_day) == (day_text(FIRST), day_text(LAST))
    for place, (key, its) in zip(report.places, places.items(), strict=True):
        sums = plain_rejected(its)
        assert place.rejected_position.photograph_count == (sums.position_count if key else 0)
        if key:
            x = records[key].world_from_camera.translation[0] + sums.offset_x / sums.position_count
            assert place.rejected_position.position.x == pytest.approx(x)
    expected = plain_suggestions(places, records, added, LAST)
    assert len(report.suggestions) == len(expected) == 2
    for suggested in report.suggestions:
        rescued, rejected, count, reason, distance_m = expected[keys[suggested.place.rpartition("/")[2]]]
        assert suggested.photograph_count == pytest.approx(rescued)
        assert suggested.distance_m == pytest.approx(distance_m)
        assert f"{rejected} of {count} photographs" in suggested.message
        assert f"most often {RejectionReason(reason).name} " in suggested.message


def test_references_added_on_many_days_renew_their_places(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each place from its own day on; and the number of statements is that for one."""
    monkeypatch.setattr("mapless_server.scenes.report.summary.MOST_SUGGESTIONS", 100)
    store.create_scene(HALL)
    records = {it.key: it for it in store.add_references(HALL, [make_reference(f"r{it}") for it in range(60)])}
    random, keys, its = np.random.default_rng(3), list(records), dict[CountKey, Sums]()
    for key in keys[:50]:
        for day in random.choice(np.arange(FIRST, LAST + 1), 5, replace=False).tolist():
            for outcome in OUTCOMES[:3]:
                n, x = int(random.integers(1, 9)), float(random.normal())
                its[CountKey(day, key, outcome)] = Sums(n, position_count=n, offset_x=x)
    counts.add_counts(store.database, {HALL: its})
    request, executed, statements = pb.GetSceneReportRequest(last_day=day_text(LAST)), list[str](), list[int]()
    request.first_day = day_text(FIRST)
    with store.database.read() as connection:
        event.listen(connection.engine, "before_cursor_execute", lambda *its: executed.append(its[2]))
    for places in (keys[:1], keys[10:]):  # the last ten have no photographs
        added = {key: FIRST + i % 40 for i, key in enumerate(places)}
        monkeypatch.setattr("mapless_server.scenes.report.renewal.added_days", lambda *_, it=added: it)
        executed.clear()
        report = scene_report(store, HALL, request)
        statements.append(len(executed))
        expected = plain_suggestions(plain_places(its, records), records, added, LAST)
        found = {it.place.rpartition("/")[2]: it for it in report.suggestions}
        assert found.keys() == {records[it].reference_id for it in expected}
        for key, (rescued, rejected, count, _, distance_m) in expected.items():
            suggested = found[records[key].reference_id]
            assert (suggested.photograph_count, suggested.distance_m) == pytest.approx((rescued, distance_m))
            assert f"{rejected} of {count} photographs" in suggested.message
    assert statements[0] == statements[1] > 0


def test_a_report_is_of_one_moment(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reference that is deleted while the report is made is in it, with its photographs, and not in the next one."""
    store.create_scene(HALL)
    (key,) = (it.key for it in store.add_references(HALL, [make_reference("a")]))
    counts.add_counts(store.database, {HALL: {CountKey(LAST, key, "gate"): Sums(5)}})
    adoption.change_standings(store.database, [key], lambda _, it: adoption.outdated(it))

    def deleting(*_: object) -> dict[str, int]:
        store.delete_reference(HALL, "a")
        return {}

    request = pb.GetSceneReportRequest(last_day=day_text(LAST))
    with monkeypatch.context() as patch:
        patch.setattr("mapless_server.scenes.report.renewal.added_days", deleting)
        (place,) = scene_report(store, HALL, request).places
    assert (place.reference, place.is_outdated) == ("scenes/hall/references/a", True)
    (place,) = scene_report(store, HALL, request).places
    assert (place.reference, place.is_outdated) == ("", False)


def test_a_damaged_reference_is_no_outdated_place(store: Store, place: Place) -> None:
    """Its photographs are counted where no place is known."""
    store.create_scene(HALL)
    (key,) = (it.key for it in store.add_references(HALL, [make_reference("a")]))
    counts.add_counts(store.database, {HALL: {CountKey(LAST, key, "gate"): Sums(5)}})
    adoption.change_standings(store.database, [key], lambda _, it: adoption.outdated(it))
    place.execute("UPDATE reference SET geometry = ?", b"damaged")
    (unknown,) = scene_report(store, HALL, pb.GetSceneReportRequest(last_day=day_text(LAST))).places
    assert (unknown.reference, unknown.is_outdated) == ("", False)
    assert unknown.periods[-1].rejections[0].count == 5


def test_places_beyond_the_bound_are_counted(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those with most rejected photographs are shown; the scene's numbers are of all."""
    monkeypatch.setattr(reports, "MOST_PLACES", 2)
    store.create_scene(HALL)
    keys = {it.reference_id: it.key for it in store.add_references(HALL, [make_reference(it) for it in "abc"])}
    its = {CountKey(LAST, keys[name], "gate"): Sums(i + 1) for i, name in enumerate("abc")}
    counts.add_counts(store.database, {HALL: its})
    report = scene_report(store, HALL, pb.GetSceneReportRequest(last_day=day_text(LAST)))
    assert [it.reference.rpartition("/")[2] for it in report.places] == ["c", "b"]
    assert report.omitted_place_count == 1
    assert [it.count for it in report.periods[-1].rejections] == [6]
