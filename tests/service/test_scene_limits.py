"""Tokens for some scenes of their tenant: the others are not there, in any method, whatever labels become meanwhile."""

import json
from collections.abc import Iterator
from contextlib import nullcontext
from itertools import product
from pathlib import Path
from typing import Any

import grpc
import pytest
from google.protobuf.message import Message
from support.servers import CAMERA, PHOTO, ending, localize_request, pose, serving
from support.tokened import LIMIT_S, REFERENCE_SERVICE, Guarded, requests_on
from support.waiting import wait_until

import mapless_tools.demo
from mapless import AlreadyExists, Client, LocalizationResult, MaplessError, NewReference, NotFound, PermissionDenied
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless.v1.reference_service_pb2 import ListScenesRequest, ListScenesResponse
from mapless_server.security import create_token
from mapless_tools.ingest.existing import open_scene
from mapless_tools.ingest.formats.cameras import read_folder

SITE_A, SITE_B = {"site": "a"}, {"site": "b"}
LIMITS: dict[str, dict[str, Any]] = {
    "all": {},
    "named": {"scenes": ["hall", "later"]},
    "site": {"labels": SITE_A | {"floor": "1"}},
    "both": {"scenes": ["hall"], "labels": SITE_A},
}
SCENES = {"attic": SITE_A, "barn": SITE_B, "hall": {}, "yard": SITE_A | {"floor": "1"}}
LOCALIZATION_SERVICE = "/mapless.v1.LocalizationService/"
LOCALIZE = LOCALIZATION_SERVICE + "Localize"
VISIBLE = {
    "all": ["attic", "barn", "hall", "yard"],
    "named": ["hall"],
    "site": ["yard"],
    "both": ["attic", "hall", "yard"],
}


