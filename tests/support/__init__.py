"""Shared by the tests of several rooms: servers, stores, planted scenes, damaged files."""
