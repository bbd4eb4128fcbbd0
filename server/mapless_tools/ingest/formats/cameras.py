"""`cameras.json` and images: our own layout, described in `dataset`."""

from __future__ import annotations

from pathlib import Path

from mapless_tools.dataset import FILE_NAME, Dataset, read_folder

from .options import ReadOptions


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / FILE_NAME).is_file()


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the folder; see `read_dataset`."""
    return read_folder(path, skips_unusable=True)