@pytest.fixture(scope="module")
def limited(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    folder = tmp_path_factory.mktemp("limited")
    file = folder / "tokens.json"
    tokens = {name: create_token(file, name, "acme", "write", None, **limit) for name, limit in LIMITS.items()}
    with serving(folder / "data", tokens_file=file, allow_watching=True) as server:
        guarded = Guarded(server, tokens, file)
        with guarded.client("all") as client:
            for scene_id, labels in SCENES.items():
                fill(client, scene_id, labels)
        yield guarded


def fill(client: Client, scene_id: str, labels: dict[str, str]) -> None:
    client.create_scene(scene_id, labels=labels)
    client.add_references(scene_id, [NewReference("r", PHOTO, CAMERA, pose(1.0))])


def said(failure: MaplessError, scene_id: str) -> tuple[Any, ...]:
    """All that a caller is answered, but the scene that it asked for itself."""
    text = (failure.message, failure.resource, str(failure.__cause__.details()))  # type: ignore[union-attr]
    replaced = tuple(it.replace(scene_id, "...") for it in text)
    return failure.code, failure.reason, failure.field, failure.retry_after_s, replaced


def variants_on(scene_id: str) -> list[tuple[str, Message]]:
    """Every method that names a scene, and some whose requests are read or wrong in other ways."""
    found = list(requests_on(scene_id).items())
    located = localize_request(scene_id)
    located.geo_position_prior.horizontal_sigma_m = 1.0
    broken = localize_request(scene_id)
    broken.image = b"no image"
    chosen = localize_request(scene_id)
    chosen.references.append(f"scenes/{scene_id}/references/r")
    foreign = localize_request(scene_id)
    foreign.references.append("scenes/hall/references/r")
    several: list[tuple[str, Any]] = []
    for method in ("Localize", "LocalizeProgressively", "LocalizeRig", "LocalizeSequence"):
        request: Any = requests_on(scene_id)[LOCALIZATION_SERVICE + method]
        request.ClearField("scene")
        request.scenes.extend(["scenes/hall", f"scenes/{scene_id}"])
        several.append((LOCALIZATION_SERVICE + method, request))
    return [*found, *((LOCALIZE, it) for it in (located, broken, chosen, foreign)), *several]


@pytest.mark.parametrize("index", range(len(variants_on("barn"))))
@pytest.mark.parametrize("caller", ["named", "site", "both"])
def test_a_scene_out_of_the_limit_is_as_one_that_is_absent(limited: Guarded, caller: str, index: int) -> None:
    answers = []
    for scene_id in ("barn", "none"):
        method, request = variants_on(scene_id)[index]
        failure = limited.failure(method, request, limited.tokens[caller])
        assert isinstance(failure, NotFound) or failure.code == "INVALID_ARGUMENT"
        answers.append(said(failure, scene_id))
    assert answers[0] == answers[1]
    with limited.client("all") as client:
        assert client.get_scene("barn").reference_count == 1


@pytest.mark.parametrize("caller", LIMITS)
def test_scenes_within_the_limit_are_listed_and_answer(limited: Guarded, caller: str) -> None:
    with limited.client(caller) as client:
        assert [it.scene_id for it in client.list_scenes(page_size=1)] == VISIBLE[caller]
        both = [it.scene_id for it in client.list_scenes(labels=SITE_A)]
        assert both == [it for it in VISIBLE[caller] if SCENES[it].get("site") == "a"]
        for scene_id in VISIBLE[caller]:
            assert client.get_scene(scene_id).labels == SCENES[scene_id]
            assert isinstance(client.localize(PHOTO, CAMERA, scene_id), LocalizationResult)


def test_a_group_out_of_the_limit_is_as_one_that_is_absent(limited: Guarded) -> None:
    def group(method: str, site: str) -> Message:
        request: Any = requests_on("hall")[method]
        request.ClearField("scene")
        request.scene_group.labels["site"] = site
        return request  # type: ignore[no-any-return]

    for caller, name in product(("named", "site", "both"), ("Localize", "LocalizeRig", "LocalizeSequence")):
        method = LOCALIZATION_SERVICE + name
        failures = [limited.failure(method, group(method, site), limited.tokens[caller]) for site in ("b", "z")]
        assert said(failures[0], "site=b") == said(failures[1], "site=z")
        assert isinstance(failures[0], NotFound)


@pytest.mark.parametrize("caller", LIMITS)
def test_a_search_finds_only_scenes_within_the_limit(limited: Guarded, caller: str) -> None:
    visible = VISIBLE[caller]
    several: tuple[dict[str, Any], ...] = ({"group": {}}, {"scenes": visible})
    with limited.client(caller) as client:
        for where in several:
            answer = client.localize(PHOTO, CAMERA, **where)  # in all scenes at once, which have one photograph
            assert answer.diagnostics.searched_scene_count == len(visible)
            text = repr(answer)
            assert [it for it in SCENES if f"scenes/{it}" in text and it not in visible] == []
            if visible == ["hall"]:
                assert isinstance(answer, LocalizationResult)
                assert answer.scene == "scenes/hall"
        with pytest.raises(NotFound) if caller == "named" else nullcontext():
            client.localize(PHOTO, CAMERA, group=SITE_A)


def test_another_tokens_page_shows_only_ones_own_scenes(limited: Guarded) -> None:
    method = REFERENCE_SERVICE + "ListScenes"

    def page(caller: str, token: str) -> ListScenesResponse:
        request = ListScenesRequest(page_size=1, page_token=token)
        answer = ListScenesResponse()
        answer.ParseFromString(limited.call(method, request, limited.tokens[caller]))
        return answer

    first = page("all", "")
    assert [it.name for it in page("both", first.next_page_token).scenes] == ["scenes/hall"]
    assert [it.name for it in page("site", first.next_page_token).scenes] == ["scenes/yard"]


def test_a_scene_that_is_created_must_be_within_the_limit(limited: Guarded) -> None:
    with limited.client("named") as named, limited.client("site") as site, limited.client("all") as everything:
        for client, labels in ((named, SITE_A | {"floor": "1"}), (site, SITE_A), (site, {})):
            for scene_id in ("barn", "fresh"):  # whether it exists or not
                with pytest.raises(PermissionDenied, match=f"scene '{scene_id}' would not be one of them") as caught:
                    client.create_scene(scene_id, labels=labels)
                assert (caught.value.reason, caught.value.field) == ("SCENE_LIMIT", "scene_id")
        assert named.create_scene("later").scene_id == "later"
        assert site.create_scene("fresh", labels=LIMITS["site"]["labels"]).scene_id == "fresh"
        with pytest.raises(AlreadyExists):
            site.create_scene("barn", labels=LIMITS["site"]["labels"])
        assert everything.get_scene("barn").labels == SITE_B
        named.delete_scene("later")
        site.delete_scene("fresh")


def test_an_import_uses_a_scene_that_its_token_could_not_create(limited: Guarded) -> None:
    dataset = read_folder(Path(mapless_tools.demo.__file__).parent / "room")
    with limited.client("site") as site:
        assert [it.reference_id for it in open_scene(site, "yard", dataset, dataset.frames)] == ["r"]
        for scene_id in ("barn", "none"):
            with pytest.raises(PermissionDenied, match="would not be one of them"):
                open_scene(site, scene_id, dataset, dataset.frames)


def test_labels_do_not_take_a_scene_out_of_the_limit(limited: Guarded) -> None:
    within = LIMITS["site"]["labels"]
    with limited.client("site") as site, limited.client("both") as both, limited.client("named") as named:
        for labels in ({}, SITE_A, within | {"floor": "2"}):
            with pytest.raises(PermissionDenied, match="floor=1, site=a") as caught:
                site.update_scene("yard", labels=labels)
            assert (caught.value.reason, caught.value.field) == ("SCENE_LIMIT", "scene.labels")
        assert site.update_scene("yard", labels=within | {"door": "red"}).labels == within | {"door": "red"}
        assert site.update_scene("yard", labels=within, arbitrary_unit=False).labels == within
        for client in (both, named):  # a name is enough
            assert client.update_scene("hall", labels=SITE_B).labels == SITE_B
            assert client.update_scene("hall", labels={}).labels == {}
        with pytest.raises(NotFound):
            site.update_scene("attic", labels=within)


def test_a_change_of_labels_counts_in_the_next_call(limited: Guarded) -> None:
    with limited.client("all") as everything, limited.client("both") as both:
        for labels in (SITE_A, SITE_B, SITE_A, SITE_B):
            everything.update_scene("barn", labels=labels)
            is_within = labels == SITE_A
            assert ("barn" in [it.scene_id for it in both.list_scenes()]) == is_within
            if is_within:
                assert isinstance(both.localize(PHOTO, CAMERA, "barn"), LocalizationResult)
            else:
                with pytest.raises(NotFound):
                    both.localize(PHOTO, CAMERA, "barn")


def test_a_watcher_sees_nothing_of_a_scene_that_left_the_limit(limited: Guarded) -> None:
    with grpc.insecure_channel(limited.server.address) as channel, limited.client("all") as everything:
        stub = LocalizationServiceStub(channel)
        metadata = (("authorization", f"Bearer {limited.tokens['both']}"),)
        request = pb.WatchQueriesRequest(scene="scenes/attic")
        absent = limited.failure(
            "/mapless.v1.LocalizationService/WatchQueries",
            pb.WatchQueriesRequest(scene="scenes/none"),
            limited.tokens["both"],
        )
        seen = stub.WatchQueries(request, timeout=LIMIT_S, metadata=metadata)
        seen.initial_metadata()
        everything.localize(PHOTO, CAMERA, "attic")
        assert next(seen).image == PHOTO
        everything.update_scene("attic", labels=SITE_B)
        everything.localize(PHOTO, CAMERA, "attic")
        failure = ending(seen)
        everything.update_scene("attic", labels=SITE_A)
        assert said(failure, "attic") == said(absent, "none")


def test_a_token_that_is_changed_ends_its_watches(limited: Guarded) -> None:
    token = create_token(limited.tokens_file, "passing", "acme", "write", None)

    def change(**fields: Any) -> None:
        content = json.loads(limited.tokens_file.read_text())
        content["tokens"] = [it | (fields if it["name"] == "passing" else {}) for it in content["tokens"]]
        limited.tokens_file.write_text(json.dumps(content))

    def scenes() -> list[str] | None:
        try:
            with limited.client(token) as client:
                return [it.scene_id for it in client.list_scenes()]
        except MaplessError:
            return None

    wait_until(lambda: scenes() == VISIBLE["all"])
    with grpc.insecure_channel(limited.server.address) as channel, limited.client("all") as everything:
        metadata = (("authorization", f"Bearer {token}"),)
        request = pb.WatchQueriesRequest(scene="scenes/attic")
        seen = LocalizationServiceStub(channel).WatchQueries(request, timeout=LIMIT_S, metadata=metadata)
        seen.initial_metadata()
        change(scenes=["hall"])
        wait_until(lambda: scenes() == ["hall"])
        everything.localize(PHOTO, CAMERA, "attic")
        failure = ending(seen)
        assert (failure.code, failure.reason) == ("UNAVAILABLE", "TOKEN_CHANGED")
