"""Scenes and references as resources, through a real server and a real store."""

import hashlib
import logging
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.images import encode, textured
from support.postgres import shared_cluster
from support.servers import BLACK, CAMERA, PHOTO, Stubs, failure_of, make_scene, pose, serving
from support.waiting import wait_until

from mapless import (
    AlreadyExists,
    Client,
    ConnectOptions,
    DeadlineExceeded,
    InvalidArgument,
    LocalizationResult,
    NewReference,
    NotFound,
    ResourceExhausted,
)
from mapless.v1 import reference_service_pb2 as pb
from mapless_server.errors import Overloaded
from mapless_server.store import Store


@pytest.mark.parametrize("ends", ["late", "full"])
def test_a_scene_whose_deletion_is_slow_takes_no_memory(tmp_path: Path, ends: str) -> None:
    """The scene is gone by then."""
    store, is_over = Store.open(tmp_path), threading.Event()

    def delete_what_is_left() -> None:
        assert is_over.wait(30)
        raise Overloaded("the store's disk is full", reason="STORE_FULL")

    with serving(tmp_path, store=store) as server, Client(server.address, ConnectOptions(max_attempts=1)) as client:
        make_scene(client)
        client.localize(PHOTO, CAMERA, "s")
        assert server.engine.references.index_bytes > 0
        store._pending_deletions.run = delete_what_is_left  # type: ignore[method-assign]
        if ends == "late":
            with pytest.raises(DeadlineExceeded):
                client.delete_scene("s", timeout_s=0.5)
            is_over.set()
        else:
            is_over.set()
            with pytest.raises(ResourceExhausted, match="full"):
                client.delete_scene("s")
        wait_until(lambda: server.engine.references.index_bytes == 0)
        with pytest.raises(NotFound):
            client.get_scene("s")


def test_the_life_of_a_reference(client: Client, scene: str, tmp_path: Path) -> None:
    generation = client.get_scene(scene).generation
    path = tmp_path / "photo.png"
    path.write_bytes(PHOTO)
    added = client.add_reference(scene, NewReference("new", path, CAMERA, pose(0.25)))
    assert (added.scene_id, added.reference_id, added.camera, added.feature_count) == (scene, "new", CAMERA, 1)
    assert added.image is None
    np.testing.assert_allclose(added.world_from_camera.matrix(), pose(0.25).matrix(), atol=1e-12)
    assert client.get_reference(scene, "new", include_image=True).image == PHOTO
    assert added.image_sha256 == hashlib.sha256(PHOTO).hexdigest()
    with pytest.raises(AlreadyExists) as caught:
        client.add_reference(scene, NewReference("new", PHOTO, CAMERA, pose(0.25)))
    assert caught.value.field == "reference_id"
    client.delete_reference(scene, f"scenes/{scene}/references/new")
    with pytest.raises(NotFound):
        client.get_reference(scene, "new")
    assert client.get_scene(scene).generation > generation


def test_lists_are_paged(client: Client, stubs: Stubs, scene: str) -> None:
    assert [r.reference_id for r in client.list_references(scene)] == ["r0", "r1", "r2"]
    assert [r.reference_id for r in client.list_references(scene, page_size=1)] == ["r0", "r1", "r2"]
    assert scene in [s.scene_id for s in client.list_scenes(page_size=1)]
    request = pb.ListReferencesRequest(scene=f"scenes/{scene}", page_size=3)
    assert stubs.references.ListReferences(request).next_page_token == ""
    request.page_size = 2
    first = stubs.references.ListReferences(request)
    assert len(first.references) == 2
    assert not any(reference.image for reference in first.references)

    for token in ("x", "r1", first.next_page_token[:-2], first.next_page_token + "A", "€"):
        request.page_token = token
        assert failure_of(stubs.references.ListReferences, request).field == "page_token"
    foreign = pb.ListScenesRequest(page_token=first.next_page_token)
    assert failure_of(stubs.references.ListScenes, foreign).field == "page_token"
    assert failure_of(stubs.references.ListScenes, pb.ListScenesRequest(page_size=-1)).field == "page_size"
    stubs.references.ListScenes(pb.ListScenesRequest(page_size=10**6))


