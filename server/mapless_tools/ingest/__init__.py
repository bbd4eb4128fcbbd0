"""Filling a scene from a folder of posed photographs, and writing a scene to one: clients of a server."""
