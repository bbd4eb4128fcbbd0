"""A server shared by the tests of a module."""

from support.shared_server import server

__all__ = ["server"]
