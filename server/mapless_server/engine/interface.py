"""The engine as services see it: `queue_engine.QueueEngine` when serving; without a queue when replaying calls."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from mapless_server.images import ImageLimits
from mapless_server.method.options import check_bounds
from mapless_server.scheduling import Flow, Job, WorkQueueOptions

from .tiers import EscalationOptions

if TYPE_CHECKING:  # services need not load what computes
    from mapless.geometry import RigidTransform
    from mapless_server.method.groups.rig import RigEstimate
    from mapless_server.method.groups.sequence import SequenceEstimate
    from mapless_server.method.rejection import Rejection
    from mapless_server.scenes import Choice, Coverage, Narrowing, ReferenceAudit, Viewpoint
    from mapless_server.security import SceneKey

    from .query import Caller, Description, Photo, Query, Result, Tier


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


class Engine(Protocol):
    """Computes for the services; its methods are called on one event loop.

    The methods that compute raise RequestError for a bad image, an unknown scene or reference, a full queue, or a
    passed deadline.
    """

    @property
    def options(self) -> EngineOptions:
        """Limits of the engine, and defaults of requests."""
        ...

    @property
    def tiers(self) -> Sequence[Tier]:
        """The tiers, the cheapest first."""
        ...

    @property
    def parallel_queries(self) -> int:
        """How many queries of one call are worth computing concurrently."""
        ...

    def query_job(self, query: Query, caller: Caller, *, on_coarse: Callable[[Result], None] | None = None) -> Job:
        """Makes the job of localizing a photograph, for `run`; its `records` list the stages that it has been through.

        `on_coarse` is called on the event loop, before the answer, with the first tier's localization before its
        refinement, if there is one; nothing has checked it. It is called again if references are deleted while they are
        used. The answer does not depend on it.
        """
        ...

    async def run(self, job: Job) -> Result:
        """Computes a query's job and returns its result."""
        ...

    async def pose_rig(
        self,
        queries: Sequence[Query],
        results: Sequence[Result],
        rig_from_camera: Sequence[RigidTransform],
        caller: Caller,
    ) -> RigEstimate | Rejection:
        """Estimates the pose of the rig that took the photographs; not refused by a full queue."""
        ...

    async def pose_sequence(
        self,
        queries: Sequence[Query],
        results: Sequence[Result],
        session_from_camera: Sequence[RigidTransform],
        estimate_scale: bool,
        caller: Caller,
    ) -> SequenceEstimate | Rejection:
        """Estimates the poses of a sequence's frames, in OpenCV's axes; not refused by a full queue."""
        ...

    def hold(self, queries: Sequence[Query], caller: Caller) -> AbstractContextManager[None]:
        """Reserves the memory of a group's photographs for its whole call, however many of them are queued."""
        ...

    def check_room(self, flow: Flow, is_query: bool = True) -> None:
        """Raises RequestError if no query of a caller would be admitted now, or no upload; its message is not read."""
        ...

    async def describe(self, photos: Sequence[Photo], caller: Caller) -> list[Description]:
        """Computes features and descriptors of photographs, in order."""
        ...

    async def retrieve(
        self, scene_key: SceneKey, photo: Photo, count: int, narrowing: Narrowing, caller: Caller
    ) -> Choice:
        """Chooses the references of a scene that resemble a photograph most."""
        ...

    async def audit(
        self, scene_key: SceneKey, reference_ids: Sequence[str], caller: Caller, are_listed: bool = False
    ) -> tuple[int, list[ReferenceAudit]]:
        """Audits references of a scene by their neighbours; returns the scene's generation and the audits, in order.

        References that do not exist any more are left out if `are_listed`, that is, if the caller did not name them.
        """
        ...

    async def check_coverage(self, scene_key: SceneKey, view: Viewpoint, caller: Caller) -> tuple[int, Coverage]:
        """Predicts whether a photograph would be localized at a viewpoint; also returns the scene's generation."""
        ...

    def forget_references(self, keys: Collection[str]) -> None:
        """Frees the memory of deleted references."""
        ...

    def forget_scene(self, scene_key: SceneKey) -> None:
        """Frees the memory of a deleted scene."""
        ...

    def drain(self) -> None:
        """Refuses all new jobs; admitted ones are still computed."""
        ...
