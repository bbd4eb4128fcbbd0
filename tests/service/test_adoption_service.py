"""Policies of adoption, adopted and retired references through a server; which photographs are considered at all."""

from dataclasses import replace
from datetime import datetime, timedelta, timezone

import pytest
from support.servers import CAMERA, PHOTO, RunningServer, Stubs, failure_of, pose
from support.waiting import wait_until

from mapless import (
    Accuracy,
    AdoptionPolicy,
    Client,
    InvalidArgument,
    NewReference,
    NotFound,
    Provenance,
    RestoredReferences,
    Voucher,
)
from mapless.results import PlaceState
from mapless.v1 import localization_service_pb2 as localization_pb
from mapless.v1 import reference_service_pb2 as pb
from mapless_server.security import SceneKey
from mapless_server.store import RetirementReason, Store, adoption

ADOPTED = Provenance("ADOPTED", Accuracy(0.01, 0.02, 0.1, 0.2), 0.5, (Voucher("r0", 40), Voucher("r1", 20)))


@pytest.fixture
def adopting(client: Client, scene: str) -> str:
    """A scene of three references that adopts whatever is localized."""
    client.update_scene(scene, adoption=AdoptionPolicy(min_trust=1e-6, max_radius_m=10.0))
    return scene


def store_of(server: RunningServer) -> Store:
    return server.engine.references.retrievals[0].indexes._store


def key_of(server: RunningServer, scene: str, reference_id: str) -> str:
    return store_of(server).find_keys(SceneKey(scene), [reference_id])[reference_id]


def test_a_policy_is_kept_and_forgotten(client: Client) -> None:
    policy = AdoptionPolicy(2, 0.7, 0.5, 0.4)
    assert client.create_scene("adopts", adoption=policy).adoption == policy
    assert client.update_scene("adopts", adoption=AdoptionPolicy()).adoption == AdoptionPolicy(max_radius_m=0.03)
    assert client.get_scene("adopts").adoption == AdoptionPolicy(max_radius_m=0.03)
    assert client.update_scene("adopts", adoption=None).adoption is None
    client.delete_scene("adopts")
    assert client.create_scene("adopts").adoption is None
    client.delete_scene("adopts")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("most_per_place", 101),
        ("most_per_place", -1),
        ("min_trust", 1.5),
        ("min_trust", -0.1),
        ("min_trust", float("nan")),
        ("max_radius_m", -1.0),
        ("max_radius_m", float("inf")),
        ("min_surveyed_share", 0.05),
        ("min_surveyed_share", 1.01),
    ],
)
def test_a_wrong_policy_is_refused_by_field(stubs: Stubs, field: str, value: float) -> None:
    policy = pb.AdoptionPolicy(**{field: value})  # type: ignore[arg-type]
    error = failure_of(stubs.references.CreateScene, pb.CreateSceneRequest(scene_id="wrong", adoption=policy))
    assert (error.code, error.field) == ("INVALID_ARGUMENT", f"adoption.{field}")
    with pytest.raises(ValueError, match=f"^{field} must be"):
        AdoptionPolicy(**{field: value})  # type: ignore[arg-type]


@pytest.mark.parametrize("radius", [1e-300, 11.0, 1e300])
def test_a_radius_in_metres_is_bounded(stubs: Stubs, scene: str, radius: float) -> None:
    policy = pb.AdoptionPolicy(max_radius_m=radius)
    create = pb.CreateSceneRequest(scene_id="wrong", adoption=policy)
    update = pb.UpdateSceneRequest(scene=pb.Scene(name=f"scenes/{scene}", adoption=policy))
    update.update_mask.paths.append("adoption")
    refused = failure_of(stubs.references.CreateScene, create), failure_of(stubs.references.UpdateScene, update)
    assert [it.field for it in refused] == ["adoption.max_radius_m", "scene.adoption.max_radius_m"]
    assert {it.code for it in refused} == {"INVALID_ARGUMENT"}


