"""One server at a time: locks on a data folder and on the database file in it, held until we let go or die.

The folder's lock file says who holds it. The file's own lock is what a second name of the same file, a hard link or a
symbolic link in another folder, does not get around: SQLite keeps its journal beside the name that it is given, so two
servers on two names of one file would destroy it. Both are flock's; SQLite's own are fcntl's, and do not see them.
"""

from __future__ import annotations

import fcntl
import os
from contextlib import ExitStack
from pathlib import Path

from .database import StoreError

LOCK_FILE = "mapless.lock"


class FolderLock:
    """What is held; a process must hold it before it opens the database, and release it after it has closed it.

    Closing a file drops all of the process's fcntl locks on it, SQLite's too.
    """

    def __init__(self, held: ExitStack) -> None:
        self._held = held

    @staticmethod
    def take(folder: Path, database_file: str) -> FolderLock:
        """Everything for one server that reads and writes; the database's file is made if missing.

        Raises:
            StoreError: another server has it.
            OSError: the folder or the file cannot be used.
        """
        with ExitStack() as stack:
            holder = _open(stack, folder / LOCK_FILE, os.O_RDWR | os.O_CREAT)
            if not _locked(holder, fcntl.LOCK_EX):
                process = os.read(holder, 20).decode(errors="replace")
                raise StoreError(f"data folder {folder} is in use by another server (process {process})")
            os.truncate(holder, 0)
            os.write(holder, str(os.getpid()).encode())
            file = _open(stack, folder / database_file, os.O_RDWR | os.O_CREAT)
            if not _locked(file, fcntl.LOCK_EX):
                raise StoreError(f"database {folder / database_file} is in use by another server, under another name")
            return FolderLock(stack.pop_all())

    @staticmethod
    def share(path: Path) -> FolderLock:
        """For one of several servers that only read a database file.

        Raises:
            StoreError: a server that may write has it.
            OSError: there is no such file, or it cannot be read.
        """
        with ExitStack() as stack:
            if not _locked(_open(stack, path, os.O_RDONLY), fcntl.LOCK_SH):
                raise StoreError(f"database {path} is in use by a server that may write to it")
            return FolderLock(stack.pop_all())

    def release(self) -> None:
        """Lets others in."""
        self._held.close()


def _open(stack: ExitStack, path: Path, how: int) -> int:
    descriptor = os.open(path, how, 0o600)
    stack.callback(os.close, descriptor)
    return descriptor


def _locked(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
