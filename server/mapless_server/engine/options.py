"""Options of the engine."""

from dataclasses import dataclass, field
from pathlib import Path

from mapless_server.bounds import check_bounds
from mapless_server.images import ImageLimits
from mapless_server.method.options import DoubtOptions
from mapless_server.scheduling import WorkQueueOptions


@dataclass(frozen=True)
class EngineOptions:
    """Limits of the engine.

    Attributes:
        workers: number of threads that compute on the CPU.
        max_batch: largest number of queries that a network reconstructs together.
        image_limits: limits of the images that are decoded.
        index_cache_bytes: memory for the scenes' indexes, by which references are chosen.
        index_dir: folder of the index files of large scenes; None searches these in memory.
        doubt: when an accepted pose is doubtful, so that further attempts are made.
        coverage: share of right answers to accept where a request does not say.
        queue: options of the work queue.
    """

    workers: int = 2
    max_batch: int = 4
    image_limits: ImageLimits = field(default_factory=ImageLimits)
    index_cache_bytes: int = 1024 * 2**20
    index_dir: Path | None = None
    doubt: DoubtOptions = field(default_factory=DoubtOptions)
    coverage: float = 0.95
    queue: WorkQueueOptions = field(default_factory=WorkQueueOptions)

    def __post_init__(self) -> None:
        check_bounds(self, "workers max_batch", at_least=1)
        check_bounds(self, "coverage", above=0, below=1)
