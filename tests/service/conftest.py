"""A server shared by the tests of a module."""

from support.shared_server import client, scene, server, stubs

__all__ = ["client", "scene", "server", "stubs"]
