"""Sources to a folder of photographs with poses, as the commands do it."""

import errno
import fcntl
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from mapless_server.serve.signals import terminable
from mapless_tools.progress import progress_bars

from .output import REPORT, printed, write_folder
from .run import ReconstructOptions, prepare, reconstruct
from .sources import SourceOptions, read_sources
from .world.checking import check_files, check_names

LOCK = "lock"
_FULL_BYTES = 2**20


def reconstruct_into(sources: Sequence[Path], out: Path, wanted: SourceOptions, options: ReconstructOptions) -> None:
    """Writes the folder `out` and prints what is in it; ValueError says why there are no poses."""
    check_files(options.world)
    with terminable(), progress_bars() as progress:
        work = prepare(sources, out)
        with locked(work, out), full_disk_named(out):
            pictures = read_sources(sources, work / "pictures", wanted, progress)
            check_names(options.world, pictures)
            result = reconstruct(pictures, work, options, progress)
            write_folder(result, work, out, progress)
    print("\n".join([*printed(result), f"they are in {out}; look at {out / REPORT}"]))


@contextmanager
def locked(work: Path, out: Path) -> Iterator[None]:
    """Excludes other runs that write the same folder, until the block or the process ends; ValueError if there is one.

    The lock is flock's, on a file of the folder of the steps' results.
    """
    descriptor = os.open(work / LOCK, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            process = os.read(descriptor, 20).decode(errors="replace")
            raise ValueError(f"{out} is being written by another run (process {process}): wait for its end") from None
        os.truncate(descriptor, 0)
        os.write(descriptor, str(os.getpid()).encode())
        yield
    finally:
        os.close(descriptor)


@contextmanager
def full_disk_named(out: Path) -> Iterator[None]:
    """Raises OSError with a sentence where a disk is full; SQLite within pycolmap says it in other words."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        is_full = isinstance(error, OSError) and error.errno == errno.ENOSPC
        if is_full or shutil.disk_usage(out).free < _FULL_BYTES:
            raise OSError(f"the disk of {out} is full: free some of it, and run it again to go on") from error
        raise
