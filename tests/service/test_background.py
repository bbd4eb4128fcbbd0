"""Servers that match references ahead of queries: the same answers for less work, also after one was killed."""

import os
import shutil
import signal
from contextlib import closing
from pathlib import Path

import grpc
import pytest
from support.messages import essence
from support.servers import RunningServer, serving_really
from support.stores import Folder
from support.waiting import wait_until

from mapless import Client, LocalizationResult, NewReference, wire
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless_server.scenes.background import BackgroundMatching
from mapless_server.store import calibrations, pairs, rows
from mapless_tools.child import child_server
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


@pytest.mark.nightly
def test_what_a_killed_server_began_is_finished(
    data_dir: Path, expected: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    with child_server(data_dir) as child:
        wait_until(lambda: count_pairs(data_dir) > 0)
        os.kill(child.process_id, signal.SIGKILL)
    begun = count_pairs(data_dir)
    assert 0 < begun < 2 * PAIRS
    now_us = rows.now_us
    monkeypatch.setattr(rows, "now_us", lambda: now_us() + round(1e6 * pairs.CLAIM_S))
    with serving_really(data_dir) as served:
        wait_until(lambda: served.value("mapless_background_pairs_total") == 2 * PAIRS - begun)
    assert count_pairs(data_dir) == 2 * PAIRS
    with serving_really(data_dir, background_matching=False) as served:
        assert answers(served) == expected


@pytest.mark.nightly
def test_a_killed_servers_scene_is_calibrated_by_the_next(
    matched: Path, expected: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    def claims() -> int:
        with closing(Folder(matched).open_as_is()) as database, database.read() as connection:
            count = "SELECT count(*) FROM scene_calibration WHERE data IS NULL AND failure_count = 0"
            return int(connection.exec_driver_sql(count).scalar_one())

    Folder(matched).execute("DELETE FROM scene_calibration")
    with child_server(matched) as child:
        wait_until(lambda: claims() == 1)
        os.kill(child.process_id, signal.SIGKILL)
    assert claims() == 1
    now_us = rows.now_us
    monkeypatch.setattr(rows, "now_us", lambda: now_us() + round(1e6 * calibrations.CLAIM_S))
    with serving_really(matched) as served:
        wait_until(lambda: served.value("mapless_calibrations_total") == 1)
        assert served.value("mapless_calibration_failures_total") == 0
        assert answers(served) == expected  # which ask for no calibration
        photograph = room().queries[0]
        with Client(served.address) as client:
            answer = client.localize(photograph.data, photograph.camera, "room")
    assert isinstance(answer, LocalizationResult)
    assert answer.accuracy is not None
    assert answer.accuracy.calibration == "SELF"
    assert 3 <= answer.accuracy.sample_size <= REFERENCES
