"""What is asked of the engine, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass

from mapless.geometry import Camera
from mapless_server.method.localize import LocalizeOptions
from mapless_server.method.priors.known import NO_PRIORS, Priors
from mapless_server.scenes.retrieval.narrowing import Narrowing
from mapless_server.scheduling import Flow
from mapless_server.security.tenancy import SceneKey

from .tiers import Attempt

UNFINISHED = "/unfinished"
"""Ends the name of a stage: its tier came to no answer, see `Result`."""

DEFAULT_REFERENCE_COUNT = 10
"""References that are chosen where the caller does not say how many."""


@dataclass(frozen=True)
class Caller:
    """Who asks.

    Attributes:
        flow: with whom the queue shares its time fairly.
        deadline_s: when the answer is of no use any more, `time.monotonic`.
    """

    flow: Flow
    deadline_s: float


@dataclass(frozen=True, eq=False)
class Photo:
    """An encoded image and its camera; `field` is its path in the request, for what is wrong with it."""

    image: bytes
    camera: Camera
    field: str


@dataclass(frozen=True, eq=False)
class Query:
    """A photograph to localize.

    Attributes:
        scene_key: where.
        reference_ids: what to compare it with; none means that `reference_count` of the scene's are to be chosen.
        photo: the photograph.
        narrowing: limits to where it was taken, which choose among references and judge the pose.
        reference_count: see there.
        options: of the method.
        allow_coarse: whether the coarse pose is an answer where there is no time to refine it.
        rerank: whether `reference_count` of the named references are to be chosen.
        priors: what is known of the pose, each with its uncertainty, in the scene's world.
        is_part: whether it is one of several photographs that are to be posed together: then its matches are wanted
            even where it cannot be localized alone.
    """

    scene_key: SceneKey
    reference_ids: tuple[str, ...]
    photo: Photo
    narrowing: Narrowing
    reference_count: int
    options: LocalizeOptions
    allow_coarse: bool = False
    rerank: bool = False
    priors: Priors = NO_PRIORS
    is_part: bool = False

    @property
    def chooses(self) -> bool:
        """Whether the references are chosen here, by how much they resemble the photograph."""
        return self.rerank or not self.reference_ids


@dataclass(frozen=True, eq=False)
class Result:
    """The attempt that is answered, and where the time went.

    Attributes:
        attempt: of the tier whose answer is the better one.
        stage_seconds: of all that was computed, in order, whichever tier is answered. A stage of another tier than the
            first begins with its extractor's name and a slash. Such a tier has, alone, "unfinished", if it failed, was
            given up for lack of time, or has yet to describe the references.
    """

    attempt: Attempt
    stage_seconds: dict[str, float]
