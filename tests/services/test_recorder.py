"""The recorder never delays or fails a call, counts what it drops, and deletes what the store deletes; all planted."""

import gc
import math
import threading
import time
import weakref
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
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
from mapless_server.errors import DataLoss, NotFound, Unavailable
from mapless_server.method.features.views import Features, PosedView, View
from mapless_server.rpc import Call
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.scenes.scene_agreements import SceneAgreements
from mapless_server.security import Principal, SceneKey, key_of
from mapless_server.services.capture import deletion as deletion_module
from mapless_server.services.capture import recorder as recorder_module
from mapless_server.services.capture.calls import (
    BlobDeleted,
    CapturedCall,
    CapturedPart,
    CapturedReference,
    decode_call,
)
from mapless_server.services.capture.deletion import StaleCalls
from mapless_server.services.capture.files import blobs_of, calls_of
from mapless_server.services.capture.folder import CaptureFolder, Retention
from mapless_server.services.capture.recorder import Recorder
from mapless_server.store import SceneAttributes, SceneRecord, Store, reader, time_us
from mapless_server.store.reader import StoreReader


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


def captured_in(folder: Path) -> list[Path]:
    return sorted(calls_of(folder))


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Client, LocalizationServiceStub, Path]]:
    """A server that captures, and looks at its store all the time."""
    monkeypatch.setattr(deletion_module, "STORE_CHECK_S", 0.05)
    folder = tmp_path / "captured"
    with (
        serving(tmp_path / "data", capture_dir=folder) as server,
        Client(server.address) as client,
        grpc.insecure_channel(server.address) as channel,
    ):
        make_scene(client, "s", 3)
        yield client, LocalizationServiceStub(channel), folder


def test_a_captured_answer_is_marked(served: tuple[Client, LocalizationServiceStub, Path]) -> None:
    _, stub, folder = served
    answer = stub.Localize(localize_request("s"), timeout=30)
    assert answer.diagnostics.captured
    wait_until(lambda: captured_in(folder))
    kept = decode_call(captured_in(folder)[0].read_bytes())
    assert kept.response == answer.SerializeToString()
    assert kept.request == localize_request("s").SerializeToString()
    assert kept.request_id == answer.diagnostics.request_id


def test_each_photograph_of_a_captured_group_is_marked(served: tuple[Client, LocalizationServiceStub, Path]) -> None:
    _, stub, folder = served
    about: dict[str, Any] = {"image": PHOTO, "intrinsics": wire.camera_to_message(CAMERA)}
    poses = [wire.transform_to_message(pose(x_m)) for x_m in (0.0, 0.1)]
    images = [pb.RigImage(rig_from_camera=it, **about) for it in poses]
    frames = [pb.SequenceFrame(session_from_camera=it, **about) for it in poses]
    answers = (
        stub.LocalizeRig(pb.LocalizeRigRequest(scene="scenes/s", images=images), timeout=30),
        stub.LocalizeSequence(pb.LocalizeSequenceRequest(scene="scenes/s", frames=frames), timeout=30),
    )
    secret = pb.LocalizeOptions(confidential=True)
    for kept_out in (
        stub.LocalizeRig(pb.LocalizeRigRequest(scene="scenes/s", images=images, options=secret), timeout=30),
        stub.LocalizeSequence(pb.LocalizeSequenceRequest(scene="scenes/s", frames=frames, options=secret), timeout=30),
    ):
        assert [it.diagnostics.captured for it in kept_out.images] == [False, False]
    assert [[it.diagnostics.captured for it in answer.images] for answer in answers] == [[True, True]] * 2
    wait_until(lambda: len(captured_in(folder)) == 2)
    assert [decode_call(it.read_bytes()).response for it in captured_in(folder)] == [
        it.SerializeToString() for it in answers
    ]


@pytest.mark.parametrize("deleted", ["scene", "reference", "scene made anew"])
def test_calls_of_deleted_scenes_and_references_are_deleted(
    served: tuple[Client, LocalizationServiceStub, Path], deleted: str
) -> None:
    client, _, folder = served
    make_scene(client, "other", 2)
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
    wait_until(lambda: [it.parent.name for it in captured_in(folder)] == ["other"])


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    """A store with the scene "s" of each of three tenants."""
    with Store.open(tmp_path / "data") as store:
        for tenant in ("default", "acme", "other"):
            store.create_scene(key_of(tenant, "s"))
        yield store


@contextmanager
def recording(folder: Path, store: Store, counts: Counts, **options: Any) -> Iterator[Recorder]:
    keep_s = options.pop("keep_s", 3600.0)
    captured = CaptureFolder(folder / "captured", Retention(keep_s, 2**20))
    recorder = Recorder(captured, store, counts, **options)
    try:
        yield recorder
    finally:
        recorder.close()


