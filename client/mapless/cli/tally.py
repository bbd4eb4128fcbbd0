"""What became of a folder's photographs, counted."""

from __future__ import annotations

from collections import Counter

from ..answers import LocalizationResult, Rejected
from ..errors import MaplessError
from .exits import EXIT_FAILED, EXIT_REJECTED

Outcome = LocalizationResult | Rejected | MaplessError
LOCALIZED, NOT_LOCALIZED, FAILED = "localized", "not localized", "failed"


class Tally:
    """Outcomes by their kind and reason."""

    def __init__(self, total: int) -> None:
        self._total = total
        self._counts: Counter[str] = Counter()
        self._reasons: dict[str, Counter[str]] = {NOT_LOCALIZED: Counter(), FAILED: Counter()}
        self._captured = 0

    def count(self, outcome: Outcome) -> str:
        """One more; its kind."""
        kind = LOCALIZED
        if isinstance(outcome, Rejected | MaplessError):
            kind = FAILED if isinstance(outcome, MaplessError) else NOT_LOCALIZED
            self._reasons[kind][outcome.reason] += 1
        self._counts[kind] += 1
        self._captured += not isinstance(outcome, MaplessError) and outcome.diagnostics.captured
        return kind

    @property
    def done(self) -> int:
        """Photographs so far."""
        return self._counts.total()

    @property
    def exit_code(self) -> int:
        """What the command ends with."""
        if self._counts[FAILED]:
            return EXIT_FAILED
        return EXIT_REJECTED if self._counts[NOT_LOCALIZED] else 0

    def text(self) -> str:
        """One line: "15 of 20 localized, 5 failed (4 QUEUE_FULL, 1 DEADLINE_EXCEEDED)"."""
        told = "" if self.done == self._total else f"ended after {self.done} of {self._total}: "
        told += f"{self._counts[LOCALIZED]} of {self.done} localized"
        for kind, reasons in self._reasons.items():
            if reasons:
                why = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
                told += f", {self._counts[kind]} {kind} ({why})"
        return told + (f"; {self._captured} captured by the server" if self._captured else "")
