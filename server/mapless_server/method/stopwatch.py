"""The time of steps, by name."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def timed(stage_seconds: dict[str, float], name: str) -> Iterator[None]:
    """Adds the time of a block, however it ends; a step that is done twice counts twice."""
    start_s = time.perf_counter()
    try:
        yield
    finally:
        stage_seconds[name] = stage_seconds.get(name, 0.0) + time.perf_counter() - start_s
