"""Layouts in which photographs with poses lie on disks, read into `dataset.Dataset`, and two that are written.

Each layout is a module with one public function `read(path, options) -> Dataset`; its docstring says what it looks for.
What is foreign about a layout ends there: cameras and poses that come out follow our conventions.
"""

from .options import FORMATS, Intrinsics, ReadOptions
from .reading import read_dataset, recognize

__all__ = ["FORMATS", "Intrinsics", "ReadOptions", "read_dataset", "recognize"]
