"""The limits of a capture folder hold at every moment, whatever is in it; with planted files."""

import hashlib
import json
import os
import shutil
import stat
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.captures import (
    IMAGES,
    NOW_S,
    a_call,
    blobs_of,
    files,
    opened,
    reference,
    refuse_to_delete,
    write_one,
)

from mapless_server.observability.logs import RepeatFilter
from mapless_server.observability.metrics import Metrics
from mapless_server.services.capture import deletion
from mapless_server.services.capture import files as files_module
from mapless_server.services.capture import folder as folder_module
from mapless_server.services.capture.calls import (
    BlobDeleted,
    CapturedPart,
    CaptureError,
    decode_call,
)
from mapless_server.services.capture.files import write_whole
from mapless_server.services.capture.folder import Retention
from mapless_server.services.capture.recorder import open_recorder
from mapless_server.settings import ConfigError, load_settings
from mapless_server.store import Store
from mapless_tools.replay.report import Selection


def test_references_are_kept_once_until_no_call_needs_them(tmp_path: Path) -> None:
    folder = opened(tmp_path / "c")
    for number, references in enumerate([(0, 1), (1, 2), (1, 2)]):
        call = a_call(number, references)
        missing = {name: data for name, data in blobs_of(call).items() if not folder.has_blob("acme", name)}
        assert len(missing) == (2, 1, 0)[number]
        assert folder.add(call, missing)
    assert len(files(tmp_path / "c")) == 3 + 3
    for count, left in ((5, 2), (3, 1), (0, 0)):
        folder.remove_all(folder.entries()[:1])
        assert (len(files(tmp_path / "c")), len(folder.entries())) == ((2 + 2, 1 + 2, 0)[2 - left], left), count
    assert folder.disk_bytes == 0
    folder.close()


def test_only_the_owner_may_read(tmp_path: Path) -> None:
    (tmp_path / "c").mkdir(mode=0o755)
    folder = opened(tmp_path / "c")
    call = a_call()
    folder.add(call, blobs_of(call))
    assert {stat.S_IMODE(it.stat().st_mode) for it in files(tmp_path / "c")} == {0o600}
    assert stat.S_IMODE((tmp_path / "c").stat().st_mode) == 0o700
    folder.close()


def test_the_limit_of_size_holds_at_every_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Looked at after each file that is written, unfinished ones and whole blocks counted; the oldest go first."""
    limit, most = 300_000, []

    def watched(path: Path, data: bytes) -> None:
        write_whole(path, data)
        most.append(sum(-(-it.stat().st_size // 4096) * 4096 for it in files(tmp_path / "c")))

    for module in (folder_module, files_module):
        monkeypatch.setattr(module, "write_whole", watched)
    folder = opened(tmp_path / "c", Retention(3600.0, limit))
    random = np.random.default_rng(1)
    for number in range(60):
        references = tuple(random.choice(8, 3, replace=False).tolist())
        call = a_call(number, references, size=int(random.integers(100, 60_000)))
        missing = {name: data for name, data in blobs_of(call).items() if not folder.has_blob("acme", name)}
        assert folder.add(call, missing)
        assert folder.disk_bytes == most[-1]
    assert max(most) <= limit
    kept = [decode_call(it.path.read_bytes()).request_id for it in folder.entries()]
    assert kept == [f"id-{number}" for number in range(60 - len(kept), 60)]
    assert 2 <= len(kept) < 60
    before = files(tmp_path / "c")
    too_large = a_call(99, size=limit)
    assert not folder.add(too_large, blobs_of(too_large))
    assert files(tmp_path / "c") == before
    folder.close()


def test_expired_calls_are_deleted_at_start_and_while_idle(tmp_path: Path) -> None:
    now_s = [NOW_S]
    folder = opened(tmp_path / "c", Retention(100.0, 2**20), lambda: now_s[0])
    for number in range(3):
        call = a_call(number, (number,), now_s[0])
        folder.add(call, blobs_of(call))
        now_s[0] += 40
    assert len(folder.entries()) == 3
    assert folder.expire() == pytest.approx(20, abs=1)  # the first is 120 s old, the second 80
    assert len(folder.entries()) == 2
    folder.close()
    now_s[0] += 30
    folder = opened(tmp_path / "c", Retention(100.0, 2**20), lambda: now_s[0])
    assert [it.references for it in folder.entries()] == [{("r2", "key-2")}]
    assert len(files(tmp_path / "c")) == 2
    folder.close()
    now_s[0] -= 10_000  # the clock is set back: its age is unknown
    folder = opened(tmp_path / "c", Retention(100.0, 2**20), lambda: now_s[0])
    assert files(tmp_path / "c") == []
    folder.close()


def test_calls_expire_although_the_clock_is_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Back: what has passed counts. Ahead: the clock does. And a call that was ahead of the clock stays no longer."""
    now_s, passed_s = [NOW_S], [0.0]
    monkeypatch.setattr(folder_module, "time", SimpleNamespace(monotonic=lambda: passed_s[0]))
    folder = opened(tmp_path / "c", Retention(100.0, 2**20), lambda: now_s[0])
    folder.add(a_call(0, ()), {})
    folder.add(a_call(1, (), NOW_S + 50), {})
    now_s[0] -= 10_000
    passed_s[0] = 99.0
    assert (folder.expire(), len(folder.entries())) == (1.0, 2)
    passed_s[0] = 100.0
    assert (folder.expire(), len(folder.entries()), files(tmp_path / "c")) == (100.0, 0, [])
    folder.add(a_call(2, (), now_s[0]), {})
    now_s[0] += 60
    assert (folder.expire(), len(folder.entries())) == (40.0, 1)
    now_s[0] += 40
    assert (folder.expire(), len(folder.entries())) == (100.0, 0)
    folder.close()


