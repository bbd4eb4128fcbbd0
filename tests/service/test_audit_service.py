"""The audit through a real server: planted faults are reported, page by page, and coverage is predicted."""

from collections.abc import Iterator

import numpy as np
import pytest
from support.images import encode
from support.servers import serving_really
from support.wall import wall

from mapless import Camera, Client, InvalidArgument, NewReference, NotFound, RigidTransform

CAMERA = Camera(480, 360, 420.0, 420.0, 239.5, 179.5)
SHOTS = wall(CAMERA, 7)
MOVED, BY_M = 3, np.array([0.06, 0.0, 0.08])


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with serving_really(tmp_path_factory.mktemp("data")) as server, Client(server.address) as client:
        client.create_scene("wall")
        for i, (pixels, pose) in enumerate(SHOTS):
            given = RigidTransform(pose.rotation, pose.translation + BY_M) if i == MOVED else pose
            client.add_reference("wall", NewReference(f"r{i}", encode(".png", pixels), CAMERA, given))
        yield client


def test_only_the_faulty_reference_is_named(client: Client) -> None:
    audits = {audit.name.rpartition("/")[2]: audit for audit in client.audit_scene("wall")}
    assert list(audits) == [f"r{i}" for i in range(len(SHOTS))]
    assert {name: audit.verdict for name, audit in audits.items() if audit.verdict != "CONSISTENT"} == {
        f"r{MOVED}": "WRONG_POSE"
    }
    found = audits[f"r{MOVED}"]
    assert found.position_offset_m == pytest.approx(0.1, abs=0.02)
    assert found.inlier_count <= found.match_count
    assert "10." in found.message
    assert list(client.audit_scene("wall", page_size=3)) == list(audits.values()), "verdicts depend on no page"
    named = client.audit_scene("wall", ["r5", f"r{MOVED}"])
    assert list(named) == [audits["r5"], found], "in the order of the names"
    client.create_scene("empty")
    assert list(client.audit_scene("empty")) == []


def test_what_is_wrong_with_an_audit_is_named(client: Client) -> None:
    with pytest.raises(NotFound) as scene:
        list(client.audit_scene("nowhere"))
    assert scene.value.field == "scene"
    with pytest.raises(NotFound) as reference:
        list(client.audit_scene("wall", ["nobody"]))
    assert reference.value.field == "references[0]"
    with pytest.raises(InvalidArgument) as size:
        list(client.audit_scene("wall", page_size=-1))
    assert size.value.field == "page_size"
    with pytest.raises(InvalidArgument) as twice:
        list(client.audit_scene("wall", ["r1", "r1"]))
    assert twice.value.field == "references[1]"


def test_coverage_is_where_references_look_and_not_behind_them(client: Client) -> None:
    _, between = SHOTS[4]
    ahead = client.check_coverage("wall", between, CAMERA)
    assert ahead.verdict == "LOCALIZABLE"
    assert ahead.expected_match_count > 50
    assert ahead.position_68_m is not None
    assert 0 < ahead.position_68_m < 0.1
    assert ahead.references[0].startswith("scenes/wall/references/r")
    behind = RigidTransform(between.rotation @ np.diag([-1.0, 1.0, -1.0]), between.translation)
    away = client.check_coverage("wall", behind, CAMERA)
    assert (away.verdict, away.expected_match_count, away.references) == ("NOT_LOCALIZABLE", 0, ())
    with pytest.raises(NotFound):
        client.check_coverage("nowhere", between, CAMERA)