def test_an_arbitrary_unit_requires_the_radius(stubs: Stubs) -> None:
    create = pb.CreateSceneRequest(scene_id="units", arbitrary_unit=True, adoption=pb.AdoptionPolicy())
    refused = failure_of(stubs.references.CreateScene, create)
    assert (refused.code, refused.field) == ("INVALID_ARGUMENT", "adoption.max_radius_m")
    create.adoption.max_radius_m = 1e4
    assert stubs.references.CreateScene(create).scene.adoption.max_radius_m == 1e4
    update = pb.UpdateSceneRequest(scene=pb.Scene(name="scenes/units", adoption=pb.AdoptionPolicy()))
    update.update_mask.paths.append("adoption")
    assert failure_of(stubs.references.UpdateScene, update).field == "scene.adoption.max_radius_m"
    stubs.references.DeleteScene(pb.DeleteSceneRequest(name="scenes/units"))


def test_a_policy_of_python_has_no_radius_in_other_units(client: Client) -> None:
    with pytest.raises(InvalidArgument, match="is required: the scene's unit is arbitrary") as caught:
        client.create_scene("units", arbitrary_unit=True, adoption=AdoptionPolicy())
    assert caught.value.field == "adoption.max_radius_m"
    client.create_scene("units", arbitrary_unit=True)
    with pytest.raises(InvalidArgument, match="is required: the scene's unit is arbitrary") as caught:
        client.update_scene("units", adoption=AdoptionPolicy())
    assert caught.value.field == "scene.adoption.max_radius_m"
    policy = AdoptionPolicy(max_radius_m=0.03)
    assert client.update_scene("units", adoption=policy).adoption == policy
    client.delete_scene("units")


def test_the_unit_does_not_change_under_a_radius(client: Client, scene: str) -> None:
    client.update_scene(scene, adoption=AdoptionPolicy())
    with pytest.raises(InvalidArgument, match="its radius in units") as caught:
        client.update_scene(scene, arbitrary_unit=True)
    assert caught.value.field == "scene.adoption.max_radius_m"
    changed = client.update_scene(scene, arbitrary_unit=True, adoption=AdoptionPolicy(max_radius_m=2.0))
    assert (changed.arbitrary_unit, changed.adoption) == (True, AdoptionPolicy(max_radius_m=2.0))
    client.update_scene(scene, arbitrary_unit=False, adoption=None)


def test_adopted_references_are_listed_and_undone_by_date(client: Client, scene: str) -> None:
    new = NewReference("new", PHOTO, CAMERA, pose(5.0), provenance=ADOPTED)
    assert client.add_reference(scene, new).provenance == ADOPTED
    assert [it.reference_id for it in client.list_references(scene, only_adopted=True)] == ["new"]
    later = datetime.now(timezone.utc) + timedelta(minutes=1)
    assert client.undo_adoption(scene, later) == []
    undone = client.undo_adoption(scene, later - timedelta(hours=1))
    assert [it.reference_id for it in undone] == ["new"]
    assert [it.reference_id for it in client.list_references(scene)] == ["r0", "r1", "r2"]
    with pytest.raises(ValueError, match="time zone"):
        client.undo_adoption(scene, datetime(2026, 1, 1))


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"surveyed_share": 0.0}, "surveyed_share"),
        ({"surveyed_share": 1.5}, "surveyed_share"),
        ({"vouchers": []}, "vouchers"),
        ({"vouchers": [pb.Voucher(reference_id="../x", match_count=1)]}, "vouchers"),
        ({"vouchers": [pb.Voucher(reference_id="r0")]}, "vouchers"),
        ({"source": pb.POSE_SOURCE_PLACED}, "surveyed_share"),
    ],
)
def test_a_wrong_vouching_is_refused_by_field(stubs: Stubs, scene: str, change: dict[str, object], field: str) -> None:
    from mapless.requests import create_request

    request = create_request(f"scenes/{scene}", NewReference("new", PHOTO, CAMERA, pose(5.0), provenance=ADOPTED))
    known = request.reference.provenance
    for name, value in change.items():
        known.ClearField(name)
        known.MergeFrom(pb.Provenance(**{name: value}))  # type: ignore[arg-type]
    error = failure_of(stubs.references.CreateReference, request)
    assert (error.code, error.field) == ("INVALID_ARGUMENT", f"reference.provenance.{field}")


