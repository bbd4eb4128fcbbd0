"""Reports of scenes through a server, of photographs that it has answered."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import date, datetime, timedelta, timezone
from threading import Event
from typing import Any

import grpc
import numpy as np
import pytest
from support.servers import CAMERA, PHOTO, RunningServer, Staged, Stubs, failure_of, make_scene, pose, serving
from support.waiting import wait_until

from mapless import AdoptionPolicy, Client, GroupRejected, PositionPrior, Priors, Rejected, RigImage
from mapless.scene_reports import SceneReport
from mapless.v1 import reference_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless.v1.reference_service_pb2_grpc import ReferenceServiceStub
from mapless_server.method.rejection import Advice, Hint, Rejection, RejectionReason
from mapless_server.security import SceneKey
from mapless_server.serve import counting
from mapless_server.services import reports
from mapless_server.store import adoption, counts
from mapless_server.store.counts import LOCALIZED, CountKey, Sums

ELSEWHERE = Rejection(RejectionReason.LOW_OVERLAP, "another place")


@pytest.fixture(scope="module")
def method() -> Staged:
    staged = Staged(coarse=None)
    staged.gate.set()
    return staged


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, method: Staged) -> Iterator[RunningServer]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(counting, "WRITE_S", 0.02)
        with serving(tmp_path_factory.mktemp("data"), method=method.method()) as running:
            yield running


def reported(client: Client, scene: str, count: int) -> SceneReport:
    """The report of this week once it has so many photographs."""
    wait_until(lambda: client.get_scene_report(scene).periods[-1].photograph_count >= count)
    return client.get_scene_report(scene)


def test_photographs_are_counted_by_place_and_reason(client: Client, scene: str, method: Staged) -> None:
    """Localized ones at the pose of r0; the others were taken 1.5 m beyond the last reference, by their prior."""
    today = datetime.now(timezone.utc).date()
    client.localize(PHOTO, CAMERA, scene)
    method.outcome = ELSEWHERE
    beyond = Priors(position=PositionPrior(np.array([3.5, 2.0, -1.0]), covariance_m2=1e-4 * np.eye(3)))
    for _ in range(3):
        client.localize(PHOTO, CAMERA, scene, priors=beyond)
    client.localize(PHOTO, CAMERA, scene, priors=beyond, confidential=True)
    method.outcome = None
    report = reported(client, scene, 4)
    last = report.last_day
    assert last in (today, today + timedelta(days=1))
    assert (report.first_day, len(report.periods)) == (last - timedelta(days=27), 4)
    assert (report.periods[-1].localized_count, report.periods[-1].rejections) == (1, {"LOW_OVERLAP": 3})
    assert report.periods[-1].surveyed_share == 1.0
    assert report.periods[0].photograph_count == 0
    beyond_r2, at_r0 = report.places
    assert (beyond_r2.reference_id, at_r0.reference_id) == ("r2", "r0")
    assert beyond_r2.rejected_position is not None
    assert beyond_r2.rejected_position.position == pytest.approx((3.5, 2.0, -1.0), abs=0.001)
    assert beyond_r2.rejected_position.photograph_count == 3
    (suggested,) = report.suggestions
    assert suggested.place_id == "r2"
    assert [suggested.photograph_count, suggested.distance_m] == pytest.approx([3.0, 1.5], rel=0.01)
    assert "3 of 3 photographs around r2 were rejected" in suggested.message
    assert "1.5 m from r2, looking along (" in suggested.message
    assert ") as r2, since no prior says it: add references there" in suggested.message


def test_a_confidential_photograph_is_not_counted(client: Client, scene: str) -> None:
    client.localize(PHOTO, CAMERA, scene, confidential=True)
    client.localize(PHOTO, CAMERA, scene)
    assert reported(client, scene, 1).periods[-1].photograph_count == 1


def test_a_scene_made_again_has_no_counts(client: Client) -> None:
    for _ in range(2):
        make_scene(client, "again", 2)
        client.localize(PHOTO, CAMERA, "again")
        assert reported(client, "again", 1).periods[-1].photograph_count == 1
        client.delete_scene("again")


def test_a_server_makes_one_report_at_a_time(
    client: Client, server: RunningServer, scene: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many ask, also where their callers have gone; other calls do not wait for them."""
    make, running, most, goes_on = reports.scene_report, list[int](), list[int](), Event()

    def counted(*asked: Any) -> pb.SceneReport:
        running.append(1)
        most.append(len(running))
        goes_on.wait(10)
        running.pop()
        return make(*asked)

    monkeypatch.setattr("mapless_server.services.references.scene_report", counted)
    asked = pb.GetSceneReportRequest(scene=f"scenes/{scene}")
    with grpc.insecure_channel(server.address) as channel, ThreadPoolExecutor(5) as pool:
        stub = ReferenceServiceStub(channel)
        gone = [stub.GetSceneReport.future(asked, timeout=0.2) for _ in range(5)]
        assert {it.code() for it in gone} == {grpc.StatusCode.DEADLINE_EXCEEDED}
        made = [pool.submit(client.get_scene_report, scene) for _ in range(5)]
        assert client.get_scene(scene).scene_id == scene
        goes_on.set()
        assert all(it.result().scene_id == scene for it in made)
    assert set(most) == {1}
    assert 6 <= len(most) < 10


