"""Processor time of a thread, with that of the threads that compute a part of its work; and threads that give way."""

import threading
import time
from collections.abc import Callable

SHARE_BESIDE_OTHERS = 0.1
"""Share of a core that a thread that gives way takes while others compute. Evidence: lost-robots."""
LONGEST_PAUSE_S = 0.5
"""A pause in the middle of a step ends after this time: the thread may hold what others wait for. The rest is left for
the next one."""
_LOOK_S = 0.01


class _Thread(threading.local):
    """The calling thread: processor time that others have spent for it; if it gives way, the pause that it owes."""

    helped_s = 0.0
    others_compute: Callable[[], bool] | None = None
    computed_s = 0.0
    owed_s = 0.0


_thread = _Thread()


def processor_s() -> float:
    """Processor time of the calling thread since it began, and of its helpers (`count_helper`), seconds."""
    return time.thread_time() + _thread.helped_s


def count_helper(seconds: float) -> None:
    """Counts processor time that another thread has spent for the calling one."""
    _thread.helped_s += seconds


def may_have_helpers() -> bool:
    """Whether other threads may compute for the calling one; for one that gives way they would not do so."""
    return _thread.others_compute is None


def lower_priority(others_compute: Callable[[], bool]) -> None:
    """Lets the calling thread give way at each `give_way` while others compute, see there.

    It is no niceness of the system's: a thread that the system does not run, because other programs want the cores,
    may hold the interpreter's lock, and then every thread of the process waits for it.
    """
    _thread.others_compute = others_compute
    _thread.computed_s = time.thread_time()


def give_way(longest_s: float = LONGEST_PAUSE_S) -> None:
    """Pauses a thread of low priority while others compute, as long as its share demands; returns at once in others.

    What it owes is forgotten when no others compute.
    """
    others_compute = _thread.others_compute
    if others_compute is None:
        return
    spent_s = time.thread_time() - _thread.computed_s
    _thread.owed_s += spent_s * (1 / SHARE_BESIDE_OTHERS - 1)
    begin_s = now_s = time.monotonic()
    until_s = begin_s + min(_thread.owed_s, longest_s)
    while now_s < until_s and others_compute():
        time.sleep(_LOOK_S)
        now_s = time.monotonic()
    _thread.owed_s = max(0.0, _thread.owed_s - (now_s - begin_s)) if now_s >= until_s else 0.0
    _thread.computed_s = time.thread_time()
