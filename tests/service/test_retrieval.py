"""Retrieval through a real server: by RetrieveReferences, for Localize, and among named references."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.images import encode, textured
from support.servers import CAMERA, RunningServer, pose, serving
from support.stores import damage

from mapless import (
    Client,
    DataLoss,
    LocalizationResult,
    NewReference,
    NotFound,
)
from mapless_server.security import SceneKey
from mapless_server.store import Store

COUNT = 12
PHOTOS = [encode(".png", textured(seed=i)) for i in range(COUNT)]
SPACING_M = 5.0


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    with serving(tmp_path_factory.mktemp("data")) as server:
        yield server


@pytest.fixture(scope="module")
def client(server: RunningServer) -> Iterator[Client]:
    with Client(server.address) as client:
        client.create_scene("hall")
        client.add_references(
            "hall", [NewReference(f"r{i:02}", PHOTOS[i], CAMERA, pose(SPACING_M * i)) for i in range(COUNT)]
        )
        yield client


def ids(names: list[str]) -> list[str]:
    return [name.rpartition("/")[2] for name in names]


@pytest.mark.parametrize("i", [0, 5, 11])
def test_a_photograph_resembles_itself_most(client: Client, i: int) -> None:
    found = client.retrieve_references(PHOTOS[i], CAMERA, "hall", 3)
    assert len(found) == 3
    assert found[0].name == f"scenes/hall/references/r{i:02}"
    assert found[0].similarity == pytest.approx(1, abs=1e-3)
    assert all(other.similarity < 0.99 for other in found[1:])
    np.testing.assert_allclose(found[0].world_from_camera.matrix(), pose(SPACING_M * i).matrix(), atol=1e-9)


def test_ten_unless_asked_otherwise_and_no_more_than_there_are(client: Client) -> None:
    assert len(client.retrieve_references(PHOTOS[0], CAMERA, "hall")) == 10
    every = client.retrieve_references(PHOTOS[0], CAMERA, "hall", 1000)
    assert sorted(ids([it.name for it in every])) == [f"r{i:02}" for i in range(COUNT)]


def test_localize_uses_what_retrieval_finds(client: Client) -> None:
    found = client.retrieve_references(PHOTOS[7], CAMERA, "hall", 4)
    answer = client.localize(PHOTOS[7], CAMERA, "hall", reference_count=4)
    assert isinstance(answer, LocalizationResult)
    uses = answer.diagnostics.references
    assert [use.name for use in uses] == [it.name for it in found]
    assert [use.similarity for use in uses] == [it.similarity for it in found]
    assert answer.diagnostics.retrieval == "patches"


def test_named_references_keep_their_order_unless_reranked(client: Client) -> None:
    names = [f"r{i:02}" for i in range(COUNT)]
    plain = client.localize(PHOTOS[9], CAMERA, "hall", names, reference_count=3)
    assert ids([use.name for use in plain.diagnostics.references]) == names
    assert plain.diagnostics.retrieval == ""
    ranked = client.localize(PHOTOS[9], CAMERA, "hall", names[:10], reference_count=3, rerank_references=True)
    uses = ids([use.name for use in ranked.diagnostics.references])
    assert len(uses) == 3
    assert uses[0] == "r09"
    assert set(uses) <= set(names[:10])


def test_a_name_that_is_wrong_is_found_out_when_reranking_too(client: Client) -> None:
    with pytest.raises(NotFound) as caught:
        client.localize(PHOTOS[0], CAMERA, "hall", ["r00", "nobody"], rerank_references=True)
    assert caught.value.field == "references[1]"


def test_an_empty_scene_has_nothing_to_find(client: Client) -> None:
    client.create_scene("empty")
    assert client.retrieve_references(PHOTOS[0], CAMERA, "empty") == []


@pytest.mark.parametrize("what", ["features", "descriptor", "pose"])
def test_a_damaged_reference_costs_itself_unless_it_is_named(tmp_path: Path, what: str) -> None:
    """A scene of four, whose first one the photograph resembles most."""
    with serving(tmp_path) as server, Client(server.address) as client:
        client.create_scene("s")
        client.add_references("s", [NewReference(f"r{i}", PHOTOS[i], CAMERA, pose(float(i))) for i in range(4)])
    store = Store.open(tmp_path)
    damage(store, SceneKey("s"), "r0", what)  # while nothing has it in memory
    with serving(tmp_path, store=store) as server, Client(server.address) as client:
        answer = client.localize(PHOTOS[0], CAMERA, "s", reference_count=2)
        assert isinstance(answer, LocalizationResult)
        used = ids([use.name for use in answer.diagnostics.references])
        assert len(used) == 2
        assert "r0" not in used
        for is_reranked in (True, False):
            if what == "descriptor" and not is_reranked:  # it is not read
                continue
            with pytest.raises(DataLoss, match="'r0' is damaged"):
                client.localize(PHOTOS[0], CAMERA, "s", ["r1", "r0"], rerank_references=is_reranked)
