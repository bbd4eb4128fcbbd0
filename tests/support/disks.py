"""Disks of a few megabytes for tests, which become full or read-only."""

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def small_disk(folder: Path, size_mib: int) -> Iterator[Path]:
    """A disk in memory until the block is left; skips the test where nothing may be mounted."""
    folder.mkdir()
    if shutil.which("mount") is None or mount("-t", "tmpfs", "-o", f"size={size_mib}m", "tmpfs", str(folder)):
        pytest.skip("nothing may be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@contextmanager
def failing_disk(folder: Path, size_mib: int) -> Iterator[Path]:
    """A file system that `fail` makes refuse every write; skips the test where there are no loop devices."""
    folder.mkdir()
    image = folder.with_suffix(".img")
    with image.open("wb") as file:
        file.truncate(size_mib * 2**20)
    made = shutil.which("mkfs.ext4") and subprocess.run(["mkfs.ext4", "-q", str(image)], check=False).returncode == 0
    if not made or mount("-o", "loop", str(image), str(folder)):
        pytest.skip("no file system in a file may be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fail(disk: Path) -> None:
    """From now on it is as after a fault that the kernel has met: what is there can be read, and no more."""
    assert mount("-o", "remount,abort", str(disk)) == 0


def mount(*arguments: str) -> int:
    """The exit code of the command."""
    return subprocess.run(["mount", *arguments], capture_output=True, check=False).returncode
