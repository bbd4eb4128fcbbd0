"""The files of a capture folder, readable by their owner alone: paths, the folder's lock, writing and deleting.

    mapless-capture.json            marks the folder as a capture folder, with its format
    lock                            held by the server that writes
    tenants/{tenant}/calls/{scene}/{time}-{number}.call
    tenants/{tenant}/blobs/{sha256}

A tenant's files share nothing with another's, so that an operator can delete its folder.
"""

import errno
import fcntl
import hashlib
import json
import os
import stat
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

from .calls import CaptureError

FOLDER_FORMAT = 1
MARKER_FILE = "mapless-capture.json"
LOCK_FILE = "lock"
TENANTS = "tenants"
CALLS, BLOBS = "calls", "blobs"
CALL_SUFFIX = ".call"
UNFINISHED_SUFFIX = ".tmp"

_BLOCK_BYTES = 4096
"""File systems allocate in blocks of this size."""


def disk_bytes(size_bytes: int) -> int:
    """The size of a file on the disk, in whole blocks."""
    return -(-size_bytes // _BLOCK_BYTES) * _BLOCK_BYTES


def open_folder(folder: Path) -> int:
    """Creates the folder, or checks that it is a capture folder, and locks it until the descriptor is closed.

    CaptureError if the folder cannot be written, has other files, is in use, or has the format of another version.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Our own files without the marker were left by a server that was killed, or whose folder was deleted by hand.
        if not _is_marked(folder) and any(foreign_in(folder)):
            raise CaptureError(f"capture folder {folder} holds something else; name an empty or a new one")
        if stat.S_IMODE(folder.stat().st_mode) & 0o077:
            folder.chmod(0o700)
        return _lock(folder)
    except OSError as error:
        what = f"{error.filename or folder}: {error.strerror or error}"
        raise CaptureError(f"capture folder {folder} cannot be used: {what}") from error


def is_locked_by(folder: Path, lock: int) -> bool:
    """Whether a descriptor is that of the folder's lock, not of a lock that was deleted with the folder."""
    try:
        return os.path.samestat(os.fstat(lock), os.lstat(folder / LOCK_FILE))
    except FileNotFoundError:
        return False


def check_format(folder: Path) -> None:
    """Checks that a folder is a capture folder that this version can read.

    CaptureError if the folder does not exist, is no capture folder, or has the format of another version.
    """
    try:
        found = json.loads((folder / MARKER_FILE).read_bytes())["format"]
    except FileNotFoundError:
        raise CaptureError(f"{folder} is no capture folder: it has no {MARKER_FILE}") from None
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise CaptureError(f"{folder / MARKER_FILE} cannot be read: {error}") from error
    if found != FOLDER_FORMAT:
        raise CaptureError(f"capture folder {folder} has format {found}, this program knows {FOLDER_FORMAT}")


def calls_of(folder: Path) -> Iterator[Path]:
    """Yields the files of calls, which are not checked."""
    return (it for it in _files(folder) if _is_call(*_parts(folder, it)))


def blobs_of(folder: Path) -> Iterator[Path]:
    """Yields the files of blobs."""
    return (it for it in _files(folder) if _is_blob(*_parts(folder, it)))


def unfinished_in(folder: Path) -> Iterator[Path]:
    """Yields unfinished files, which a killed server has left."""
    return (it for it in _files(folder) if _is_unfinished(*_parts(folder, it)))


def foreign_in(folder: Path) -> Iterator[Path]:
    """Yields files that are not part of a capture folder; the server never deletes them."""
    own = {(LOCK_FILE,), (MARKER_FILE,), (MARKER_FILE + UNFINISHED_SUFFIX,)}
    for path in _all(folder):
        parts = _parts(folder, path)
        is_ours = parts in own or any(kind(*parts) for kind in (_is_call, _is_blob, _is_unfinished))
        if not (is_ours and _is_regular(path)):
            yield path


def call_path(folder: Path, tenant: str, scene_id: str, name: str) -> Path:
    """Path of a call's file; the names must be valid."""
    return folder / TENANTS / tenant / CALLS / scene_id / f"{name}{CALL_SUFFIX}"


def blob_path(folder: Path, tenant: str, sha256: str) -> Path:
    """Path of a blob's file."""
    return folder / TENANTS / tenant / BLOBS / sha256


def write_whole(path: Path, data: bytes) -> None:
    """Writes a file so that no reader ever sees a part of it.

    The file is not synchronized to the disk: after a power failure it may be empty or cut, which its checksum reveals.
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


def do_each(actions: Iterable[Callable[[], object]]) -> None:
    """Executes all of the actions, then raises the first OSError, if any failed."""

    def fault_of(action: Callable[[], object]) -> OSError | None:
        try:
            action()
        except OSError as error:
            return error
        return None

    if faults := [fault for it in actions if (fault := fault_of(it)) is not None]:
        raise faults[0]


def _files(folder: Path) -> Iterator[Path]:
    return filter(_is_regular, _all(folder))


def _is_regular(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()


def _all(folder: Path) -> Iterator[Path]:
    """Yields all files in the folder, in order; OSError if a folder in it cannot be read, or is a link to elsewhere."""
    for place, folders, files in os.walk(folder, onerror=_raise_unless_missing):
        folders.sort()
        for name in folders:
            path = Path(place, name)
            if path.is_symlink() and _parts(folder, path)[0] == TENANTS:
                raise OSError(errno.ELOOP, "a symbolic link stands in place of a folder", str(path))
        yield from (Path(place, name) for name in sorted(files))


def _raise_unless_missing(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError):
        raise error


def _parts(folder: Path, path: Path) -> tuple[str, ...]:
    return path.relative_to(folder).parts


def _is_call(*parts: str) -> bool:
    return len(parts) == 5 and (parts[0], parts[2]) == (TENANTS, CALLS) and parts[4].endswith(CALL_SUFFIX)


def _is_blob(*parts: str) -> bool:
    is_digest = len(parts[-1]) == 64 and not set(parts[-1]) - set("0123456789abcdef")
    return len(parts) == 4 and (parts[0], parts[2]) == (TENANTS, BLOBS) and is_digest


def _is_unfinished(*parts: str) -> bool:
    whole = (*parts[:-1], parts[-1].removesuffix(UNFINISHED_SUFFIX))
    return whole != parts and (_is_call(*whole) or _is_blob(*whole))


def _is_marked(folder: Path) -> bool:
    """Whether the folder has the marker of a capture folder, which may be empty after a power failure."""
    marker = folder / MARKER_FILE
    return marker.exists() and marker.stat().st_size > 0


def _lock(folder: Path) -> int:
    """Locks the folder and then marks it, so that two servers cannot do so at the same time."""
    lock = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not _is_marked(folder):
            write_whole(folder / MARKER_FILE, json.dumps({"format": FOLDER_FORMAT}).encode())
        check_format(folder)
    except BlockingIOError:
        os.close(lock)
        raise CaptureError(f"capture folder {folder} is in use by another server; each needs one of its own") from None
    except BaseException:
        os.close(lock)
        raise
    return lock


class BlobLedger:
    """The blobs of a folder by path, their size on the disk and the number of calls that need each; for one thread."""

    def __init__(self) -> None:
        self.disk_bytes = 0
        self._sizes: dict[Path, int] = {}
        self._uses: Counter[Path] = Counter()
        self._unused: set[Path] = set()  # to be deleted
        self._unverified: set[Path] = set()  # found at the start: a power failure may have cut them

    def __contains__(self, path: Path) -> bool:
        return path in self._sizes

    def load(self, folder: Path) -> None:
        """Enters all existing blobs; the first `sweep` deletes those that no call needs by then."""
        for path in blobs_of(folder):
            self._enter(path, path.stat().st_size)
        self._unverified.update(self._sizes)
        self._unused.update(self._sizes)

    def disk_bytes_of(self, path: Path) -> int:
        """Size of a blob on the disk; 0 if it is missing."""
        return self._sizes.get(path, 0)

    def write(self, path: Path, data: bytes) -> None:
        """Writes a blob; OSError as in `write_whole`."""
        write_whole(path, data)
        self._enter(path, len(data))

    def is_intact(self, path: Path) -> bool:
        """Whether the file has the content of its name; a file of an earlier server is read once to check it."""
        if path in self._unverified:
            with suppress(OSError):
                if hashlib.sha256(path.read_bytes()).hexdigest() == path.name:
                    self._unverified.discard(path)
        return path not in self._unverified

    def missing(self) -> set[Path]:
        """Returns the blobs whose files were deleted by hand."""
        return {path for path in self._sizes if not os.path.lexists(path)}

    def use(self, paths: Collection[Path]) -> None:
        """Counts one more call for each of these blobs."""
        self._uses.update(list(paths))
        self._unused.difference_update(paths)

    def release(self, paths: Collection[Path]) -> None:
        """Counts one call less for each of these blobs."""
        for path in paths:
            self._uses[path] -= 1
            if self._uses[path] <= 0:
                del self._uses[path]
                if path in self._sizes:
                    self._unused.add(path)

    def sweep(self) -> None:
        """Deletes blobs that no call needs; finally raises OSError if one could not be deleted."""
        do_each([partial(self._delete, it) for it in self._unused])

    def _enter(self, path: Path, size_bytes: int) -> None:
        self._sizes[path] = disk_bytes(size_bytes)
        self.disk_bytes += self._sizes[path]

    def _delete(self, path: Path) -> None:
        path.unlink(missing_ok=True)
        self._unused.discard(path)
        self._unverified.discard(path)
        self.disk_bytes -= self._sizes.pop(path)
