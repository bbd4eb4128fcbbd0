"""Delays refusals beyond a rate, so that callers that call again at once leave the processor to the answers."""

import asyncio
import time

PACED_CODES = frozenset({"RESOURCE_EXHAUSTED", "UNAUTHENTICATED", "PERMISSION_DENIED"})
"""Of what a caller may repeat as fast as it is answered. UNAVAILABLE is not among them, which sends it elsewhere."""

PER_S = 50
"""Refusals a second, of all callers, that are not delayed: 2 % of a core. A server of twenty answers a second refuses
fewer at three times what it can do."""

BURST = 50
"""So many are not delayed although they come at once."""

LONGEST_S = 1.0
"""The longest delay."""

MOST_DELAYED = 256
"""Calls that are delayed at a time, a small part of those that may be open; a further one is refused at once."""


class Pace:
    """Gives refusals their turns; runs on the event loop."""

    def __init__(self) -> None:
        self._free_s = 0.0
        self._delayed = 0

    async def turn(self, deadline_s: float) -> None:
        """Returns when the next refusal may be sent, before the call's deadline, by `time.monotonic`."""
        now_s = time.monotonic()
        self._free_s = min(max(self._free_s, now_s - BURST / PER_S) + 1 / PER_S, now_s + LONGEST_S)
        wait_s = min(self._free_s, deadline_s) - now_s
        if wait_s > 0 and self._delayed < MOST_DELAYED:
            self._delayed += 1
            try:
                await asyncio.sleep(wait_s)
            finally:
                self._delayed -= 1
