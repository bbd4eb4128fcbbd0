"""Asks whether the store answers, such that a store that hangs holds up nobody and gets no second question."""

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as StillWaiting

from mapless_server.errors import RequestError

log = logging.getLogger(__name__)

ANSWER_LIMIT_S = 3.0
"""A store that takes longer is away: load balancers wait for five seconds or so."""
ANSWER_KEPT_S = 1.0
"""However many ask, the store is asked once a second."""


class StoreProbe:
    """Answers whether the store is there; thread-safe.

    Args:
        check: asks the store, and raises if it is away; called in threads of this class, one at a time.
        limit_s, kept_s: time that an answer may take, and for which it is used again, seconds.
    """

    def __init__(
        self, check: Callable[[], None], limit_s: float = ANSWER_LIMIT_S, kept_s: float = ANSWER_KEPT_S
    ) -> None:
        self._check = check
        self._limit_s = limit_s
        self._kept_s = kept_s
        self._lock = threading.Lock()
        self._asked: Future[str] | None = None
        self._asked_s = 0.0
        self._logged = ""

    def fault(self) -> str:
        """Why the store is away, in words that strangers may read; empty if it is there. Takes `limit_s` at most."""
        with self._lock:
            now_s = time.monotonic()
            if self._asked is None or (self._asked.done() and now_s - self._asked_s >= self._kept_s):
                self._asked, self._asked_s = Future(), now_s
                threading.Thread(target=self._ask, args=(self._asked,), name="store-probe", daemon=True).start()
            asked, left_s = self._asked, self._asked_s + self._limit_s - now_s
        try:
            return asked.result(max(0.0, left_s))
        except StillWaiting:
            return "the store does not answer"

    def _ask(self, asked: Future[str]) -> None:
        try:
            self._check()
        except Exception as error:
            # The database's own text names hosts, users and files; that of a RequestError is written for callers.
            fault = str(error) if isinstance(error, RequestError) else "the store is away"
            if fault != self._logged:
                log.warning("the store is away: %s", error, exc_info=error)
            asked.set_result(fault)
        else:
            fault = ""
            asked.set_result(fault)
        self._logged = fault
