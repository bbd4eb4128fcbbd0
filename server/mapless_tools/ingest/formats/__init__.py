"""Layouts in which photographs with poses lie on disks, read into `dataset.Dataset`, and two that are written.

Each layout is a module with one public function `read(path, options) -> Dataset`; its docstring describes the files.
Conventions of a layout end there: the cameras and poses that it returns follow ours. Begin with `reading`.
"""

from .options import FORMATS, Intrinsics, ReadOptions
from .reading import read_dataset, recognize

__all__ = ["FORMATS", "Intrinsics", "ReadOptions", "read_dataset", "recognize"]
