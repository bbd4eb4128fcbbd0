"""An observer of work queues that counts their events."""

from collections import Counter

from mapless_server.scheduling import Ending, Observer, Refusal


class CountingObserver(Observer):
    """Counts events."""

    def __init__(self) -> None:
        self.admissions = 0
        self.out_of_memory = 0
        self.refusals: Counter[Refusal] = Counter()
        self.endings: Counter[Ending] = Counter()
        self.batches: list[tuple[str, int]] = []

    def admitted(self, cost_s: float) -> None:
        self.admissions += 1

    def refused(self, reason: Refusal) -> None:
        self.refusals[reason] += 1

    def computed(self, stage: str, bucket: str, jobs: int, seconds: float) -> None:
        self.batches.append((stage, jobs))

    def ended(self, stage: str, ending: Ending) -> None:
        self.endings[ending] += 1

    def ran_out_of_memory(self) -> None:
        self.out_of_memory += 1