def test_leftovers_of_a_crash_are_deleted_at_start(tmp_path: Path) -> None:
    """Unfinished files, blobs without a call, calls without a blob, and calls that are cut; but no foreign files."""
    folder = opened(tmp_path / "c")
    for number in range(3):
        call = a_call(number, (number,))
        folder.add(call, blobs_of(call))
    first, second, third = folder.entries()
    folder.close()
    first.path.write_bytes(first.path.read_bytes()[:-1])
    next(iter(second.blobs)).unlink()
    third.path.with_name("x.call.tmp").write_bytes(b"half")
    (next(iter(third.blobs)).parent / f"{77:064x}").write_bytes(b"orphan")
    (tmp_path / "c" / "notes.txt").write_text("of the operator")
    folder = opened(tmp_path / "c")
    assert [it.path for it in folder.entries()] == [third.path]
    assert set(files(tmp_path / "c")) == {third.path, *third.blobs, tmp_path / "c" / "notes.txt"}
    folder.close()


def test_files_deleted_by_hand_are_dropped(tmp_path: Path) -> None:
    folder = opened(tmp_path / "c")
    for number in range(2):
        call = a_call(number, (number,))
        folder.add(call, blobs_of(call))
    folder.entries()[0].path.unlink()
    next(iter(folder.entries()[1].blobs)).unlink()
    folder.forget_deleted()
    assert (len(folder.entries()), folder.disk_bytes, files(tmp_path / "c")) == (0, 0, [])
    assert folder.add(call, blobs_of(call))
    folder.close()