def test_a_reference_is_retired_by_hand_and_all_restored(client: Client, scene: str) -> None:
    assert "by request" in client.retire_reference(scene, "r1").retirement
    client.retire_reference(scene, "r2")
    audits = {it.name.rpartition("/")[2]: it.verdict for it in client.audit_scene(scene)}
    assert (audits["r1"], audits["r2"]) == ("RETIRED", "RETIRED")
    assert client.restore_references(scene, place="r1") == RestoredReferences(("r1",), {})
    assert [it.reference_id for it in client.list_references(scene, only_retired=True)] == ["r2"]
    assert client.restore_references(scene, since=datetime.now(timezone.utc) + timedelta(minutes=5)).reference_ids == ()
    assert client.restore_references(scene).reference_ids == ("r2",)
    with pytest.raises(ValueError, match="time zone"):
        client.restore_references(scene, since=datetime(2026, 11, 29))


def test_a_scene_that_adopts_says_how_long_it_keeps(client: Client, scene: str) -> None:
    (said,) = client.update_scene(scene, adoption=AdoptionPolicy()).warnings
    assert said.startswith("what it adopts is deleted 24 h after it was adopted")
    assert client.get_scene(scene).warnings == (said,)
    assert client.create_scene("keeps", adoption=AdoptionPolicy()).warnings == (said,)
    client.delete_scene("keeps")
    assert client.update_scene(scene, adoption=None).warnings == ()


def test_a_retired_reference_is_named_and_restored(client: Client, server: RunningServer, scene: str) -> None:
    store, scene_key = store_of(server), SceneKey(scene)
    adoption.retire(store, scene_key, [key_of(server, scene, "r1")], RetirementReason.CONTRADICTED)
    (retired,) = client.list_references(scene, only_retired=True)
    assert retired.reference_id == "r1"
    assert retired.retire_time is not None
    assert "do not show what it shows" in retired.retirement
    audits = {it.name.rpartition("/")[2]: it for it in client.audit_scene(scene)}
    assert list(audits) == ["r0", "r1", "r2"]
    assert (audits["r1"].verdict, audits["r1"].message) == ("RETIRED", retired.retirement)
    found = client.retrieve_references(PHOTO, CAMERA, scene, count=10)
    assert f"scenes/{scene}/references/r1" not in {it.name for it in found}
    assert client.restore_reference(scene, "r1").retirement == ""
    assert list(client.list_references(scene, only_retired=True)) == []
    assert len(client.retrieve_references(PHOTO, CAMERA, scene, count=10)) == len(found) + 1
    with pytest.raises(NotFound):
        client.restore_reference(scene, "gone")


def test_reranking_says_that_a_named_reference_is_retired(client: Client, server: RunningServer, scene: str) -> None:
    adoption.retire(store_of(server), SceneKey(scene), [key_of(server, scene, "r1")], RetirementReason.CONTRADICTED)
    with pytest.raises(NotFound, match="is retired") as caught:
        client.localize(PHOTO, CAMERA, scene, ["r0", "r1"], rerank_references=True)
    assert (caught.value.reason, caught.value.field) == ("REFERENCE_RETIRED", "references[1]")
    client.localize(PHOTO, CAMERA, scene, ["r0", "r1"])  # as it is


def test_all_references_of_a_page_may_be_retired(client: Client, server: RunningServer, scene: str) -> None:
    keys = [key_of(server, scene, it) for it in ("r0", "r1", "r2")]
    adoption.retire(store_of(server), SceneKey(scene), keys, RetirementReason.CONTRADICTED)
    assert [it.verdict for it in client.audit_scene(scene)] == ["RETIRED"] * 3


