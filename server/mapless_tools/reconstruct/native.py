"""Native code that Ctrl-C is to end."""

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

Result = TypeVar("Result")


def interruptible(work: Callable[[], Result], cancel: Callable[[], None] = lambda: None) -> Result:
    """The result of native code, which would not be interrupted by Ctrl-C.

    Interrupted, it is cancelled, and awaited: Python must not end while native code is running, which may call back.
    """
    results: list[Result] = []
    failures: list[BaseException] = []
    lock = threading.Lock()
    begun, abandoned = threading.Event(), threading.Event()
    ended = threading.Event()  # Thread.join says that a thread has ended when Ctrl-C interrupts it

    def run() -> None:
        with lock:
            if abandoned.is_set():
                return
            begun.set()
        try:
            results.append(work())
        except BaseException as failure:
            failures.append(failure)
        ended.set()

    try:
        threading.Thread(target=run, daemon=True).start()
        while not ended.wait(0.1):
            pass
    except BaseException:
        with lock:
            abandoned.set()
        if begun.is_set():
            cancel()
            while not ended.is_set():
                with suppress(KeyboardInterrupt, SystemExit):  # the first one counts
                    ended.wait()
        raise
    if failures:
        raise failures[0]
    return results[0]