def test_one_file_that_cannot_be_deleted_keeps_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither a call nor a blob; it stays counted, is reported, and is deleted as soon as it can be."""
    now_s = [NOW_S]
    folder = opened(tmp_path / "c", Retention(100.0, 2**20), lambda: now_s[0])
    for number in range(4):
        call = a_call(number, (number,))
        folder.add(call, blobs_of(call))
    entries = folder.entries()
    stuck = {entries[0].path, next(iter(entries[2].blobs))}
    refuse_to_delete(stuck, monkeypatch)
    now_s[0] += 101
    for _ in range(2):
        with pytest.raises(PermissionError):
            folder.expire()
        assert set(files(tmp_path / "c")) == {*stuck, *entries[0].blobs}
        assert folder.disk_bytes == sum(-(-it.stat().st_size // 4096) * 4096 for it in files(tmp_path / "c"))
    monkeypatch.undo()
    folder.expire()
    assert (files(tmp_path / "c"), folder.disk_bytes, len(folder.entries())) == ([], 0, 0)
    folder.close()


@pytest.mark.parametrize("content", [b"", IMAGES[f"{0:064x}"][:-1]])
def test_a_blob_that_was_cut_is_written_anew(tmp_path: Path, content: bytes) -> None:
    """As after a power failure; calls that need it cannot be replayed, and are deleted."""
    data = IMAGES[f"{0:064x}"]
    name = hashlib.sha256(data).hexdigest()
    part = CapturedPart("image", 7, (replace(reference(0), image_sha256=name),))
    first, second = (replace(a_call(number), parts=(part,)) for number in range(2))
    folder = opened(tmp_path / "c")
    folder.add(first, {name: data})
    (path,) = folder.entries()[0].blobs
    folder.close()
    path.write_bytes(content)
    folder = opened(tmp_path / "c")
    assert not folder.has_blob("acme", name)
    assert len(folder.entries()) == 0
    folder.add(second, {name: data})
    assert path.read_bytes() == data
    folder.close()
    folder = opened(tmp_path / "c")
    assert folder.has_blob("acme", name)
    assert len(folder.entries()) == 1
    folder.close()


def test_a_file_unreadable_at_start_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_one(tmp_path / "c")

    def refused(path: Path) -> bytes:
        raise PermissionError(13, "Permission denied", str(path))

    read = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda it: refused(it) if it.suffix == ".call" else read(it))
    with pytest.raises(CaptureError, match=r"cannot be used: .*\.call: Permission denied"):
        opened(tmp_path / "c")
    monkeypatch.undo()
    opened(tmp_path / "c").close()


def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = opened(tmp_path / "c")

    def full(path: Path, data: bytes) -> None:
        if path.suffix:
            raise OSError(28, "No space left on device")
        write_whole(path, data)

    for module in (folder_module, files_module):
        monkeypatch.setattr(module, "write_whole", full)
    with pytest.raises(OSError, match="No space"):
        folder.add(a_call(), blobs_of(a_call()))
    assert (files(tmp_path / "c"), folder.disk_bytes, len(folder.entries())) == ([], 0, 0)
    folder.close()


def test_undeletable_entries_never_exceed_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Others go in place of a call that cannot be deleted; where that is not enough nothing is written."""
    limit, random = 100_000, np.random.default_rng(3)
    folder = opened(tmp_path / "c", Retention(3600.0, limit))
    stuck = set[Path]()
    refuse_to_delete(stuck, monkeypatch)
    for number in range(3):
        folder.add(a_call(number, (number,), size=1000), blobs_of(a_call(number, (number,))))
    first = folder.entries()[0]
    stuck.add(first.path)
    assert folder.add(a_call(3, (3,), size=20_000), blobs_of(a_call(3, (3,))))
    assert folder.entries()[0].path == first.path
    stuck.update(files(tmp_path / "c"))
    for number in range(4, 8):
        call = a_call(number, (number,), size=int(random.integers(30_000, 60_000)))
        with pytest.raises(OSError, match="leaves no room"):
            folder.add(call, blobs_of(call))
        assert sum(-(-it.stat().st_size // 4096) * 4096 for it in files(tmp_path / "c")) == folder.disk_bytes <= limit
    folder.close()


@pytest.mark.parametrize("left", ["lock", "marker, half", "marker, empty", "calls", "nothing"])
def test_a_folder_left_by_a_kill_or_a_deletion_is_opened(tmp_path: Path, left: str) -> None:
    """And its limits hold again."""
    path = tmp_path / "c"
    write_one(path)
    (path / "mapless-capture.json").unlink()
    if left == "nothing":
        (path / "lock").unlink()
    if left != "calls":
        shutil.rmtree(path / "tenants")
    if left == "marker, half":
        (path / "mapless-capture.json.tmp").write_text('{"for')
    if left == "marker, empty":
        (path / "mapless-capture.json").touch()
    folder = opened(path, clock=lambda: NOW_S + 10_000)
    assert sorted(it.name for it in path.rglob("*") if it.is_file()) == ["lock", "mapless-capture.json"]
    folder.close()


def test_a_folder_the_full_disk_left_out_is_opened_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, data: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files_module, "write_whole", full)
    with pytest.raises(CaptureError, match="No space left"):
        opened(tmp_path / "c")
    monkeypatch.undo()
    opened(tmp_path / "c").close()


def test_a_folder_deleted_by_hand_is_made_by_its_server_alone(tmp_path: Path) -> None:
    path = tmp_path / "c"
    folder = opened(path)
    folder.add(a_call(), blobs_of(a_call()))
    shutil.rmtree(path)
    with pytest.raises(BlobDeleted):
        folder.add(a_call(1), {})
    assert folder.add(a_call(1), blobs_of(a_call(1)))
    assert len(folder.entries()) == 1
    assert stat.S_IMODE(path.stat().st_mode) == 0o700
    with pytest.raises(CaptureError, match="in use by another server"):
        opened(path)
    shutil.rmtree(path)
    other = opened(path)
    with pytest.raises(CaptureError, match="in use by another server"):
        folder.add(a_call(2), blobs_of(a_call(2)))
    assert files(path) == []
    other.close()
    folder.close()
    opened(path).close()


@pytest.mark.parametrize("place", ["tenants", "tenants/acme", "tenants/acme/blobs", "tenants/acme/calls/hall"])
@pytest.mark.parametrize("fault", ["link", "locked"])
def test_a_folder_that_cannot_be_read_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, fault: str
) -> None:
    """Its calls could not be deleted on time; and files elsewhere are not deleted."""
    path = tmp_path / "c"
    write_one(path)
    before = len(files(path))
    if fault == "link":
        (path / place).rename(tmp_path / "elsewhere")
        (path / place).symlink_to(tmp_path / "elsewhere")
    else:
        scandir = os.scandir

        def locked(at: Any) -> Any:
            if Path(at) == path / place:
                raise PermissionError(13, "Permission denied", str(at))
            return scandir(at)

        monkeypatch.setattr(os, "scandir", locked)
    with pytest.raises(CaptureError, match=rf"cannot be used: .*{place}: (a symbolic link|Permission denied)"):
        opened(path)
    with pytest.raises(CaptureError, match=rf"{place} cannot be read: (a symbolic link|Permission denied)"):
        Selection().files(path)
    monkeypatch.undo()
    elsewhere = files(tmp_path / "elsewhere")
    assert len(files(path)) + len(elsewhere) == before


