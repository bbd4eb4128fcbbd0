"""The files of a capture folder: where each lies, written whole or not at all, readable by their owner alone.

    mapless-capture.json            says that the folder is one of ours, and its format
    lock                            held by the server that writes
    tenants/{tenant}/calls/{scene}/{time}-{number}.call
    tenants/{tenant}/blobs/{sha256}

A tenant's calls are a folder of their own and share nothing with another's, so that they can be deleted by hand.
"""

from __future__ import annotations

import fcntl
import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from .errors import CaptureError

FOLDER_FORMAT = 1
MARKER_FILE = "mapless-capture.json"
LOCK_FILE = "lock"
TENANTS = "tenants"
CALLS, BLOBS = "calls", "blobs"
CALL_SUFFIX = ".call"
UNFINISHED_SUFFIX = ".tmp"

_BLOCK_BYTES = 4096
"""File systems give space in such pieces."""


def space_of(size_bytes: int) -> int:
    """What a file of so many bytes takes on the disk."""
    return -(-size_bytes // _BLOCK_BYTES) * _BLOCK_BYTES


def open_folder(folder: Path) -> int:
    """Makes the folder, or sees that it is one of ours, and locks it; the lock holds until the descriptor is closed.

    Raises:
        CaptureError: it cannot be written, holds something else, is in use, or is of a newer program.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not (folder / MARKER_FILE).exists() and any(folder.iterdir()):
            raise CaptureError(f"capture folder {folder} holds something else; name an empty or a new one")
        if stat.S_IMODE(folder.stat().st_mode) & 0o077:
            folder.chmod(0o700)
        lock = _lock(folder)
        if not (folder / MARKER_FILE).exists():
            write_whole(folder / MARKER_FILE, json.dumps({"format": FOLDER_FORMAT}).encode())
        check_format(folder)
        return lock
    except OSError as error:
        raise CaptureError(f"capture folder {folder} cannot be used: {error.strerror}") from error


def check_format(folder: Path) -> None:
    """Whether a folder is one that this program can read.

    Raises:
        CaptureError: it is not there, none of ours, or of a newer program.
    """
    try:
        found = json.loads((folder / MARKER_FILE).read_bytes())["format"]
    except FileNotFoundError:
        raise CaptureError(f"{folder} is no capture folder: it has no {MARKER_FILE}") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CaptureError(f"{folder / MARKER_FILE} cannot be read: {error}") from error
    if found != FOLDER_FORMAT:
        raise CaptureError(f"capture folder {folder} has format {found}, this program knows {FOLDER_FORMAT}")


def calls_of(folder: Path) -> Iterator[Path]:
    """Files of calls, whatever is in them."""
    yield from _files(folder.glob(f"{TENANTS}/*/{CALLS}/*/*{CALL_SUFFIX}"))


def blobs_of(folder: Path) -> Iterator[Path]:
    """Files of blobs."""
    yield from (it for it in _files(folder.glob(f"{TENANTS}/*/{BLOBS}/*")) if _is_digest(it.name))


def unfinished_in(folder: Path) -> Iterator[Path]:
    """What a server that was killed had begun to write."""
    yield from _files(folder.glob(f"{TENANTS}/*/*/**/*{UNFINISHED_SUFFIX}"))


def foreign_in(folder: Path) -> list[Path]:
    """Files that are none of ours; nobody but their owner deletes them."""
    ours = {*calls_of(folder), *blobs_of(folder), *unfinished_in(folder), folder / MARKER_FILE, folder / LOCK_FILE}
    return sorted(it for it in folder.rglob("*") if not it.is_dir() and it not in ours)


def call_path(folder: Path, tenant: str, scene_id: str, name: str) -> Path:
    """Where a call lies; the names must have been checked."""
    return folder / TENANTS / tenant / CALLS / scene_id / f"{name}{CALL_SUFFIX}"


def blob_path(folder: Path, tenant: str, sha256: str) -> Path:
    """Where a blob lies."""
    return folder / TENANTS / tenant / BLOBS / sha256


def write_whole(path: Path, data: bytes) -> None:
    """Writes a file so that nobody ever sees a part of it.

    Not forced to the disk: after a power failure a file may be empty or cut, which its reader finds out.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    unfinished = path.with_name(path.name + UNFINISHED_SUFFIX)
    try:
        descriptor = os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
        with open(descriptor, "wb") as file:
            file.write(data)
        unfinished.replace(path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise


def _files(paths: Iterator[Path]) -> Iterator[Path]:
    return (it for it in paths if it.is_file() and not it.is_symlink())


def _is_digest(name: str) -> bool:
    return len(name) == 64 and not set(name) - set("0123456789abcdef")


def _lock(folder: Path) -> int:
    lock = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        raise CaptureError(f"capture folder {folder} is in use by another server; each needs one of its own") from None
    except BaseException:
        os.close(lock)
        raise
    return lock
