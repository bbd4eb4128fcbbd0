"""`mapless-server bench`: accuracy on the real scenes against targets and against a map, and what a call costs."""

from .command import bench

__all__ = ["bench"]