def test_an_adopted_reference_shows_its_place(client: Client, server: RunningServer, adopting: str) -> None:
    new = client.add_reference(adopting, NewReference("new", PHOTO, CAMERA, pose(5.0), provenance=ADOPTED))
    assert (new.place_reference, new.place) == ("", None)
    store, state = store_of(server), PlaceState(0.4, 5, 0)
    keys = {it: key_of(server, adopting, it) for it in ("new", "r1")}
    adoption.set_places(store, SceneKey(adopting), {keys["new"]: keys["r1"]})
    adoption.change_standings(
        store.database, [keys["r1"]], lambda _, it: replace(it, surveyed_share=0.4, photograph_count=5)
    )
    found = {it.reference_id: it for it in client.list_references(adopting)}
    assert (found["new"].place_reference, found["new"].place) == ("r1", state)
    assert (found["r1"].place_reference, found["r1"].place) == ("", state)
    client.retire_reference(adopting, "new")
    found["new"] = client.get_reference(adopting, "new")
    assert (found["new"].place_reference, found["new"].place) == ("r1", state)
    scene = client.get_scene(adopting)
    assert (scene.adopted_reference_count, scene.retired_reference_count) == (0, 1)


def test_places_that_need_a_new_survey_are_named(client: Client, server: RunningServer, adopting: str) -> None:
    key = key_of(server, adopting, "r2")
    adoption.change_standings(
        store_of(server).database,
        [key],
        lambda _, it: adoption.outdated(replace(it, surveyed_share=0.2, photograph_count=5)),
    )
    _, warning = client.get_scene(adopting).warnings
    assert warning.startswith("photographs around r2 at (2.00, 2.00, -1.00) show too little of what was surveyed")
    places = {it.reference_id: it.place for it in client.list_references(adopting)}
    assert places == {"r0": None, "r1": None, "r2": PlaceState(0.2, 5, 0, is_outdated=True)}
    assert adoption.read_standings(store_of(server).database, [key])[key].photograph_count == 5


@pytest.mark.parametrize(
    "asked",
    [
        {},
        {"allow_adoption": True, "confidential": True},
        {"allow_adoption": True, "references": ["r0"]},
    ],
    ids=["absent", "confidential", "named references"],
)
def test_nothing_is_considered_that_the_request_forbids(
    client: Client, server: RunningServer, adopting: str, asked: dict[str, object]
) -> None:
    before = server.value("mapless_adoptions_total")
    client.localize(PHOTO, CAMERA, adopting, **asked)  # type: ignore[arg-type]
    assert server.value("mapless_adoptions_total") == before


def test_nothing_is_considered_where_the_scene_does_not_adopt(
    client: Client, server: RunningServer, scene: str
) -> None:
    before = server.value("mapless_adoptions_total")
    client.localize(PHOTO, CAMERA, scene, allow_adoption=True)
    assert server.value("mapless_adoptions_total") == before


def test_an_uncertain_answer_is_counted_and_not_kept(client: Client, server: RunningServer, scene: str) -> None:
    client.update_scene(scene, adoption=AdoptionPolicy(max_radius_m=1e-6))
    before = server.value("mapless_adoptions_total", result="uncertain")
    client.localize(PHOTO, CAMERA, scene, allow_adoption=True)
    wait_until(lambda: server.value("mapless_adoptions_total", result="uncertain") == before + 1)
    assert list(client.list_references(scene, only_adopted=True)) == []


def test_the_answer_does_not_depend_on_permission(stubs: Stubs, adopting: str) -> None:
    request = localization_pb.LocalizeRequest(scene=f"scenes/{adopting}", image=PHOTO)
    request.intrinsics.width_px, request.intrinsics.height_px = CAMERA.width_px, CAMERA.height_px
    request.intrinsics.focal_x_px, request.intrinsics.focal_y_px = CAMERA.focal_x_px, CAMERA.focal_y_px
    first = stubs.localization.Localize(request)
    request.options.allow_adoption = True
    assert stubs.localization.Localize(request).localization == first.localization