def test_a_batch_larger_than_the_queue_is_described_bit_by_bit(tmp_path: Path) -> None:
    """With room for the computing of no more than a few photographs."""
    references = [NewReference(f"x{i}", PHOTO, CAMERA, pose(i)) for i in range(40)]
    with serving(tmp_path, max_queued_s=0.4) as server, Client(server.address) as client:
        client.create_scene("s")
        assert len(client.add_references("s", references)) == 40


def test_a_batch_with_one_bad_item_stores_nothing(client: Client, scene: str) -> None:
    batch = [NewReference(f"n{i}", it, CAMERA, pose(0.5)) for i, it in enumerate((PHOTO, PHOTO[:-50]))]
    with pytest.raises(InvalidArgument) as caught:
        client.add_references(scene, batch)
    assert caught.value.field == "requests[1].reference.image"
    assert client.get_scene(scene).reference_count == 3


def test_a_blank_reference_is_stored_and_reported(client: Client, scene: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "mapless_server.rpc.guard")
    photos = {"seen": PHOTO, "blank": BLACK}
    stored = client.add_references(scene, [NewReference(it, photos[it], CAMERA, pose(0)) for it in photos])
    assert [it.feature_count for it in stored] == [1, 0]
    wait_until(lambda: any(vars(it).get("fields", {}).get("references_without_features") for it in caplog.records))


PHOTOS = [encode(".png", textured(seed=i)) for i in range(3)]


@pytest.fixture
def two(tmp_path: Path) -> Iterator[tuple[Client, Client]]:
    """Clients of two servers that share a database."""
    url = shared_cluster().fresh_url()
    with (
        serving(tmp_path / "first", store=Store.connect(url)) as first,
        serving(tmp_path / "second", store=Store.connect(url)) as second,
        Client(first.address) as one,
        Client(second.address) as other,
    ):
        yield one, other


def used(client: Client, references: tuple[str, ...] = (), photo: bytes = PHOTO) -> list[str]:
    answer = client.localize(photo, CAMERA, "s", references)
    assert isinstance(answer, LocalizationResult)
    return [use.name.rpartition("/")[2] for use in answer.diagnostics.references]


def test_what_is_added_through_one_is_used_through_the_other(two: tuple[Client, Client]) -> None:
    one, other = two
    one.create_scene("s")
    for i, photo in enumerate(PHOTOS):
        one.add_reference("s", NewReference(f"r{i}", photo, CAMERA, pose(i)))
        # By name, by choice, by retrieval and in the list, each with its own memory of what was there before.
        assert used(other, (f"r{i}",)) == [f"r{i}"]
        assert used(other, photo=photo)[0] == f"r{i}"
        assert other.retrieve_references(photo, CAMERA, "s", 1)[0].similarity == pytest.approx(1, abs=1e-3)
        assert [it.reference_id for it in other.list_references("s")] == [f"r{j}" for j in range(i + 1)]
        assert other.get_scene("s").generation == one.get_scene("s").generation == i + 2


def test_what_is_deleted_through_one_is_gone_for_the_other(two: tuple[Client, Client]) -> None:
    one, other = two
    one.create_scene("s")
    one.add_references("s", [NewReference(f"r{i}", photo, CAMERA, pose(i)) for i, photo in enumerate(PHOTOS)])
    assert set(used(other)) == {"r0", "r1", "r2"}
    assert used(other, ("r1", "r0")) == ["r1", "r0"]
    one.delete_reference("s", "r1")
    assert set(used(other)) == {"r0", "r2"}
    with pytest.raises(NotFound) as caught:
        used(other, ("r1", "r0"))
    assert caught.value.field == "references[0]"
    # Another photograph under the old name is another reference.
    other.add_reference("s", NewReference("r1", PHOTOS[2], CAMERA, pose(7.0)))
    assert one.get_reference("s", "r1", include_image=True).image == PHOTOS[2]
    assert used(one, ("r1",)) == ["r1"]
    one.delete_scene("s")
    with pytest.raises(NotFound):
        used(other)
    other.create_scene("s")
    assert one.get_scene("s").reference_count == 0
