"""The limits of a capture folder hold at every moment, whatever is in it; with planted files."""

import os
import shutil
import stat
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.captures import NOW_S, Clock, a_call, files, filled, opened

from mapless_server.observability.metrics import Metrics
from mapless_server.services.capture import folder as folder_module
from mapless_server.services.capture.calls import CaptureError, decode_call
from mapless_server.services.capture.recorder import open_recorder
from mapless_server.settings import ConfigError, load_settings
from mapless_tools.replay.report import Selection, select


def blocks(folder: Path) -> int:
    return sum(-(-it.stat().st_size // 4096) * 4096 for it in files(folder))


def refuse_to_delete(stuck: set[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on files that are in the set cannot be deleted."""
    unlink = Path.unlink

    def refused(path: Path, missing_ok: bool = False) -> None:
        if path in stuck:
            raise PermissionError(1, "Operation not permitted")
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", refused)


def test_only_the_owner_may_read(tmp_path: Path) -> None:
    (tmp_path / "c").mkdir(mode=0o755)
    filled(tmp_path / "c")
    assert {stat.S_IMODE(it.stat().st_mode) for it in files(tmp_path / "c")} == {0o600}
    assert stat.S_IMODE((tmp_path / "c").stat().st_mode) == 0o700


def test_the_limit_of_size_holds_at_every_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unfinished files and whole blocks counted; the oldest go first; what is too large alone replaces nothing."""
    limit, most, replaced = 300_000, [0], os.replace

    def watched(*paths: Any) -> None:
        most.append(blocks(tmp_path / "c"))
        replaced(*paths)

    monkeypatch.setattr(Path, "replace", watched)
    folder = opened(tmp_path / "c", max_bytes=limit)
    random = np.random.default_rng(1)
    for number in range(40):
        assert folder.add(a_call(number, NOW_S + number, int(random.integers(100, 60_000))))
        assert folder.disk_bytes == blocks(tmp_path / "c") <= limit
    assert 200_000 < max(most) <= limit
    kept = [decode_call(it.read_bytes()).request_id for it in files(tmp_path / "c")]
    assert kept == [f"id-{number}" for number in range(40 - len(kept), 40)]
    before = files(tmp_path / "c")
    assert not folder.add(a_call(99, size=limit))
    assert files(tmp_path / "c") == before
    folder.close()
    opened(tmp_path / "c", max_bytes=100_000).close()
    assert files(tmp_path / "c") == before[-len(files(tmp_path / "c")) :]
    assert blocks(tmp_path / "c") <= 100_000


def test_calls_are_deleted_at_their_age_and_at_the_start(tmp_path: Path) -> None:
    """Whatever they contain, and however their files were copied."""
    clock = Clock()
    folder = opened(tmp_path / "c", 100.0, clock=clock)
    for number in range(3):
        folder.add(a_call(number, clock.now_s))
        clock.now_s += 40
    _, second, third = files(tmp_path / "c")
    assert folder.tidy() == pytest.approx(20)  # the first is 120 s old, the second 80
    assert files(tmp_path / "c") == [second, third]
    folder.close()
    second.write_bytes(b"junk")
    os.utime(second, (clock.now_s, clock.now_s))
    clock.now_s += 30
    opened(tmp_path / "c", 100.0, clock=clock).close()
    assert files(tmp_path / "c") == [third]


def test_a_call_ahead_of_the_clock_is_deleted(tmp_path: Path) -> None:
    """The clock was set back, so that its age is unknown; what a correction moves is not."""
    clock = Clock()
    folder = opened(tmp_path / "c", clock=clock)
    folder.add(a_call(0))
    clock.now_s -= 30
    folder.tidy()
    assert len(files(tmp_path / "c")) == 1
    clock.now_s -= 31
    folder.tidy()
    assert files(tmp_path / "c") == []
    assert not (tmp_path / "c" / "tenants" / "acme" / "calls" / "hall").exists()  # the name of the scene neither
    folder.close()


def test_calls_expire_although_the_clock_is_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Back: what has passed counts, also of calls found at the start. Ahead: the clock does."""
    clock, passed_s = Clock(), [0.0]
    monkeypatch.setattr(folder_module, "time", SimpleNamespace(monotonic=lambda: passed_s[0]))
    folder = opened(tmp_path / "c", 100.0, clock=clock)
    for ahead_s in (0, 5):
        folder.add(a_call(0, NOW_S + ahead_s))
    clock.now_s -= 50
    for passed_s[0] in (40.0, 80.0, 99.0):  # the folder is read anew meanwhile
        assert (folder.tidy(), len(files(tmp_path / "c"))) == (min(30.0, 100 - passed_s[0]), 2)
    passed_s[0] = 100.0
    assert (folder.tidy(), files(tmp_path / "c")) == (30.0, [])
    folder.add(a_call(1, clock.now_s))
    clock.now_s += 80
    assert (folder.tidy(), len(files(tmp_path / "c"))) == (20.0, 1)
    folder.close()
    folder = opened(tmp_path / "c", 100.0, clock=clock)
    clock.now_s -= 80
    passed_s[0] += 19.0
    assert (folder.tidy(), len(files(tmp_path / "c"))) == (1.0, 1)
    passed_s[0] += 1.0
    assert (folder.tidy(), files(tmp_path / "c")) == (30.0, [])
    folder.add(a_call(2, clock.now_s))
    clock.now_s += 100
    assert (folder.tidy(), files(tmp_path / "c")) == (30.0, [])
    folder.close()


def test_what_version_0_3_left_is_deleted_in_time(tmp_path: Path) -> None:
    """Copies of references beside its calls, and parts of them; a file of the operator is never touched."""
    clock = Clock()
    (call,) = filled(tmp_path / "c")
    copies = tmp_path / "c" / "tenants" / "acme" / "blobs"
    copies.mkdir()
    copy, half = copies / f"{7:064x}", copies / f"{8:064x}.tmp"
    theirs = [
        tmp_path / "c" / "notes.txt",
        call.with_name("notes.txt"),
        *(copies / it for it in ("notes.txt", "z" * 64, f"{7:064X}.txt", f"{7:064x}.jpg", f"{7:065x}")),
    ]
    for path in (copy, half, *theirs):
        path.write_bytes(b"x" * 5000)
        os.utime(path, (NOW_S - 50, NOW_S - 50))
    folder = opened(tmp_path / "c", 100.0, clock=clock)
    assert not half.exists()
    assert folder.disk_bytes == 4096 + 8192
    clock.now_s += 51
    folder.tidy()
    assert files(tmp_path / "c") == sorted([call, *theirs])
    folder.close()


@pytest.mark.parametrize(
    "left", ["by 0.3", "without a marker", "by a kill", "by a power failure", "nothing but a lock"]
)
def test_a_folder_that_servers_left_is_opened(tmp_path: Path, left: str) -> None:
    """And its limits hold again."""
    path = tmp_path / "c"
    filled(path)
    (path / "tenants" / "acme" / "blobs").mkdir()
    (path / "tenants" / "acme" / "blobs" / f"{7:064x}").write_bytes(b"")
    if left == "by 0.3":
        (path / "notes.txt").touch()
    else:
        (path / "mapless-capture.json").unlink()
    if left == "by a kill":
        (path / "mapless-capture.json.tmp").write_text('{"for')
    if left == "by a power failure":
        (path / "mapless-capture.json").touch()
    if left == "nothing but a lock":
        shutil.rmtree(path / "tenants")
    clock = Clock()
    clock.now_s += 1e9
    opened(path, clock=clock).close()
    assert [it.name for it in files(path)] == (["notes.txt"] if left == "by 0.3" else [])
    assert (path / "mapless-capture.json").read_text() == '{"format": 1}'


def test_what_a_killed_server_left_is_deleted_at_the_start(tmp_path: Path) -> None:
    (call,) = filled(tmp_path / "c")
    half = call.with_name("x.call.tmp")
    half.write_bytes(b"half")
    os.utime(half, (NOW_S, NOW_S))
    opened(tmp_path / "c").close()
    assert files(tmp_path / "c") == [call]


def test_files_deleted_by_hand_are_no_longer_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    filled(tmp_path / "c", 2)
    monkeypatch.setattr(folder_module, "SCAN_S", 0.0)
    folder = opened(tmp_path / "c")
    shutil.rmtree(tmp_path / "c" / "tenants" / "acme")
    folder.tidy()
    assert folder.disk_bytes == 0
    assert folder.add(a_call())
    folder.close()


def test_an_undeletable_file_keeps_no_other_and_stays_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    clock, limit = Clock(), 50_000
    folder = opened(tmp_path / "c", 100.0, limit, clock)
    for number in range(4):
        folder.add(a_call(number, NOW_S + number))
    stuck = files(tmp_path / "c")[0]
    refuse_to_delete({stuck}, monkeypatch)
    assert folder.add(a_call(4, NOW_S + 4, 40_000))  # others go in its place
    assert stuck in files(tmp_path / "c")
    with pytest.raises(OSError, match="leaves no room"):
        folder.add(a_call(5, NOW_S + 5, 47_000))
    clock.now_s += 200
    folder.tidy()
    assert (files(tmp_path / "c"), folder.disk_bytes) == ([stuck], 4096)
    assert f"{stuck} cannot be deleted: [Errno 1] Operation not permitted" in caplog.text
    monkeypatch.undo()
    folder.tidy()
    assert (files(tmp_path / "c"), folder.disk_bytes) == ([], 0)
    folder.close()


def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = opened(tmp_path / "c")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space"):
        folder.add(a_call())
    assert (files(tmp_path / "c"), folder.disk_bytes) == ([], 0)
    folder.close()


def test_a_folder_deleted_by_hand_is_made_by_its_server_alone(tmp_path: Path) -> None:
    path = tmp_path / "c"
    folder = opened(path)
    shutil.rmtree(path)
    assert folder.add(a_call())
    assert stat.S_IMODE(path.stat().st_mode) == 0o700
    with pytest.raises(CaptureError, match="in use by another server"):
        opened(path)
    shutil.rmtree(path)
    other = opened(path)
    with pytest.raises(CaptureError, match="in use by another server"):
        folder.add(a_call(2))
    other.close()
    folder.close()
    opened(path).close()


@pytest.mark.parametrize("place", ["tenants", "tenants/acme", "tenants/acme/calls/hall"])
def test_a_folder_that_cannot_be_read_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    """Its calls could not be deleted on time."""
    filled(tmp_path / "c")
    scandir = os.scandir

    def locked(at: Any) -> Any:
        if Path(at) == tmp_path / "c" / place:
            raise PermissionError(13, "Permission denied", str(at))
        return scandir(at)

    monkeypatch.setattr(os, "scandir", locked)
    with pytest.raises(CaptureError, match=rf"cannot be used: .*{place}: Permission denied"):
        opened(tmp_path / "c")
    with pytest.raises(CaptureError, match=rf"{place} cannot be read: Permission denied"):
        select(tmp_path / "c", Selection(), [])


@pytest.mark.parametrize("place", ["tenants", "tenants/acme", "tenants/acme/calls", "tenants/acme/calls/hall"])
@pytest.mark.parametrize("marked", [True, False])
def test_a_folder_with_a_link_is_rejected(tmp_path: Path, place: str, marked: bool) -> None:
    """Files behind the link are neither read nor deleted."""
    path = tmp_path / "c"
    filled(path)
    if not marked:
        (path / "mapless-capture.json").unlink()
    (path / place).rename(tmp_path / "elsewhere")
    (path / place).symlink_to(tmp_path / "elsewhere")
    clock = Clock()
    clock.now_s += 5000
    with pytest.raises(CaptureError, match=rf"cannot be used: .*{place}: a symbolic link"):
        opened(path, clock=clock)
    with pytest.raises(CaptureError, match=rf"{place} cannot be read: a symbolic link"):
        select(path, Selection(), [])
    assert len(files(tmp_path / "elsewhere")) == 1


@pytest.mark.parametrize("place", ["tenants", "tenants/acme", "tenants/acme/calls", "tenants/acme/calls/hall"])
def test_nothing_is_written_or_deleted_through_a_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, place: str
) -> None:
    """That is made while the server runs."""
    monkeypatch.setattr(folder_module, "SCAN_S", 0.0)
    path, clock = tmp_path / "c", Clock()
    folder = opened(path, clock=clock)
    folder.add(a_call())
    (path / place).rename(tmp_path / "elsewhere")
    (path / place).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="a symbolic link"):
        folder.add(a_call(1))
    clock.now_s += 5000
    folder.tidy()
    assert len(files(tmp_path / "elsewhere")) == 1
    assert f"{path / place} cannot be read: a symbolic link" in caplog.text
    (path / place).unlink()
    folder.tidy()
    assert folder.add(a_call(2, clock.now_s))
    folder.close()


def test_links_in_place_of_files_and_deeper_are_left_alone(tmp_path: Path) -> None:
    (call,) = filled(tmp_path / "c")
    (tmp_path / "c" / "tenants" / "acme" / "blobs").mkdir()
    theirs = tmp_path / "elsewhere"
    (theirs / "hall").mkdir(parents=True)
    (theirs / call.name).write_bytes(b"")
    (theirs / "hall" / call.name).write_bytes(b"")
    links = [
        call.with_name("1-1.call"),
        call.with_name("1-2.call.tmp"),
        tmp_path / "c" / "tenants" / "acme" / "blobs" / f"{7:064x}",
        tmp_path / "c" / "tenants" / "acme" / "notes",
    ]
    for link in links:
        link.symlink_to(theirs / call.name)
    call.with_name("deeper").symlink_to(theirs)
    (call.parent / "deep" / "hall").mkdir(parents=True)
    (call.parent / "deep" / "hall" / call.name).write_bytes(b"")
    clock = Clock()
    clock.now_s += 1e9
    opened(tmp_path / "c", clock=clock).close()
    assert (call.exists(), len(files(theirs)), [it.is_symlink() for it in links]) == (False, 2, [True] * 4)
    assert (call.parent / "deep" / "hall" / call.name).exists()


@pytest.mark.parametrize(
    "name",
    [
        "thesis.tex",
        "tenants/thesis.tex",
        "tenants/acme/config.yaml",
        "tenants/acme/calls/hall/notes.txt",
        "tenants/acme/blobs/notes.txt",
        "tenants/acme/calls/hall/deeper/1-1.call",
    ],
)
@pytest.mark.parametrize("beside", ["nothing", "lock", "a call"])
def test_a_folder_of_others_is_left_as_it_was(tmp_path: Path, name: str, beside: str) -> None:
    path = tmp_path / "c"
    (path / name).parent.mkdir(parents=True)
    (path / name).write_text("years of work")
    if beside == "lock":
        (path / "lock").touch()
    if beside == "a call":
        (path / "tenants" / "a" / "calls" / "b").mkdir(parents=True)
        (path / "tenants" / "a" / "calls" / "b" / "1-1.call").touch()
    path.chmod(0o755)
    before = sorted(path.rglob("*"))
    with pytest.raises(CaptureError, match="holds something else"):
        opened(path)
    assert sorted(path.rglob("*")) == before
    assert stat.S_IMODE(path.stat().st_mode) == 0o755


def test_folders_that_cannot_be_used_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CaptureError, match="cannot be used"):
        opened(tmp_path / "file")
    filled(tmp_path / "c")
    shutil.rmtree(tmp_path / "c" / "tenants")
    (tmp_path / "c" / "tenants").touch()
    with pytest.raises(CaptureError, match="tenants: Not a directory"):
        opened(tmp_path / "c")


@pytest.mark.parametrize(("capture", "data"), [("d/c", "d"), ("d", "d"), ("d", "d/c"), ("d/../d/c", "d")])
def test_store_and_capture_folder_are_apart(tmp_path: Path, capture: str, data: str) -> None:
    with pytest.raises(ConfigError, match="folders apart"):
        load_settings({"capture_dir": tmp_path / capture, "data_dir": tmp_path / data})


def test_an_invalid_tenant_is_rejected(tmp_path: Path) -> None:
    settings = load_settings({"capture_dir": tmp_path / "captured", "capture_tenants": "a,../b"}).settings
    with pytest.raises(CaptureError, match="capture_tenants"):
        open_recorder(settings, Metrics())
    assert not (tmp_path / "captured").exists()
