"""Keeping calls for a time, where the operator asks for it, so that they can be replayed.

`calls` is the record of one, `folder` where they lie, under a limit of time and one of size; `recorder` takes calls
from the services and writes them in a thread of its own, and `deletion` deletes them in time.
"""
