"""The mapless server."""

from importlib.metadata import version

__version__ = version("mapless")