def answer(recorder: Recorder, tenant: str = "default", *references: PosedView) -> pb.LocalizeResponse:
    """The record of a call that was answered with these references."""
    call = Call("id", time.monotonic(), math.inf, Principal(tenant=tenant))
    query = SimpleNamespace(photo=SimpleNamespace(field="image"))
    result = SimpleNamespace(choice=None, references=references, generation=1, attributes=SceneAttributes())
    part = cast(Any, (query, result))
    response = pb.LocalizeResponse()
    recorder.record(localize_request("s"), response, call, [part], ())
    return response


def a_view() -> View:
    return View(CAMERA, Features(*(np.zeros(shape, np.float32) for shape in ((1, 2), (1, 4), (1,)))))


def test_a_slow_disk_delays_no_call(tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """What does not fit into the queue is dropped at once, and counted."""
    counts = Counts()
    with recording(tmp_path, store, counts) as recorder:
        monkeypatch.setattr(recorder.folder, "add", lambda *_: time.sleep(0.2))
        for _ in range(recorder_module.MAX_QUEUED + 10):
            answer(recorder)
        assert counts.dropped["queue"] >= 9
        monkeypatch.undo()


def test_the_queue_is_bounded_in_bytes(tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """But for one call that waits alone."""
    monkeypatch.setattr(recorder_module, "MAX_QUEUED_BYTES", 100)
    counts, began, let_go = Counts(), threading.Event(), threading.Event()

    def slow(*_: object) -> bool:
        began.set()
        return let_go.wait(LIMIT_S)

    with recording(tmp_path, store, counts) as recorder:
        monkeypatch.setattr(recorder.folder, "add", slow)
        answer(recorder)
        began.wait(LIMIT_S)
        assert [answer(recorder).diagnostics.captured for _ in range(3)] == [True, False, False]
        let_go.set()
    assert (counts.kept, counts.dropped) == (2, {"queue": 2})


def test_a_full_disk_pauses_and_fails_no_call(
    tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Queued calls are not tried either, and the log has the fault once."""
    counts, tries, let_go = Counts(), [0], threading.Event()

    def full(*_: object) -> bool:
        tries[0] += 1
        let_go.wait(LIMIT_S)
        raise OSError(28, "No space left on device")

    with recording(tmp_path, store, counts) as recorder:
        monkeypatch.setattr(recorder.folder, "add", full)
        for _ in range(10):
            answer(recorder)
        let_go.set()
        wait_until(lambda: counts.dropped["disk"] == 10)
        assert not answer(recorder).diagnostics.captured
    assert (tries, counts.dropped) == ([1], {"disk": 11})
    assert caplog.text.count("nothing is captured for 60 s: [Errno 28] No space left on device") == 1


def test_an_unexpected_fault_is_logged_with_the_call(
    tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    counts = Counts()

    def broken(*_: object) -> bool:
        raise RuntimeError("a bug")

    with recording(tmp_path, store, counts) as recorder:
        monkeypatch.setattr(recorder.folder, "add", broken)
        for _ in range(10):
            answer(recorder)
    assert counts.dropped == {"fault": 10}
    assert caplog.text.count("capturing a call failed: a bug") == 10
    assert [it.request_id for it in caplog.records if hasattr(it, "request_id")] == ["id"] * 10


def test_calls_queued_at_the_closing_limit_are_counted(
    tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A disk so slow that it has written one call by then; the log counts the others."""
    monkeypatch.setattr(recorder_module, "CLOSING_LIMIT_S", 0.0)
    counts, began = Counts(), threading.Event()
    with recording(tmp_path, store, counts) as recorder:
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


@pytest.mark.parametrize(("times", "dropped"), [(2, {}), (3, {"fault": 1})])
def test_a_call_whose_blobs_are_deleted_is_collected_again(
    tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch, times: int, dropped: dict[str, int]
) -> None:
    """Not for ever."""
    counts, left = Counts(), [times]
    with recording(tmp_path, store, counts) as recorder:
        add = recorder.folder.add

        def meanwhile(*args: Any) -> bool:
            left[0] -= 1
            if left[0] >= 0:
                raise BlobDeleted
            return add(*args)

        monkeypatch.setattr(recorder.folder, "add", meanwhile)
        answer(recorder)
    assert (counts.kept, counts.dropped) == (1 - sum(dropped.values()), dropped)


@pytest.mark.parametrize("deleted", ["scene", "scene made anew", "reference"])
def test_a_call_deleted_while_queued_is_not_captured(
    tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch, deleted: str
) -> None:
    """Nor of a scene that is made anew: a call that used no reference is one of the scene before."""
    counts, get_scene, let_go = Counts(), StoreReader.get_scene, threading.Event()

    def slow(self: Any, scene_key: SceneKey) -> SceneRecord:
        let_go.wait(LIMIT_S)
        return get_scene(self, scene_key)

    monkeypatch.setattr(StoreReader, "get_scene", slow)
    with recording(tmp_path, store, counts) as recorder:
        if deleted == "reference":
            answer(recorder, "default", PosedView("k", "scenes/s/references/r0", a_view(), pose(0)))
        else:
            answer(recorder)
            store.delete_scene(key_of("default", "s"))
        if deleted == "scene made anew":
            store.create_scene(key_of("default", "s"))
        let_go.set()
    assert (counts.kept, counts.dropped) == (0, {"deleted": 1})


@pytest.mark.parametrize("fault", [Unavailable("the store is away"), DataLoss("damaged")])
def test_faults_of_the_store_are_counted(
    tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch, fault: Exception
) -> None:
    counts = Counts()

    def broken(*_: object) -> Any:
        raise fault

    monkeypatch.setattr(StoreReader, "get_scene", broken)
    with recording(tmp_path, store, counts) as recorder:
        answer(recorder)
    assert (counts.kept, counts.dropped) == (0, {"store": 1})


@pytest.mark.parametrize("stuck", ["call", "blob"])
def test_an_undeletable_file_keeps_no_other_scene(
    tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch, stuck: str
) -> None:
    """A folder stands in its place, as an operator may have it."""
    monkeypatch.setattr(deletion_module, "STORE_CHECK_S", 0.01)
    monkeypatch.setattr(deletion_module, "EXPIRY_CHECK_S", LIMIT_S)
    folder = CaptureFolder(tmp_path / "captured", Retention(3600.0, 2**20))
    reference = CapturedReference("r", "k", CAMERA, pose(0), "0" * 64, {})
    for tenant in ("acme", "other"):
        created_us = time_us(store.get_scene(key_of(tenant, "s")).create_time)
        part = CapturedPart("image", 1, (reference,) if tenant == "acme" else ())
        call = CapturedCall(tenant, time.time(), "Localize", tenant, "s", created_us, parts=(part,))
        folder.add(call, {"0" * 64: b"x"} if tenant == "acme" else {})
    first = folder.entries()[0]
    path = first.path if stuck == "call" else next(iter(first.blobs))
    path.unlink()
    path.mkdir()
    if stuck == "blob":
        with pytest.raises(IsADirectoryError):
            folder.remove_all([first])
    for tenant in ("acme", "other"):
        store.delete_scene(key_of(tenant, "s"))
    recorder = Recorder(folder, store, Counts())
    wait_until(lambda: [it.scene_key for it in folder.entries()] == [first.scene_key][stuck == "blob" :])
    assert captured_in(tmp_path / "captured") == []
    recorder.close()


def test_only_the_tenants_that_are_named_are_captured(tmp_path: Path, store: Store) -> None:
    with recording(tmp_path, store, Counts(), tenants=frozenset({"acme"})) as recorder:
        captured = [answer(recorder, tenant).diagnostics.captured for tenant in ("default", "acme", "other")]
    assert captured == [False, True, False]
    assert [decode_call(it.read_bytes()).tenant for it in captured_in(tmp_path / "captured")] == ["acme"]


@pytest.mark.parametrize("fault", ["unexpected", "hanging"])
def test_the_time_limit_holds_whatever_the_store_does(
    tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    """An unexpected fault at every check; and a database that does not answer, with a call that waits."""
    counts, checks, let_go = Counts(), [0], threading.Event()
    with recording(tmp_path, store, counts, keep_s=0.5) as recorder:
        answer(recorder)
        wait_until(lambda: counts.kept == 1)

        def broken(*_: object) -> Any:
            checks[0] += 1
            if fault == "hanging":
                let_go.wait(LIMIT_S)
            raise RuntimeError("no such table")

        monkeypatch.setattr(StoreReader, "get_scene", broken)
        answer(recorder)
        wait_until(lambda: checks[0] == 1)
        wait_until(lambda: len(recorder.folder.entries()) == 0)
        assert captured_in(tmp_path / "captured") == []
        let_go.set()
        wait_until(lambda: counts.dropped["fault"] == 1)
        monkeypatch.undo()
        answer(recorder)
        wait_until(lambda: counts.kept == 2)


def test_captured_calls_expire_without_any_call(tmp_path: Path) -> None:
    """After as many hours as the settings say."""
    folder = tmp_path / "captured"
    with (
        serving(tmp_path / "data", capture_dir=folder, capture_hours=1 / 3600) as server,
        Client(server.address) as client,
    ):
        make_scene(client)
        client.localize(PHOTO, CAMERA, "s")
        wait_until(lambda: server.value("mapless_captured_total") == 1)
        wait_until(lambda: not [*calls_of(folder), *blobs_of(folder)])


def test_the_start_waits_for_no_store_and_retries_each_round(
    tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, let_go = [0], threading.Event()

    def away(*_: object) -> Any:
        asked[0] += 1
        let_go.wait(LIMIT_S)
        raise Unavailable("the store is away")

    with recording(tmp_path, store, Counts()) as recorder:
        for tenant in ("default", "acme", "other"):
            answer(recorder, tenant)
    assert len(captured_in(tmp_path / "captured")) == 3
    monkeypatch.setattr(StoreReader, "get_scene", away)
    with recording(tmp_path, store, Counts()) as recorder:  # returns, although the store does not answer
        wait_until(lambda: asked[0] == 1)
        assert len(recorder.folder.entries()) == 3
        let_go.set()
    assert asked[0] == 1


@pytest.mark.parametrize("fault", [DataLoss("damaged"), RuntimeError("no such column"), Unavailable("away")])
def test_a_fault_of_one_scene_keeps_no_other_scene(tmp_path: Path, fault: Exception) -> None:
    """A damaged scene exists; an unexpected fault is raised after all other scenes have been checked."""
    folder = CaptureFolder(tmp_path / "c", Retention(3600.0, 2**20))
    for scene_id in ("a", "b", "c"):
        folder.add(CapturedCall(scene_id, time.time(), "Localize", "acme", scene_id, 0), {})

    def get_scene(scene_key: SceneKey) -> SceneRecord:
        if scene_key.endswith("b"):
            raise fault
        raise NotFound("there is none")

    with nullcontext() if isinstance(fault, DataLoss) else pytest.raises(type(fault)):
        assert StaleCalls(cast(Store, SimpleNamespace(get_scene=get_scene))).delete(folder) == 2
    left = ["b", "c"] if isinstance(fault, Unavailable) else ["b"]
    assert [it.parent.name for it in captured_in(tmp_path / "c")] == left
    folder.close()


def test_stored_data_is_not_read_again_and_queries_keep_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Features of each of two extractors are read once for all calls, and neither hits nor misses are counted."""
    read, features = Counter[str](), reader._read_features

    def counted(connection: Any, ids: Any, extractor: str) -> Any:
        read[threading.current_thread().name] += len(ids)
        return features(connection, ids, extractor)

    monkeypatch.setattr(reader, "_read_features", counted)
    for name in ("touch", "changed"):  # the comparison of references reads them, too
        monkeypatch.setattr(SceneAgreements, name, lambda *_: None)
    store = Store.open(tmp_path / "data")
    folder = tmp_path / "captured"
    with (
        serving(tmp_path / "data", store=store, features=("cheap", "strong"), workers=1, capture_dir=folder) as server,
        Client(server.address) as client,
    ):
        make_scene(client, "s", 5)
        client.localize(PHOTO, CAMERA, "s", [f"r{i}" for i in range(5)])
        wait_until(lambda: len(captured_in(folder)) == 1)
        before = read["capture"]
        for count in range(2, 6):
            client.localize(PHOTO, CAMERA, "s", [f"r{i}" for i in range(5)])
            wait_until(lambda count=count: len(captured_in(folder)) == count)  # type: ignore[misc]
        kept = decode_call(captured_in(folder)[-1].read_bytes())
        views = [set(it.views) for it in kept.parts[0].references]
        described = sum(len(it) for it in views)
        assert {"cheap"} <= set.intersection(*views)
        # What has no features of an extractor yet may have them the next time: only that is looked for.
        assert read["capture"] - before == 4 * (10 - described)
        hits_and_misses = store.reference_cache.hits + store.reference_cache.misses
        assert hits_and_misses == 5 * 5


def test_queued_calls_hold_no_features(tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reference's view that was used is free as soon as the call is answered, however long the disk takes."""
    let_go = threading.Event()
    with recording(tmp_path, store, Counts()) as recorder:
        monkeypatch.setattr(recorder.folder, "add", lambda *_: let_go.wait(LIMIT_S))
        view = a_view()
        held = weakref.ref(view)
        answer(recorder)
        answer(recorder, "default", PosedView("k", "scenes/s/references/r0", view, pose(0)))
        del view
        gc.collect()
        assert held() is None
        let_go.set()
