"""The recorder never delays or fails a call, counts what it drops, and deletes on time; all planted."""

import gc
import math
import threading
import time
import weakref
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import grpc
import numpy as np
import pytest
from support.servers import CAMERA, PHOTO, localize_request, make_scene, pose, serving
from support.waiting import LIMIT_S, wait_until

from mapless import Client, wire
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless_server.method.features.views import Features, PosedView, View
from mapless_server.observability.metrics import Metrics
from mapless_server.rpc import Call
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.security import Principal
from mapless_server.services.capture import recorder as recorder_module
from mapless_server.services.capture.calls import decode_call, diagnostics_of
from mapless_server.services.capture.folder import CaptureFolder, calls_of
from mapless_server.services.capture.recorder import Recorder
from mapless_server.settings import load_settings
from mapless_server.store import SceneAttributes


@dataclass
class Counts(BackgroundObserver):
    """Counts what is captured and what is not."""

    kept: int = 0
    dropped: Counter[str] = field(default_factory=Counter)

    def count(self, name: str, amount: float = 1.0, result: str = "") -> None:
        if name == "captured":
            self.kept += 1
        else:
            self.dropped[result] += 1


def test_what_is_captured_is_marked(tmp_path: Path) -> None:
    """Each photograph of a group, too, and none of a confidential call."""
    folder = tmp_path / "captured"
    about: dict[str, Any] = {"image": PHOTO, "intrinsics": wire.camera_to_message(CAMERA)}
    poses = [wire.transform_to_message(pose(x_m)) for x_m in (0.0, 0.1)]
    asked: dict[str, Any] = {
        "Localize": localize_request("s"),
        "LocalizeRig": pb.LocalizeRigRequest(
            scene="scenes/s", images=[pb.RigImage(rig_from_camera=it, **about) for it in poses]
        ),
        "LocalizeSequence": pb.LocalizeSequenceRequest(
            scene="scenes/s", frames=[pb.SequenceFrame(session_from_camera=it, **about) for it in poses]
        ),
    }
    with (
        serving(tmp_path / "data", capture_dir=folder) as server,
        Client(server.address) as client,
        grpc.insecure_channel(server.address) as channel,
    ):
        make_scene(client, "s", 3)
        stub = LocalizationServiceStub(channel)
        for count, (method, request) in enumerate(asked.items(), 1):
            answer = getattr(stub, method)(request, timeout=LIMIT_S)
            assert [it.captured for it in diagnostics_of(answer)] in ([True], [True, True])
            wait_until(lambda count=count: server.value("mapless_captured_total") == count)  # type: ignore[misc]
            kept = decode_call(calls_of(folder)[-1].read_bytes())
            assert (kept.request, kept.response) == (request.SerializeToString(), answer.SerializeToString())
            assert kept.request_id == diagnostics_of(answer)[0].request_id
            request.options.confidential = True
            answer = getattr(stub, method)(request, timeout=LIMIT_S)
            assert not any(it.captured for it in diagnostics_of(answer))
    assert len(calls_of(folder)) == 3


def test_captured_calls_expire_without_any_call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After as many hours as the settings say."""
    monkeypatch.setattr(recorder_module, "circumstances_of", lambda *_: {})
    settings = load_settings({"capture_dir": tmp_path / "captured", "capture_hours": 2 / 3600}).settings
    recorder = recorder_module.open_recorder(settings, Metrics())
    assert recorder is not None
    answer(recorder)
    wait_until(lambda: recorder.folder.disk_bytes)
    wait_until(lambda: not recorder.folder.disk_bytes)
    assert calls_of(tmp_path / "captured") == []
    recorder.close()


@contextmanager
def recording(path: Path, counts: Counts, **options: Any) -> Iterator[Recorder]:
    recorder = Recorder(CaptureFolder(path / "captured", 3600.0, 2**20), counts, **options)
    try:
        yield recorder
    finally:
        recorder.close()


def answer(recorder: Recorder, tenant: str = "default", *references: PosedView) -> pb.LocalizeResponse:
    """The answer to a call that was computed from these references."""
    call = Call("id", time.monotonic(), math.inf, Principal(tenant=tenant))
    query = SimpleNamespace(photo=SimpleNamespace(field="image"))
    known = {"choice": None, "generation": 1, "attributes": SceneAttributes(), "scene_key": "s"}
    result = SimpleNamespace(references=references, **known)
    part = cast(Any, (query, result))
    response = pb.LocalizeResponse()
    recorder.record(localize_request("s"), response, call, [part], ())
    return response


def test_the_queue_is_bounded_and_delays_no_call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In calls and, but for one call that waits alone, in bytes."""
    counts, began, let_go = Counts(), threading.Event(), threading.Event()

    def slow(*_: object) -> bool:
        began.set()
        return let_go.wait(LIMIT_S)

    with recording(tmp_path, counts) as recorder:
        monkeypatch.setattr(recorder.folder, "add", slow)
        answer(recorder)
        began.wait(LIMIT_S)
        for _ in range(recorder_module.MAX_QUEUED + 10):
            answer(recorder)
        assert counts.dropped == {"queue": 10}
        let_go.set()
        wait_until(lambda: counts.kept == recorder_module.MAX_QUEUED + 1)
        monkeypatch.setattr(recorder_module, "MAX_QUEUED_BYTES", 100)
        began.clear()
        let_go.clear()
        answer(recorder)
        began.wait(LIMIT_S)
        assert [answer(recorder).diagnostics.captured for _ in range(3)] == [True, False, False]
        let_go.set()
    assert (counts.kept, counts.dropped) == (recorder_module.MAX_QUEUED + 3, {"queue": 12})


