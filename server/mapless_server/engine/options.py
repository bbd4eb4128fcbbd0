"""Options of the engine, and of trying stronger features."""

from dataclasses import dataclass, field

from mapless_server.images import ImageLimits
from mapless_server.method.options import check_bounds
from mapless_server.scheduling import WorkQueueOptions


@dataclass(frozen=True)
class EscalationOptions:
    """Options of trying stronger features.

    Attributes:
        doubtful_trust: a pose with less trust is doubtful. Of 2,528 photographs, many with few references, SIFT
            and EdgePoint2 had 115 off by over 5 % of the distance, 5 degrees or 25 cm; trying again below this trust
            tries 393, 114 of these among them; below 0.2 it tries 335, 109 of these among them.
        doubtful_radius_m: a pose whose claimed 68 % radius is larger is doubtful: what a robot needs to pass a door.
        same_position_m, same_rotation_deg: two poses closer than this never contradict each other, however small the
            claimed radii, which leave out the errors of the references' poses.
        same_share: a pose that was rejected contradicts one at more than this share of the distance from what the
            photograph shows: that is as far as a right pose may be off. Of 12 right poses of ALIKED with
            LightGlue two were further from a rejected one of EdgePoint2, with over twice its inliers; of nine wrong
            ones all were, seven of them with less than 1.5 times its inliers.
        clearly_more: if two poses contradict each other, that of the stronger features is accepted if it has this many
            times the inliers of the other; so is one that contradicts a rejected pose where the soft priors are. Priors
            do not decide for a place if another one has this many times its inliers.
        time_share: share of the remaining time that a stronger tier may take. After that the first answer is returned,
            since a doubtful answer is better than none; the rest of the time suffices to send it.
        rematch_share: share of a tier's time after which it stops matching the photograph again by a slow network (see
            `Matcher.rematch`); the rest is for the pose, which takes a second if matches are few.
    """

    doubtful_trust: float = 0.25
    doubtful_radius_m: float = 0.2
    same_position_m: float = 0.1
    same_rotation_deg: float = 2.0
    same_share: float = 0.05
    clearly_more: float = 1.5
    time_share: float = 0.8
    rematch_share: float = 0.7

    def __post_init__(self) -> None:
        check_bounds(self, "doubtful_trust doubtful_radius_m", at_least=0)
        check_bounds(self, "same_position_m same_rotation_deg same_share", at_least=0)
        check_bounds(self, "clearly_more", at_least=1)
        check_bounds(self, "time_share rematch_share", above=0, at_most=1)


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
