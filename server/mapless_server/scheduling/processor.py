"""Processor time of a thread, with that of the threads that compute a part of its work; and its priority."""

import os
import sys
import threading
import time
from contextlib import suppress

NICENESS = 10
"""Niceness of threads of low priority, above the process's own. Evidence: lost-robots.

Linux gives such a thread a tenth of a core that another one of the process wants, and all of one that no other wants.
"""


class _Helped(threading.local):
    """Processor time that other threads have spent for this thread, and whether it is of low priority."""

    seconds = 0.0
    is_low = False


_helped = _Helped()


def processor_s() -> float:
    """Processor time of the calling thread since it began, and of its helpers (`count_helper`), seconds."""
    return time.thread_time() + _helped.seconds


def count_helper(seconds: float) -> None:
    """Counts processor time that another thread has spent for the calling one."""
    _helped.seconds += seconds


def may_have_helpers() -> bool:
    """Whether other threads may compute for the calling one; for one of low priority they would have a higher one."""
    return not _helped.is_low


def lower_priority() -> None:
    """Lets the calling thread, and those that it starts, compute only when others leave a core free, where possible.

    Only Linux has a niceness of threads; elsewhere, or where it is not permitted, they share the cores equally.
    """
    _helped.is_low = True
    if sys.platform == "linux":
        with suppress(OSError):
            own = threading.get_native_id()
            os.setpriority(os.PRIO_PROCESS, own, os.getpriority(os.PRIO_PROCESS, own) + NICENESS)
