"""Native code that Ctrl-C is to end."""

import threading
from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")


def interruptible(work: Callable[[], Result], cancel: Callable[[], None] = lambda: None) -> Result:
    """The result of native code, which would not be interrupted by Ctrl-C."""
    results: list[Result] = []
    failures: list[BaseException] = []
    ended = threading.Event()  # Thread.join says that a thread has ended when Ctrl-C interrupts it

    def run() -> None:
        try:
            results.append(work())
        except BaseException as failure:
            failures.append(failure)
        ended.set()

    threading.Thread(target=run, daemon=True).start()
    try:
        while not ended.wait(0.1):
            pass
    except BaseException:
        cancel()
        ended.wait()  # Python must not end while native code is running
        raise
    if failures:
        raise failures[0]
    return results[0]
