"""How long jobs take, learned from those before."""

from __future__ import annotations

from collections import OrderedDict

MAX_KINDS = 1000


class Costs:
    """Predicted computing time of a job in a stage, by the job's kind: an average in which the recent count more."""

    def __init__(self, first_guess_s: float = 0.25, memory: int = 10) -> None:
        """What nothing is known of is guessed at; about the last `memory` jobs of a kind count."""
        self._first_guess_s = first_guess_s
        self._memory = memory
        self._kinds: OrderedDict[tuple[str, str], tuple[int, float]] = OrderedDict()

    def forget(self) -> None:
        """Nothing is known any more."""
        self._kinds.clear()

    def predict(self, stage: str, kind: str) -> float:
        """Seconds. Of an unknown kind, those of the stage's kind that was seen last."""
        known = self._kinds.get((stage, kind)) or self._kinds.get((stage, ""))
        return self._first_guess_s if known is None else known[1]

    def observe(self, stage: str, kind: str, seconds: float) -> None:
        """A job of this kind took so long there; its share, if it was computed with others."""
        for key in ((stage, kind), (stage, "")):
            count, mean_s = self._kinds.pop(key, (0, 0.0))
            count = min(count + 1, self._memory)
            self._kinds[key] = (count, mean_s + (seconds - mean_s) / count)
        while len(self._kinds) > MAX_KINDS:
            self._kinds.popitem(last=False)
