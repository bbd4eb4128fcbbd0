"""The recorder never delays or fails a call, counts what it drops, and forgets what the store forgets; all planted."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import grpc
import pytest
from programs import wait_until
from servers import CAMERA, PHOTO, localize_request, pose, serving

from mapless import Client, NewReference
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless_server.call import Call
from mapless_server.capture import recorder as recorder_module
from mapless_server.capture.calls import CapturedFailure, decode_call
from mapless_server.capture.files import calls_of
from mapless_server.capture.folder import CaptureFolder, Retention
from mapless_server.capture.recorder import CAPTURED_KEY, Recorder
from mapless_server.principal import Principal
from mapless_server.store import Store


@dataclass
class Counts:
    """Hears what is captured and what is not."""

    kept: int = 0
    dropped: Counter[str] = field(default_factory=Counter)

    def captured(self) -> None:
        self.kept += 1

    def capture_dropped(self, reason: str) -> None:
        self.dropped[reason] += 1


def captured_in(folder: Path) -> list[Path]:
    return sorted(calls_of(folder))


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Client, LocalizationServiceStub, Path]]:
    """A server that captures, and looks at its store all the time."""
    monkeypatch.setattr(recorder_module, "STORE_CHECK_S", 0.05)
    folder = tmp_path / "captured"
    with (
        serving(tmp_path / "data", capture_dir=folder) as server,
        Client(server.address) as client,
        grpc.insecure_channel(server.address) as channel,
    ):
        client.create_scene("s")
        client.add_references("s", [NewReference(f"r{i}", PHOTO, CAMERA, pose(i)) for i in range(3)])
        yield client, LocalizationServiceStub(channel), folder


def test_callers_are_told(served: tuple[Client, LocalizationServiceStub, Path]) -> None:
    _, stub, folder = served
    answer, call = stub.Localize.with_call(localize_request("s"), timeout=30)
    assert (CAPTURED_KEY, "1") in [tuple(it) for it in call.trailing_metadata()]
    wait_until(lambda: captured_in(folder))
    kept = decode_call(captured_in(folder)[0].read_bytes())
    assert kept.response == answer.SerializeToString()
    assert kept.request == localize_request("s").SerializeToString()
    assert kept.request_id == answer.diagnostics.request_id


@pytest.mark.parametrize("deleted", ["scene", "reference", "scene made anew"])
def test_what_was_made_of_a_deleted_scene_or_reference_goes(
    served: tuple[Client, LocalizationServiceStub, Path], deleted: str
) -> None:
    client, _, folder = served
    client.create_scene("other")
    client.add_references("other", [NewReference(f"r{i}", PHOTO, CAMERA, pose(i)) for i in range(2)])
    client.localize(PHOTO, CAMERA, "other")
    client.localize(PHOTO, CAMERA, "s", ["r0", "r1"])
    wait_until(lambda: len(captured_in(folder)) == 2)
    if deleted == "reference":
        client.delete_reference("s", "r2")  # which no call was compared with
        client.delete_reference("s", "r1")
    else:
        client.delete_scene("s")
    if deleted == "scene made anew":
        client.create_scene("s")
    wait_until(lambda: [decode_call(it.read_bytes()).scene_id for it in captured_in(folder)] == ["other"])


def recorder_of(folder: Path, counts: Counts, **options: Any) -> Recorder:
    captured = CaptureFolder(folder / "captured", Retention(3600.0, 2**20))
    return Recorder(captured, Store.open(folder / "data"), counts, **options)


def a_call(tenant: str = "default") -> Call:
    return Call("id", time.monotonic(), math.inf, Principal(tenant=tenant))


FAILURE = CapturedFailure("NOT_FOUND", "NOT_FOUND", "no such scene")


def test_a_slow_disk_holds_up_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What does not fit into the queue is dropped at once, and counted."""
    counts = Counts()
    recorder = recorder_of(tmp_path, counts)
    monkeypatch.setattr(recorder.folder, "add", lambda *_: time.sleep(0.2))
    for _ in range(recorder_module.MAX_WAITING + 10):
        recorder.failed("Localize", localize_request("s"), a_call(), FAILURE)
    assert counts.dropped["queue"] >= 9
    monkeypatch.undo()
    recorder.close()


def test_a_full_disk_pauses_and_fails_no_call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    counts = Counts()
    recorder = recorder_of(tmp_path, counts)

    def full(*_: object) -> bool:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(recorder.folder, "add", full)
    recorder.failed("Localize", localize_request("s"), a_call(), FAILURE)
    wait_until(lambda: counts.dropped["disk"] == 1)
    recorder.failed("Localize", localize_request("s"), a_call(), FAILURE)
    assert counts.dropped["disk"] == 2
    assert "nothing is captured for 60 s: [Errno 28] No space left on device" in caplog.text
    recorder.close()


def test_only_the_tenants_that_are_named_are_captured(tmp_path: Path) -> None:
    recorder = recorder_of(tmp_path, Counts(), tenants=frozenset({"acme"}))
    for tenant in ("default", "acme", "other"):
        recorder.failed("Localize", localize_request("s"), a_call(tenant), FAILURE)
    recorder.close()
    kept = [decode_call(it.read_bytes()).tenant for it in captured_in(tmp_path / "captured")]
    assert kept == ["acme"]


def test_a_share_of_the_calls_is_captured(tmp_path: Path) -> None:
    """One in two, within five standard deviations; told by what is dropped, since nothing of these calls exists."""
    counts = Counts()
    recorder = recorder_of(tmp_path, counts, share=0.5)
    told = 0
    for _ in range(400):
        call = a_call()
        request, part = localize_request("s"), cast(Any, None)
        recorder.answered("Localize", request, cast(Any, request), call, part)
        told += bool(call.trailing)
        wait_until(lambda: not recorder._waiting)
    recorder.close()
    assert 150 < told < 250
    assert sum(counts.dropped.values()) == told
