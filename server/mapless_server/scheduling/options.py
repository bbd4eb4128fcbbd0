"""Options of the work queue."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class WorkQueueOptions:
    """Bounds of admission, order of computing, and supervision of the threads.

    Attributes:
        max_queued_s: predicted computing time of the admitted jobs, seconds per thread of a lane. A job admitted beyond
            it would get a late result, and a longer queue does not drain sooner.
        max_bytes: memory that admitted jobs, and calls that consist of several jobs, may hold together.
        flow_share: share of what other callers leave of either bound that one caller may fill, so that there is always
            room for the next caller; 0 to 1.
        time_margin: a job is admitted if at least this many times its predicted time remains until its deadline; 1 or
            more. Predictions are averages, and a result that comes too late is wasted for everyone.
        first_stage_interval: of so many batches of a lane in which several stages wait, one is of the first stage; 2 or
            more.
        quantum_s: computing time credited to a caller in each round of the fair queue; about what one job of a stage
            takes.
        stall_limit_s: a batch without a sign of life (its end, or a job's `check`) for longer is considered hung: its
            thread is lost, and the queue ends.
        heartbeat_s: interval of supervision.
    """

    max_queued_s: float = 2.0
    max_bytes: int = 256 * 2**20
    flow_share: float = 0.75
    time_margin: float = 1.2
    first_stage_interval: int = 4
    quantum_s: float = 0.2
    stall_limit_s: float = 120.0
    heartbeat_s: float = 1.0

    def __post_init__(self) -> None:
        least = {"time_margin": 1, "first_stage_interval": 2}
        for name, value in vars(self).items():
            if not (value > 0 and value >= least.get(name, 0)):
                bound = f"at least {least[name]}" if name in least else "above 0"
                raise ValueError(f"WorkQueueOptions.{name} must be {bound}, is {value}")
        if self.flow_share > 1:
            raise ValueError(f"WorkQueueOptions.flow_share must be at most 1, is {self.flow_share}")
