"""Locks by which one server at a time uses a data folder."""

from __future__ import annotations

import fcntl
import os
from contextlib import ExitStack
from pathlib import Path

from .database import StoreError

LOCK_FILE = "mapless.lock"


class FolderLock:
    """Locks of one server on a data folder and its database file, until released or the process ends.

    The folder's lock file names the process that holds it. The lock on the database file also excludes a server that
    uses the same file by another name (a hard or symbolic link in another folder): SQLite keeps its journal beside the
    name that it is given, so two servers on two names of one file would destroy it. Both locks are flock's; SQLite's
    own are fcntl's, and independent of them. They are taken before the database is opened and released after it is
    closed, because closing a file drops all of the process's fcntl locks on it, including SQLite's.
    """

    def __init__(self, locks: ExitStack) -> None:
        self._locks = locks

    @staticmethod
    def take(folder: Path, database_file: str) -> FolderLock:
        """Locks for the one server that reads and writes; creates the database file if missing.

        StoreError if another server has them; OSError if the folder or the file cannot be used.
        """
        with ExitStack() as stack:
            holder = _open(stack, folder / LOCK_FILE, os.O_RDWR | os.O_CREAT)
            if not _is_locked(holder, fcntl.LOCK_EX):
                process = os.read(holder, 20).decode(errors="replace")
                raise StoreError(f"data folder {folder} is in use by another server (process {process})")
            os.truncate(holder, 0)
            os.write(holder, str(os.getpid()).encode())
            file = _open(stack, folder / database_file, os.O_RDWR | os.O_CREAT)
            if not _is_locked(file, fcntl.LOCK_EX):
                raise StoreError(f"database {folder / database_file} is in use by another server, under another name")
            return FolderLock(stack.pop_all())

    @staticmethod
    def share(path: Path) -> FolderLock:
        """Takes the lock for one of several servers that only read a database file.

        StoreError if a server that may write has it; OSError if there is no such file, or it cannot be read.
        """
        with ExitStack() as stack:
            if not _is_locked(_open(stack, path, os.O_RDONLY), fcntl.LOCK_SH):
                raise StoreError(f"database {path} is in use by a server that may write to it")
            return FolderLock(stack.pop_all())

    def release(self) -> None:
        """Releases the locks."""
        self._locks.close()


def _open(stack: ExitStack, path: Path, flags: int) -> int:
    descriptor = os.open(path, flags, 0o600)
    stack.callback(os.close, descriptor)
    return descriptor


def _is_locked(descriptor: int, kind: int) -> bool:
    """Tries to take a lock; returns whether it was taken."""
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
