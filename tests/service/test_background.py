"""Servers that match references ahead of queries: the same answers for less work, also after one was killed."""

import shutil
from contextlib import closing
from pathlib import Path

import grpc
import pytest
from support.messages import essence
from support.servers import RunningServer, serving_really
from support.stores import Folder
from support.waiting import wait_until

from mapless import Client, NewReference, wire
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless_server.scenes.background import BackgroundMatching
from mapless_server.scenes.scene_agreements import SceneAgreements
from mapless_tools.demo import room

REFERENCES, QUERIES = 5, 1
PAIRS = REFERENCES * (REFERENCES - 1) // 2


def answers(server: RunningServer) -> list[bytes]:
    """To every query, without what differs from call to call."""
    with grpc.insecure_channel(server.address) as channel:
        return [_answer(LocalizationServiceStub(channel), i) for i in range(QUERIES)]


def _answer(stub: LocalizationServiceStub, index: int) -> bytes:
    photograph = room().queries[index]
    intrinsics = wire.camera_to_message(photograph.camera)
    request = pb.LocalizeRequest(scene="scenes/room", image=photograph.data, intrinsics=intrinsics)
    request.options.include_debug = True
    request.options.ignore_calibration = True  # which is made at some time after the matches
    return essence(stub.Localize(request, timeout=60))


@pytest.fixture(autouse=True)
def _without_agreements(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing but queries looks for pairs: how well a scene's poses agree is computed from pairs, too."""
    monkeypatch.setattr(SceneAgreements, "touch", lambda _, scene_key: None)


@pytest.fixture(scope="module")
def unmatched(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[bytes]]:
    """A folder with a scene without stored pairs, and the answers of a server without stored pairs."""
    data_dir = tmp_path_factory.mktemp("unmatched") / "data"
    with serving_really(data_dir, background_matching=False) as served:
        with Client(served.address) as client:
            client.create_scene("room")
            added = [NewReference(it.name, it.data, it.camera, it.world_from_camera) for it in room().references]
            client.add_references("room", added[1:REFERENCES])
            client.add_references("room", added[:1])  # the last one: it is matched with all others
        return data_dir, answers(served)


@pytest.fixture
def data_dir(unmatched: tuple[Path, list[bytes]], tmp_path: Path) -> Path:
    """A copy of the folder."""
    return Path(shutil.copytree(unmatched[0], tmp_path / "data"))


@pytest.fixture(scope="module")
def matched_once(unmatched: tuple[Path, list[bytes]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    data_dir = Path(shutil.copytree(unmatched[0], tmp_path_factory.mktemp("matched") / "data"))
    with serving_really(data_dir) as served:
        wait_until(lambda: served.value("mapless_background_pairs_total") == 2 * PAIRS)
        wait_until(lambda: served.value("mapless_background_waiting") == 0)
        assert served.value("mapless_background_failures_total") == 0
    return data_dir


@pytest.fixture
def matched(matched_once: Path, tmp_path: Path) -> Path:
    """A copy of the folder in which all pairs, strict and wide, are stored."""
    return Path(shutil.copytree(matched_once, tmp_path / "data"))


@pytest.fixture
def expected(unmatched: tuple[Path, list[bytes]]) -> list[bytes]:
    return unmatched[1]


def count_pairs(data_dir: Path) -> int:
    with closing(Folder(data_dir).open_as_is()) as database, database.read() as connection:
        return int(connection.exec_driver_sql("SELECT count(*) FROM reference_pair").scalar_one())


def test_answers_are_the_same_with_stored_pairs(matched: Path, expected: list[bytes]) -> None:
    with serving_really(matched, background_matching=False) as served:
        assert answers(served) == expected
        assert served.value("mapless_stored_pairs_total", result="stored") > 0
        assert served.value("mapless_stored_pairs_total", result="absent") == 0


def test_switched_off_nothing_is_made(data_dir: Path, expected: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BackgroundMatching, "_claim", lambda _: pytest.fail("a reference was claimed"))
    with serving_really(data_dir, background_matching=False) as served:
        assert answers(served) == expected
        assert served.value("mapless_stored_pairs_total", result="stored") == 0
        assert served.value("mapless_stored_pairs_total", result="absent") > 0
        assert served.value("mapless_background_failures_total") == 0


def test_switched_off_damaged_pairs_are_deleted(matched: Path, expected: list[bytes]) -> None:
    Folder(matched).execute("UPDATE reference_pair SET data = zeroblob(16)")
    with serving_really(matched, background_matching=False) as served:
        assert answers(served) == expected
        damaged = served.value("mapless_stored_pairs_total", result="damaged")
        wait_until(lambda: count_pairs(matched) == 2 * PAIRS - damaged)
        assert served.value("mapless_background_pairs_total") == 0
