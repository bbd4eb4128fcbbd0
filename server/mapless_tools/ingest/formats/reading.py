"""The front door of the readers: a folder and the name of its layout in, a dataset out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType

from mapless_tools.dataset import Dataset, printable

from . import arkit, cambridge, cameras, colmap, nerf, seven_scenes, tum, twelve_scenes
from .options import FORMATS, ReadOptions

_MODULES: Mapping[str, ModuleType] = dict(
    zip(FORMATS, (cameras, colmap, seven_scenes, twelve_scenes, cambridge, nerf, tum, arkit), strict=True)
)


def recognize(path: Path) -> str:
    """Name of the layout that a folder has.

    Raises:
        ValueError: it has none that is known, or several; the message names them.
    """
    if not path.is_dir():
        raise ValueError(f"{path} is not a folder")
    found = [name for name, module in _MODULES.items() if module.fits(path)]
    if not found:
        raise ValueError(f"{path} has no layout that is known ({', '.join(FORMATS)}); say which with --format")
    if len(found) > 1:
        raise ValueError(f"{path} has several layouts: {', '.join(found)}; say which with --format")
    return found[0]


def read_dataset(path: Path, format: str = "auto", options: ReadOptions | None = None) -> Dataset:
    """Read the posed photographs of a folder.

    Args:
        path: the folder (`7scenes`: a scene; `12scenes`: a room; `colmap`: a model, or what holds one).
        format: one of FORMATS, or "auto" to recognize it; `Dataset.format` is then its name.
        options: see ReadOptions.

    Returns:
        The dataset. Frames that cannot be used are in `refused`, with the reason; at least one can be.

    Raises:
        ValueError: the folder as a whole cannot be read; the message, which can be printed, names file and field.
    """
    if format != "auto" and format not in FORMATS:
        raise ValueError(f"format must be auto or one of {', '.join(FORMATS)}, not {format!r}")
    if not path.is_dir():
        raise ValueError(f"{path} is not a folder")
    read: Callable[[Path, ReadOptions], Dataset] = _MODULES[recognize(path) if format == "auto" else format].read
    try:
        return read(path, options or ReadOptions())
    except ValueError as error:
        raise ValueError(printable(str(error))) from error
