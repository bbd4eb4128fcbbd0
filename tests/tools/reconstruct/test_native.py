"""Ctrl-C ends native code, whenever it comes, and never before that code has ended."""

import threading
from collections.abc import Callable
from typing import Any

import pytest

from mapless_tools.reconstruct.native import interruptible


def test_results_and_failures_are_those_of_the_work() -> None:
    assert interruptible(lambda: 3) == 3
    with pytest.raises(ZeroDivisionError):
        interruptible(lambda: 1 // 0)


@pytest.mark.parametrize("moment", ["before the thread", "after its start", "while it runs"])
def test_interrupted_work_has_ended(moment: str, monkeypatch: pytest.MonkeyPatch) -> None:
    cancelled, done = threading.Event(), threading.Event()

    def work() -> None:
        cancelled.wait(10)
        done.set()

    start = threading.Thread.start

    def interrupted_start(self: threading.Thread) -> None:
        if moment == "after its start":
            start(self)
        raise KeyboardInterrupt

    def interrupted_wait(wait: Callable[..., bool]) -> Callable[..., bool]:
        def waited(self: threading.Event, timeout: float | None = None) -> bool:
            if timeout == 0.1:
                raise KeyboardInterrupt
            return wait(self, timeout)

        return waited

    patched: tuple[Any, str, Any] = (threading.Thread, "start", interrupted_start)
    if moment == "while it runs":
        patched = (threading.Event, "wait", interrupted_wait(threading.Event.wait))
    monkeypatch.setattr(*patched)
    with pytest.raises(KeyboardInterrupt):
        interruptible(work, cancelled.set)
    assert done.is_set() == cancelled.is_set()
    assert cancelled.is_set() or moment != "while it runs"
