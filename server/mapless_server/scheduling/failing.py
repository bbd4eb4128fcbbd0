"""Callers whose last photographs all failed: together they queue as one more caller, and get only what is cheap."""

from collections import OrderedDict
from itertools import takewhile
from typing import NamedTuple

from .costs import MAX_OF_CALLERS
from .expected import LATELY_S
from .jobs import Flow

FAILURES = 2
"""A caller fails if so many of its last photographs did, and none since was localized."""
FORGOTTEN_S = 60.0
"""A caller that has asked nothing for so long is one like any other again."""
FAILING = "callers that fail\n"
"""The caller that all failing callers of a tenant are; no caller can send a name with a line break."""


class _Failures(NamedTuple):
    count: int
    last_s: float


class Failing:
    """Counts the failures of callers: a token's, whatever its clients call themselves.

    One that is lost asks again and again, and each photograph takes many times what one takes that belongs. Equal
    shares would let a few of them take most of the server. So they share the part of one caller, like further steps.
    """

    def __init__(self) -> None:
        self._of_callers: OrderedDict[tuple[str, str], _Failures] = OrderedDict()
        # When the others asked last, in this order.
        self._asked_s: OrderedDict[tuple[str, str], float] = OrderedDict()

    def answered(self, flow: Flow, is_localized: bool, now_s: float) -> None:
        """Counts a photograph, or photographs that were localized together."""
        known = self._of_callers.pop(flow.group, None)
        if is_localized:
            return
        count = known.count if known is not None and now_s - known.last_s <= FORGOTTEN_S else 0
        self._of_callers[flow.group] = _Failures(count + 1, now_s)
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
        """Whether a caller's last photographs all failed."""
        known = self._of_callers.get(flow.group)
        return known is not None and known.count >= FAILURES and now_s - known.last_s <= FORGOTTEN_S

    def queued_as(self, flow: Flow, now_s: float) -> Flow:
        """As whom a client's jobs are admitted and take turns: itself, or a client of the failing callers."""
        return Flow(flow.tenant, FAILING, flow.caller) if self.is_failing(flow, now_s) else flow
