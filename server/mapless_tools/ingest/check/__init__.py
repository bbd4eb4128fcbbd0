"""Checks whether photographs fit their poses: matched points of neighbours must satisfy the epipolar constraint.

Imports the method of `mapless_server`, and nothing of the import itself. Begin with `comparing`.
"""

from .comparing import check_frames
from .verdict import Verdict, implausible_depth

__all__ = ["Verdict", "check_frames", "implausible_depth"]
