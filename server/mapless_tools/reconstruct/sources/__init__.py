"""Reads the sources of a reconstruction: videos become frames, photographs are taken as they are.

Imports the images of the server; the decoders of videos and of HEIC only when such a file is read. Begin with `read`.
"""

from .options import SourceOptions
from .read import read_sources

__all__ = ["SourceOptions", "read_sources"]
