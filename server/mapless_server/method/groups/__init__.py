"""Photographs posed together: a `rig` of cameras at one moment, a `sequence` along a walk."""
