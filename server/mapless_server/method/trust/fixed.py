"""What is fixed to the camera is no evidence for a pose, also where references do not show that it is fixed.

Matches at the same pixels as in a reference say "the pose of the reference". On a straight drive poses explain them as
points that are far away, and a single reference, or several at one pose, cannot show that they are anything else; but a
badge, a display or a watermark makes them in photographs of any place. So they may take part in a pose, but the pose
must be no chance without them. A photograph that shows the same as a reference from the same place matches it at the
same pixels all over the image: then they are evidence.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..pnp import gate_failure
from ..results import PointMatches, Structure, Support
from ..stationary import StationaryOptions, displacements_px, show_same_view
from ..views import Matches, PosedView, View


def unmoved_failure(
    support: Support, inlier_px: float, options: StationaryOptions, log10_chance: float = 0.0
) -> str | None:
    """Says in one sentence that a pose rests on what may be fixed to the camera; None if it passes without that.

    The estimate of the support has passed the gate; for the others see `pnp.gate_failure`.
    """
    query, estimate = support.query, support.estimate
    assert estimate is not None
    given = query, support.references, support.structure, support.matches, support.query_matches
    moved = moved_matches(*given, options)
    unmoved_count = int((estimate.inliers & ~moved).sum())
    if not unmoved_count:
        return None
    kept, inliers = support.matches.select(moved), estimate.inliers[moved]
    failure = gate_failure(query.camera, kept, inliers, inlier_px, log10_chance)
    return f"{without(unmoved_count)} {failure}" if failure else None


def without(unmoved_count: int) -> str:
    """The beginning of the sentence why a pose is not accepted without so many matches at the same pixels."""
    return (
        f"{unmoved_count} matches are at the same pixels as in the references, as if fixed to the camera; without them"
    )


def moved_matches(
    query: View,
    references: Sequence[PosedView],
    structure: Structure,
    matches: PointMatches,
    query_matches: Sequence[Matches],
    options: StationaryOptions,
) -> NDArray[np.bool_]:
    """Which 2D-3D matches (M,) are evidence: of points that some reference sees at other pixels than the photograph.

    Args:
        query: the photograph.
        references: in the order that the structure's tracks number them.
        structure: the points.
        matches: of the photograph with the points.
        query_matches: of the photograph with each reference; they say whether both show the same view.
        options: largest displacement of what is fixed.
    """
    keypoint_of = np.full(len(structure.x_in_world), -1)
    keypoint_of[matches.point] = matches.keypoint
    tracks = structure.tracks
    rows = np.flatnonzero(keypoint_of[tracks.point] >= 0)
    moved = np.zeros(len(structure.x_in_world), bool)
    for view in np.unique(tracks.view[rows]):
        of_view = rows[tracks.view[rows] == view]
        point = tracks.point[of_view]
        pairs = np.stack([keypoint_of[point], tracks.keypoint[of_view]], axis=1).astype(np.int32)
        moved[point[are_moved(query, references[view], pairs, query_matches[view], options)]] = True
    return np.asarray(moved[matches.point])


def are_moved(
    query: View, reference: PosedView, pairs: Matches, query_matches: Matches, options: StationaryOptions
) -> NDArray[np.bool_]:
    """Which matches (M, 2) of a photograph with a reference are at other pixels; all, if both show the same view."""
    moved = displacements_px(query, reference.view, pairs) >= options.unmoved_px
    if moved.all():
        return moved
    unmoved = query_matches[displacements_px(query, reference.view, query_matches) <= options.unmoved_px]
    return moved | show_same_view(query, reference.view, unmoved, options)
