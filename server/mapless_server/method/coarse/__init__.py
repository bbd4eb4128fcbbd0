"""The coarse stage: query and references reconstructed together, up to one common scale.

The paper uses a feed-forward network here (its equation for Phi); any method that computes local points, confidences
and poses in one local frame can replace it. A backend is one file in this package with a `Reconstructor`; see `make`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import RigidTransform

from ..bundle.priors import NO_PRIORS, Priors
from ..features.views import PosedView, Reconstruction, View
from ..pairs.correspond import Correspondences
from ..rejection import Rejection
from ..structure.model import Structure


@dataclass(frozen=True, eq=False)
class Triangulation:
    """A reconstruction that is metric already: points of the references' known poses, and the query posed by them.

    Attributes:
        structure: the points, in the world of the references.
        world_from_query: the query's initial pose.
        point, keypoint: (M,) points that agree with this pose, and the query's keypoints that match them.
        without_priors: why the photograph alone gives no initial pose; None if this is its own.
    """

    structure: Structure
    world_from_query: RigidTransform
    point: NDArray[np.intp]
    keypoint: NDArray[np.intp]
    without_priors: Rejection | None = None


Outcome: TypeAlias = Reconstruction | Triangulation | Rejection
"""The result of a backend for one query: its reconstruction, or a rejection."""


@dataclass(frozen=True, eq=False)
class Request:
    """A query and its references, to be reconstructed together.

    Attributes:
        query: the photograph to localize.
        references: photographs with known poses.
        correspondences: between all views; networks use the images alone and need none.
        priors: on the query's pose, in the world of the references; networks ignore them.
        is_metric: whether the unit of the references' poses is the metre.
    """

    query: View
    references: Sequence[PosedView]
    correspondences: Correspondences | None = None
    priors: Priors = NO_PRIORS
    is_metric: bool = True


class Reconstructor(Protocol):
    """A coarse backend."""

    @property
    def name(self) -> str:
        """Name of the backend: "geometric", "pi3", ..."""
        ...

    @property
    def weights_sha256(self) -> str:
        """SHA-256 of the network's weights; empty without any."""
        ...

    @property
    def uses_correspondences(self) -> bool:
        """Whether the result depends on the correspondences; a network's does not, so it runs once for a query."""
        ...

    @property
    def is_batched(self) -> bool:
        """Whether queries are reconstructed together, by the one thread that owns the device; else on any thread."""
        ...

    def close(self) -> None:
        """Releases threads and devices; the backend cannot be used afterwards."""
        ...

    def bucket(self, query: View, references: Sequence[PosedView]) -> str:
        """Names the shape of a query's input, which has at least one reference.

        Queries of one bucket may be reconstructed together. ValueError if a view lacks input of the backend.
        """
        ...

    def reconstruct_many(self, requests: Sequence[Request]) -> list[Outcome | Exception]:
        """Reconstructs each query and its references; those of one bucket together, if the backend is batched.

        Returns for each request, in order, the reconstruction, a rejection, or its own exception, such as too little
        memory for this request alone. The other requests of a batch change an outcome by no more than rounding. An
        exception of the batch as a whole is raised; splitting the batch shows which request caused it.
        """
        ...


def reconstruct_one(
    reconstructor: Reconstructor,
    query: View,
    references: Sequence[PosedView],
    correspondences: Correspondences | None = None,
    priors: Priors = NO_PRIORS,
) -> Outcome:
    """Reconstructs a single request; raises its exception, if it has one."""
    (outcome,) = reconstructor.reconstruct_many([Request(query, references, correspondences, priors)])
    if isinstance(outcome, Exception):
        raise outcome
    return outcome
