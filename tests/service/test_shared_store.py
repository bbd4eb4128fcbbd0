"""Several servers on one PostgreSQL are one service: a change through one is visible through the others at once."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from support.images import encode, textured
from support.postgres import shared_cluster
from support.servers import CAMERA, PHOTO, pose, serving

from mapless import Client, LocalizationResult, NewReference, NotFound
from mapless_server.store import Store

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
