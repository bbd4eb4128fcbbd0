"""Layouts of photographs with poses on disks, read into `dataset.Dataset`, and those that can be written.

Each layout is a module with `fits(path) -> bool` and `read(path, options) -> Dataset`; its docstring describes the
files. Conventions of a layout end there: the cameras and poses that it returns follow ours. A new one is a new module,
and its name in `ingest.FORMATS`.
"""

import importlib
from pathlib import Path
from types import ModuleType

from mapless_tools.bags import SUFFIXES, is_recording
from mapless_tools.dataset import Dataset, printable

from .. import FORMATS
from .collecting import Intrinsics, KeyframeOptions, ReadOptions
from .masks import with_masks

__all__ = ["Intrinsics", "KeyframeOptions", "ReadOptions", "fits", "read_dataset", "recognize"]


def recognize(path: Path) -> str:
    """Recognizes the layout of a folder; ValueError names the known or the found ones if it has none, or several."""
    _check_there(path)
    found = [name for name in FORMATS if fits(path, name)]
    if not found:
        raise ValueError(
            f"{path} has no layout that is known ({', '.join(FORMATS)}); name one with --format; the poses of "
            "photographs without any are computed by `mapless-server reconstruct`"
        )
    if len(found) > 1:
        raise ValueError(f"{path} has several layouts: {', '.join(found)}; name one with --format")
    return found[0]


def fits(path: Path, format: str) -> bool:
    """Whether a folder has a layout, one of FORMATS."""
    return bool(_module(format).fits(path))


def read_dataset(path: Path, format: str = "auto", options: ReadOptions | None = None) -> Dataset:
    """Reads the posed photographs of a folder; at least one frame, and those that cannot be used in `refused`.

    Args:
        path: the folder (`7scenes`: a scene; `12scenes`: a room; `colmap`: a model or a folder of one), or a file of
            `rosbag`.
        format: one of FORMATS, or "auto" to recognize it; `Dataset.format` is then its name.
        options: see ReadOptions.

    Raises:
        ValueError: the folder as a whole cannot be read; the message, which can be printed, names file and field.
    """
    if format != "auto" and format not in FORMATS:
        raise ValueError(f"format must be auto or one of {', '.join(FORMATS)}, not {format!r}")
    _check_there(path)
    name = recognize(path) if format == "auto" else format
    options = options or ReadOptions()
    if options.depths.depth_topic and name != "rosbag":
        raise ValueError(f"--depth-topic is of a recording, and {path} is a folder in the layout {name}")
    try:
        dataset: Dataset = _module(name).read(path, options)
    except ValueError as error:
        raise ValueError(printable(str(error))) from error
    return _with_masks(dataset, path, options)


def _with_masks(dataset: Dataset, path: Path, options: ReadOptions) -> Dataset:
    root = path if options.images is None else options.images
    return dataset if options.masks is None else with_masks(dataset, root, options.masks)


def _check_there(path: Path) -> None:
    if path.suffix == ".r3d":
        raise ValueError(f'{path}: files of Record3D are not read: export "EXR + RGB" from the app')
    if not (path.is_dir() or is_recording(path)):
        raise ValueError(f"{path} is not a folder, nor a recording ({', '.join(SUFFIXES)})")


def _module(name: str) -> ModuleType:
    return importlib.import_module(f".{FORMATS[name]}", __name__)
