"""Folders that no store is opened in: used by another server, not closed in order, damaged."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.disks import mount, small_disk

from mapless_server.store import Store, StoreError
from mapless_server.store.folder_lock import LOCK_FILE
from mapless_server.store.sqlite import DATABASE_FILE


def opened_by_another(*folders: Path) -> list[str]:
    """The error of a process that opens the store in each folder."""
    code = """if True:
        import sys
        from pathlib import Path
        from mapless_server.store import Store, StoreError
        for folder in sys.argv[1:]:
            try:
                Store.open(Path(folder))
            except StoreError as error:
                print(error)
    """
    command = [sys.executable, "-c", code, *map(str, folders)]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout.splitlines()


def test_a_second_server_is_refused_until_the_first_has_gone(tmp_path: Path) -> None:
    """Whatever its file is called."""
    data = tmp_path / "data"
    link, soft, hard = (tmp_path / name for name in ("link", "soft", "hard"))
    link.symlink_to(data)
    with Store.open(data):
        for folder in (soft, hard):
            folder.mkdir()
        (soft / DATABASE_FILE).symlink_to(data / DATABASE_FILE)
        os.link(data / DATABASE_FILE, hard / DATABASE_FILE)
        *by_folder, by_soft, by_hard = opened_by_another(data, link, Path(os.path.relpath(data)), soft, hard)
        assert all(f"in use by another server (process {os.getpid()})" in error for error in by_folder)
        assert all("in use by another server, under another name" in error for error in (by_soft, by_hard))
        # The lock of the folder is deleted: that of the file is still there.
        (data / LOCK_FILE).unlink()
        (error,) = opened_by_another(data)
        assert "in use by another server" in error
    Store.open(data).close()


def test_a_read_only_store_not_closed_in_order_is_refused(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 16) as disk:
        Store.open(disk).close()
        (disk / f"{DATABASE_FILE}-wal").write_bytes(b"what was acknowledged last")
        assert mount("-o", "remount,ro", str(disk)) == 0
        with pytest.raises(StoreError, match="not closed in order"):
            Store.open(disk)


def test_bad_sectors_of_the_schema_stop_the_start_with_advice(tmp_path: Path) -> None:
    Store.open(tmp_path).close()
    with (tmp_path / DATABASE_FILE).open("r+b") as file:
        file.seek(100)
        file.write(bytes(range(256)) * 15)
    with pytest.raises(StoreError, match=r"malformed; restore a backup into a new folder$"):
        Store.open(tmp_path)
