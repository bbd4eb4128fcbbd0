"""Options of the engine, and of trying stronger features."""

from dataclasses import dataclass, field

from mapless_server.bounds import check_bounds
from mapless_server.images import ImageLimits
from mapless_server.scheduling import WorkQueueOptions


@dataclass(frozen=True)
class EscalationOptions:
    """Options of trying stronger features.

    Attributes:
        doubtful_trust: a pose with less trust is doubtful. Of 2,528 photographs, many with few references, SIFT
            and EdgePoint2 had 115 off by over 5 % of the distance, 5 degrees or 25 cm; trying again below this trust
            tries 393, 114 of these among them; below 0.2 it tries 335, 109 of these among them.
        doubtful_radius_m: a pose whose claimed 68 % radius is larger is doubtful: what a robot needs to pass a door.
    """

    doubtful_trust: float = 0.25
    doubtful_radius_m: float = 0.2

    def __post_init__(self) -> None:
        check_bounds(self, "doubtful_trust doubtful_radius_m", at_least=0)


@dataclass(frozen=True)
class EngineOptions:
    """Limits of the engine.

    Attributes:
        workers: number of threads that compute on the CPU.
        max_batch: largest number of queries that a network reconstructs together.
        image_limits: limits of the images that are decoded.
        index_cache_bytes: memory for the scenes' indexes, by which references are chosen.
        escalation: when stronger features are tried.
        coverage: share of right answers to accept where a request does not say.
        queue: options of the work queue.
    """

    workers: int = 2
    max_batch: int = 4
    image_limits: ImageLimits = field(default_factory=ImageLimits)
    index_cache_bytes: int = 1024 * 2**20
    escalation: EscalationOptions = field(default_factory=EscalationOptions)
    coverage: float = 0.95
    queue: WorkQueueOptions = field(default_factory=WorkQueueOptions)

    def __post_init__(self) -> None:
        check_bounds(self, "workers max_batch", at_least=1)
        check_bounds(self, "coverage", above=0, below=1)
