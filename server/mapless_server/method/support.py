"""What a pose rests on: everything that whoever judges, draws or combines answers needs to know of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapless.geometry import Array

from .match import PointMatches
from .pnp import PoseEstimate
from .structure import Structure
from .views import PosedView, View


@dataclass(frozen=True, eq=False)
class Support:
    """The matches of a query with the points of its references.

    Everything is in a world in which the first reference stands at the origin; `origin` says where that is in the
    caller's.

    Attributes:
        query: the photograph.
        references: in the order that the structure's tracks number them.
        structure: metric points and the references' keypoints that show them.
        matches: of the query with the points.
        estimate: the pose and which matches agree with it; None where there is none.
        origin: (3,) metres.
    """

    query: View
    references: tuple[PosedView, ...]
    structure: Structure
    matches: PointMatches
    estimate: PoseEstimate | None
    origin: Array

    def inliers_by_reference(self) -> tuple[int, ...]:
        """Per reference, inliers on points that it observes."""
        count = len(self.references)
        if self.estimate is None:
            return (0,) * count
        agreeing = np.zeros(len(self.structure.x_in_world), bool)
        agreeing[self.matches.point[self.estimate.inliers]] = True
        seen = self.structure.tracks.view[agreeing[self.structure.tracks.point]]
        return tuple(np.bincount(seen, minlength=count).tolist())
