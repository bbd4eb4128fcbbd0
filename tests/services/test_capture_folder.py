"""The limits of a capture folder hold at every moment, whatever is in it; with planted files."""

import os
import shutil
import stat
from pathlib import Path
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


def test_what_version_0_3_left_is_deleted_in_time(tmp_path: Path) -> None:
    """Copies of references beside its calls, and its mark; a file of the operator is never touched."""
    clock = Clock()
    (call,) = filled(tmp_path / "c")
    copy = tmp_path / "c" / "tenants" / "acme" / "blobs" / f"{7:064x}"
    copy.parent.mkdir()
    for path in (copy, tmp_path / "c" / "notes.txt", copy.with_name("notes.txt"), call.with_name("notes.txt")):
        path.write_bytes(b"x" * 5000)
    (tmp_path / "c" / "mapless-capture.json").write_text('{"format": 1}')
    os.utime(copy, (NOW_S - 50, NOW_S - 50))
    folder = opened(tmp_path / "c", 100.0, clock=clock)
    assert folder.disk_bytes == 4096 + 8192
    clock.now_s += 51
    folder.tidy()
    assert (call.exists(), copy.exists(), len(files(tmp_path / "c"))) == (True, False, 1 + 3 + 1)
    folder.close()


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


def test_what_is_behind_a_link_is_deleted_in_time(tmp_path: Path) -> None:
    """As on another disk: what is written there is found again."""
    filled(tmp_path / "c")
    tenant = tmp_path / "c" / "tenants" / "acme"
    tenant.rename(tmp_path / "elsewhere")
    tenant.symlink_to(tmp_path / "elsewhere")
    clock = Clock()
    clock.now_s += 5000
    opened(tmp_path / "c", clock=clock).close()
    assert files(tmp_path / "elsewhere") == []


def test_folders_that_cannot_be_used_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("years of work")
    with pytest.raises(CaptureError, match="holds something else"):
        opened(tmp_path / "full")
    (tmp_path / "file").write_text("")
    with pytest.raises(CaptureError, match="cannot be used"):
        opened(tmp_path / "file")


@pytest.mark.parametrize(("capture", "data"), [("d/c", "d"), ("d", "d"), ("d", "d/c"), ("d/../d/c", "d")])
def test_store_and_capture_folder_are_apart(tmp_path: Path, capture: str, data: str) -> None:
    with pytest.raises(ConfigError, match="folders apart"):
        load_settings({"capture_dir": tmp_path / capture, "data_dir": tmp_path / data})


def test_an_invalid_tenant_is_rejected(tmp_path: Path) -> None:
    settings = load_settings({"capture_dir": tmp_path / "captured", "capture_tenants": "a,../b"}).settings
    with pytest.raises(CaptureError, match="capture_tenants"):
        open_recorder(settings, Metrics())
    assert not (tmp_path / "captured").exists()
