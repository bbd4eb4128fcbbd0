"""What the queue tells of itself, for whoever counts."""

from __future__ import annotations

from enum import Enum


class Refusal(str, Enum):
    """Why a call is not admitted."""

    QUEUE_FULL = "queue_full"
    TOO_MUCH_MEMORY = "too_much_memory"
    DEADLINE_INFEASIBLE = "deadline_infeasible"
    TENANT_QUOTA = "tenant_quota"
    DRAINING = "draining"
    TOO_LARGE = "too_large"


class Ending(str, Enum):
    """How an admitted job ends; each ends in exactly one of these ways."""

    OK = "ok"
    LOW_CONFIDENCE = "low_confidence"
    """There is an answer, and it is that there is no result worth giving."""
    DEGRADED = "degraded"
    """What was known by the time was given, because the rest could not be computed in time."""
    EXPIRED = "expired"
    CANCELLED = "cancelled"
    OUT_OF_MEMORY = "oom"
    REFUSED_INPUT = "bad_input"
    """What was to be computed turned out to be the caller's mistake."""
    FAILED = "backend_error"


class Observer:
    """Hears what happens, and here does nothing about it.

    It is called from any thread with the queue locked, so it must return at once and never raise.
    """

    def admitted(self, cost_s: float) -> None:
        """A job was admitted, and so much computing is predicted for it."""

    def refused(self, reason: Refusal) -> None:
        """A job was not."""

    def queued(self, stage: str, jobs: int, cost_s: float) -> None:
        """So many jobs now wait for a stage, and so much computing is predicted for them from there on."""

    def running(self, stage: str, jobs: int) -> None:
        """So many jobs are now computed in a stage."""

    def waited(self, stage: str, seconds: float) -> None:
        """A job waited so long for the stage that it now enters."""

    def computed(self, stage: str, bucket: str, jobs: int, seconds: float) -> None:
        """A batch was computed, with so many jobs; the bucket says of what shape they were."""

    def ended(self, stage: str, ending: Ending) -> None:
        """A job ended, in or before this stage."""

    def ran_out_of_memory(self) -> None:
        """A batch was too large for the device; called in the thread that computed it."""