def test_old_and_new_weeks_differ(client: Client, server: RunningServer, scene: str) -> None:
    store = server.engine.references.retrievals[0].indexes._store
    day = (date(2026, 3, 2) - date(1970, 1, 1)).days
    planted = {
        CountKey(day, "gone", LOCALIZED): Sums(
            photograph_count=9, support_count=9, surveyed_share=8.1, inlier_count=90
        ),
        CountKey(day + 7, "gone", "low_overlap"): Sums(photograph_count=6),
        CountKey(day + 7, "gone", LOCALIZED): Sums(
            photograph_count=3, support_count=3, surveyed_share=1.2, inlier_count=30
        ),
    }
    counts.add_counts(store.database, {SceneKey(scene): planted})
    report = client.get_scene_report(scene, first_day=date(2026, 3, 2), last_day=date(2026, 3, 15))
    assert [it.localized_share for it in report.periods] == [1.0, pytest.approx(1 / 3)]
    assert [it.surveyed_share for it in report.periods] == pytest.approx([0.9, 0.4])
    assert [it.reference_id for it in report.places] == [""]
    by_day = client.get_scene_report(scene, first_day=date(2026, 3, 2), last_day=date(2026, 3, 15), days_per_period=1)
    assert [it.photograph_count for it in by_day.periods] == [9, 0, 0, 0, 0, 0, 0, 9, 0, 0, 0, 0, 0, 0]


@pytest.mark.parametrize(
    ("given", "field"),
    [
        ({"first_day": "yesterday"}, "first_day"),
        ({"first_day": "20261102"}, "first_day"),
        ({"last_day": "2026-02-30"}, "last_day"),
        ({"last_day": "2026-W10-1"}, "last_day"),
        ({"last_day": "0001-01-03"}, "last_day"),
        ({"first_day": "1969-12-31", "last_day": "1970-01-02"}, "first_day"),
        ({"first_day": "2026-03-02", "last_day": "2026-03-01"}, "first_day"),
        ({"first_day": "1970-01-01", "last_day": "2026-03-01"}, "first_day"),
        ({"days_per_period": -1}, "days_per_period"),
        ({"days_per_period": 367}, "days_per_period"),
    ],
)
def test_wrong_days_are_refused_by_field(
    server: RunningServer, scene: str, given: dict[str, str | int], field: str
) -> None:
    with grpc.insecure_channel(server.address) as channel:
        stubs = Stubs(LocalizationServiceStub(channel), ReferenceServiceStub(channel))
        request = pb.GetSceneReportRequest(scene=f"scenes/{scene}", **given)  # type: ignore[arg-type]
        error = failure_of(stubs.references.GetSceneReport, request)
    assert (error.code, error.field) == ("INVALID_ARGUMENT", field)


def test_rejections_name_the_place_that_needs_a_new_survey(
    client: Client, server: RunningServer, scene: str, method: Staged
) -> None:
    store = server.engine.references.retrievals[0].indexes._store
    key = store.find_keys(SceneKey(scene), ["r1"])["r1"]
    adoption.change_standings(store.database, [key], lambda _, it: adoption.outdated(it))
    rig, said = [RigImage(PHOTO, CAMERA, pose(i)) for i in range(2)], []
    try:
        for adopts in (AdoptionPolicy(), None):
            client.update_scene(scene, adoption=adopts)
            for advice in (Advice.LOOK_AT_REFERENCE, Advice.RETAKE_PHOTOGRAPH):
                hint = Hint("match", advice, advice.value)
                method.outcome = Rejection(RejectionReason.LOW_OVERLAP, "planted", hint)
                rejected, together = client.localize(PHOTO, CAMERA, scene), client.localize_rig(rig, scene)
                assert isinstance(rejected, Rejected)
                assert isinstance(together, GroupRejected)
                assert together.outdated_place == rejected.outdated_place
                assert rejected.hint is not None
                said.append((rejected.outdated_place, rejected.hint.message))
    finally:
        method.outcome = None
    place = f"scenes/{scene}/references/r1"
    again = (
        "Survey the place of reference r1 at (1.00, 2.00, -1.00) again: photographs show too little of what was "
        "surveyed."
    )
    assert said == 2 * [(place, again), (place, "retake_photograph")]  # also after the scene has stopped adopting
