"""Processor time of a thread, with that of the threads that compute a part of its work."""

import threading
import time


class _Helped(threading.local):
    """Processor time that other threads have spent for this thread."""

    seconds = 0.0


_helped = _Helped()


def processor_s() -> float:
    """Processor time of the calling thread since it began, and of its helpers (`count_helper`), seconds."""
    return time.thread_time() + _helped.seconds


def count_helper(seconds: float) -> None:
    """Counts processor time that another thread has spent for the calling one."""
    _helped.seconds += seconds