def test_folders_that_cannot_be_used_are_rejected(tmp_path: Path) -> None:
    folder = opened(tmp_path / "c")
    with pytest.raises(CaptureError, match="in use by another server"):
        opened(tmp_path / "c")
    folder.close()
    (tmp_path / "c" / "mapless-capture.json").write_text(json.dumps({"format": 2}))
    with pytest.raises(CaptureError, match="has format 2"):
        opened(tmp_path / "c")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("years of work")
    with pytest.raises(CaptureError, match="holds something else"):
        opened(tmp_path / "full")
    (tmp_path / "file").write_text("")
    with pytest.raises(CaptureError, match="cannot be used"):
        opened(tmp_path / "file")
    if os.geteuid():
        (tmp_path / "locked").mkdir(mode=0o500)
        with pytest.raises(CaptureError, match="cannot be used"):
            opened(tmp_path / "locked")


@pytest.mark.parametrize(("capture", "data"), [("d/c", "d"), ("d", "d"), ("d", "d/c"), ("d/../d/c", "d")])
def test_store_and_capture_folder_are_apart(tmp_path: Path, capture: str, data: str) -> None:
    with pytest.raises(ConfigError, match="folders apart"):
        load_settings({"capture_dir": tmp_path / capture, "data_dir": tmp_path / data})


def test_an_invalid_tenant_is_rejected(tmp_path: Path) -> None:
    settings = load_settings({"capture_dir": tmp_path / "captured", "capture_tenants": "a,../b"}).settings
    with pytest.raises(CaptureError, match="capture_tenants"), Store.open(tmp_path / "store") as store:
        open_recorder(settings, store, Metrics())
    assert not (tmp_path / "captured").exists()


def test_a_frequent_fault_of_deleting_hides_no_other_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    def expire() -> None:
        deletion._log_fault("too old", OSError(13, "Permission denied"))

    def follow() -> None:
        deletion._log_fault("deleted", OSError(13, "Permission denied"))

    for log in (*[expire] * 20, follow):
        log()
    passes = RepeatFilter(burst=10).filter
    assert [it.getMessage().split(":")[0] for it in caplog.records if passes(it)] == ["too old"] * 10 + ["deleted"]
