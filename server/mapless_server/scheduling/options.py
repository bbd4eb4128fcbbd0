"""Options of the work queue."""

from dataclasses import dataclass


@dataclass(frozen=True)
class WorkQueueOptions:
    """Bounds of admission, order of computing, and supervision of the threads.

    Attributes:
        max_queued_s: largest predicted computing time of the admitted jobs, seconds per thread of a lane, besides a
            caller's only job (see `Admission.check_queue`). The result of a job admitted beyond it would be late, and a
            longer queue has no higher throughput.
        max_bytes: largest memory of admitted jobs, and of calls that consist of several jobs, together.
        flow_share: share, 0 to 1, that one caller may use of what other callers leave of either bound, so that there is
            always room for the next caller.
        time_margin: a job is admitted if at least this many times its predicted time remains until its deadline; 1 or
            more. Predictions are averages, and a result that comes too late is wasted for everyone.
        first_stage_interval: one of this many batches of a lane is of the first stage, if several stages wait; 2 or
            more.
        quantum_s: computing time credited to a caller in each round of the fair queue; about what one job of a stage
            takes.
        stall_limit_s: a batch without any progress (its end, or a job's `check`) for longer is considered hung: its
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
