"""Capture: keeps answered calls on disk for a limited time, if the operator wants it, so that they can be replayed.

May import what `services` may. Begin with `recorder`, which takes answered calls from the services and writes them in
its own thread. `calls` is the file of one call, `folder` the folder with its limits of time and size.
"""
