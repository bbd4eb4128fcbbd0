"""What the queue reports, for metrics."""

from .jobs import Ending, Refusal


class Observer:
    """Receives the queue's events; ignores them unless a method is overridden.

    Methods are called from any thread with the queue locked, so they must return at once and never raise.
    """

    def admitted(self, cost_s: float) -> None:
        """A job was admitted; `cost_s` is its predicted computing time."""

    def refused(self, reason: Refusal) -> None:
        """A job was refused."""

    def waited(self, stage: str, seconds: float) -> None:
        """A job was taken from a stage's waiting jobs after this time."""

    def computed(self, stage: str, bucket: str, jobs: int, seconds: float) -> None:
        """A batch of this many jobs of a bucket was computed."""

    def ended(self, stage: str, ending: Ending) -> None:
        """A job ended, in or before this stage."""

    def ran_out_of_memory(self) -> None:
        """A batch was too large for the device; called in the thread that computed it, without the lock."""
