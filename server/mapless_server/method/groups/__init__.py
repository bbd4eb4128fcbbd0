"""Photographs posed together: a `rig` of cameras at one moment, or a `sequence` along a walk."""