def test_a_full_disk_pauses_and_fails_no_call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Queued calls are not tried either, and the log has the fault once."""
    counts, tries, let_go = Counts(), [0], threading.Event()

    def full(*_: object) -> bool:
        tries[0] += 1
        let_go.wait(LIMIT_S)
        raise OSError(28, "No space left on device")

    with recording(tmp_path, counts) as recorder:
        monkeypatch.setattr(recorder.folder, "add", full)
        for _ in range(10):
            answer(recorder)
        let_go.set()
        wait_until(lambda: counts.dropped["disk"] == 10)
        assert not answer(recorder).diagnostics.captured
    assert (tries, counts.dropped) == ([1], {"disk": 11})
    assert caplog.text.count("nothing is captured for 60 s: [Errno 28] No space left on device") == 1


def test_an_unexpected_fault_ends_neither_capture_nor_deletion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    counts = Counts()

    def broken(*_: object) -> Any:
        raise RuntimeError("a bug")

    with recording(tmp_path, counts) as recorder:
        monkeypatch.setattr(recorder.folder, "tidy", broken)
        monkeypatch.setattr(recorder.folder, "add", broken)
        for _ in range(3):
            answer(recorder)
        wait_until(lambda: counts.dropped == {"fault": 3})
        monkeypatch.undo()
        answer(recorder)
    assert counts.kept == 1
    assert caplog.text.count("capturing a call failed: a bug") == 3
    assert [it.request_id for it in caplog.records if hasattr(it, "request_id")] == ["id"] * 3
    assert "captured calls that are too old cannot be deleted: a bug" in caplog.text


def test_calls_queued_at_the_closing_limit_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A disk so slow that it has written one call by then; the log counts the others."""
    monkeypatch.setattr(recorder_module, "CLOSING_LIMIT_S", 0.0)
    counts, began = Counts(), threading.Event()
    with recording(tmp_path, counts) as recorder:
        add = recorder.folder.add

        def slow(*args: Any) -> bool:
            began.set()
            wait_until(lambda: recorder.is_closing)
            return add(*args)

        monkeypatch.setattr(recorder.folder, "add", slow)
        for _ in range(6):
            answer(recorder)
        began.wait(LIMIT_S)
    assert (counts.kept, counts.dropped) == (1, {"queue": 5})
    assert caplog.text.count("a call was not captured: queue") == 5


def test_a_call_too_large_for_the_folder_is_counted(tmp_path: Path) -> None:
    counts = Counts()
    recorder = Recorder(CaptureFolder(tmp_path / "captured", 3600.0, 1), counts)
    answer(recorder)
    recorder.close()
    assert counts.dropped == {"size": 1}


def test_only_the_tenants_that_are_named_are_captured(tmp_path: Path) -> None:
    with recording(tmp_path, Counts(), tenants=frozenset({"acme"})) as recorder:
        captured = [answer(recorder, tenant).diagnostics.captured for tenant in ("default", "acme", "other")]
    assert captured == [False, True, False]
    assert [decode_call(it.read_bytes()).tenant for it in calls_of(tmp_path / "captured")] == ["acme"]


def test_queued_calls_hold_no_features(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reference's view that was used is free as soon as the call is answered, however long the disk takes."""
    let_go = threading.Event()
    with recording(tmp_path, Counts()) as recorder:
        monkeypatch.setattr(recorder.folder, "add", lambda *_: let_go.wait(LIMIT_S))
        view = View(CAMERA, Features(*(np.zeros(shape, np.float32) for shape in ((1, 2), (1, 4), (1,)))))
        held = weakref.ref(view)
        answer(recorder)
        answer(recorder, "default", PosedView("k", "scenes/s/references/r0", view, pose(0)))
        del view
        gc.collect()
        assert held() is None
        let_go.set()
