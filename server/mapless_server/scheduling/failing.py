"""Callers whose photographs fail: they queue as one more caller, wait for the others, and get what is cheap."""

from collections import OrderedDict
from itertools import takewhile
from typing import NamedTuple

from .costs import MAX_OF_CALLERS
from .expected import LATELY_S
from .jobs import Flow

MEMORY = 4
"""So many of a caller's last photographs count. Evidence: queue-failing."""
FAILURES = 2
"""The ladder of a caller is cut if so many of its last photographs failed, one after the other."""
FORGOTTEN_S = 60.0
"""A caller that has asked nothing for so long is one like any other again."""
FAILING = "callers that fail\n"
"""The caller that all failing callers of a tenant are; no caller can send a name with a line break."""


class _Answered(NamedTuple):
    """Whether the last photographs were localized, the newest last, and when it was answered."""

    localized: tuple[bool, ...]
    last_s: float


class Failing:
    """Keeps which photographs of callers were localized: of a token's, whatever its clients call themselves.

    A caller that is lost asks again and again, and each photograph takes many times what one takes that belongs. Equal
    shares would let a few of them take most of the server. So a caller fails, and waits for the others, if its last
    photograph was not localized, nor most of those before it; from the first one on, so that many that are lost at once
    do so before they have delayed the others. A token of many robots, some of which are lost, does not fail.
    """

    def __init__(self) -> None:
        self._of_callers: OrderedDict[tuple[str, str], _Answered] = OrderedDict()
        # When the others asked last, in this order.
        self._asked_s: OrderedDict[tuple[str, str], float] = OrderedDict()

    def answered(self, flow: Flow, is_localized: bool, now_s: float) -> None:
        """Counts a photograph, or photographs that were localized together."""
        localized = (*self._last(flow, now_s), is_localized)[-MEMORY:]
        self._of_callers[flow.group] = _Answered(localized, now_s)
        self._of_callers.move_to_end(flow.group)
        if len(self._of_callers) > MAX_OF_CALLERS:
            self._of_callers.popitem(last=False)

    def asked(self, flow: Flow, now_s: float) -> None:
        """Notes that a client asks, as whom it is queued."""
        if flow.caller != FAILING:
            self._asked_s[flow.group] = now_s
            self._asked_s.move_to_end(flow.group)
            if len(self._asked_s) > MAX_OF_CALLERS:
                self._asked_s.popitem(last=False)

    def others_ask(self, flow: Flow, now_s: float) -> bool:
        """Whether another caller, which did not fail, has asked lately."""
        lately = takewhile(lambda it: now_s - it[1] <= LATELY_S, reversed(self._asked_s.items()))
        return any(group != flow.group for group, _ in lately)

    def is_failing(self, flow: Flow, now_s: float) -> bool:
        """Whether a caller's last photograph was not localized, nor most of its last ones."""
        localized = self._last(flow, now_s)
        return bool(localized) and not localized[-1] and 2 * sum(localized) < len(localized)

    def is_to_be_cut(self, flow: Flow, now_s: float) -> bool:
        """Whether the last photographs of a caller that fails all did."""
        last = self._last(flow, now_s)[-FAILURES:]
        return len(last) == FAILURES and not any(last) and self.is_failing(flow, now_s)

    def queued_as(self, flow: Flow, now_s: float) -> Flow:
        """As whom a client's jobs are admitted and take turns: itself, or a client of the failing callers."""
        return Flow(flow.tenant, FAILING, flow.caller) if self.is_failing(flow, now_s) else flow

    def _last(self, flow: Flow, now_s: float) -> tuple[bool, ...]:
        known = self._of_callers.get(flow.group)
        return known.localized if known is not None and now_s - known.last_s <= FORGOTTEN_S else ()
