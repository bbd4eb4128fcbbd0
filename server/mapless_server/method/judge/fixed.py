"""Matches that may be fixed to the camera are no evidence for a pose, also where references do not show it.

Matches at the same pixels as in a reference say "the pose of the reference". On a straight drive poses explain them as
points that are far away, and a single reference, or several at one pose, cannot show that they are anything else; but a
badge, a display or a watermark makes them in photographs of any place. So they may take part in a pose, but the pose
must be no chance without them. A photograph that shows the same as a reference from the same place matches it at the
same pixels all over the image: then they are evidence.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..bundle.estimate import PosedSupport
from ..features.tracks import keypoint_offsets
from ..features.views import Matches, PosedView, View
from ..pairs.stationary import (
    StationaryOptions,
    have_same_shape,
    in_columns,
    shows_view_of,
)
from ..pose.pnp import gate_failure
from ..structure.model import PointMatches, Structure


def unmoved_failure(
    support: PosedSupport, inlier_px: float, options: StationaryOptions, log10_chance: float = 0.0
) -> str | None:
    """Says in one sentence that a pose rests on what may be fixed to the camera; None if it passes without that.

    The estimate of the support has passed the gate; for the others see `pnp.gate_failure`.
    """
    query, estimate = support.query, support.estimate
    assert estimate is not None
    given = query, support.references, support.structure, support.matches, support.query_matches
    said = None
    for knows_same_view in (False, True):  # the comparison of whole photographs is seldom needed
        moved = moved_matches(*given, options, knows_same_view)
        unmoved_count = int((estimate.inliers & ~moved).sum())
        if not unmoved_count:
            return None
        kept, inliers = support.matches.select(moved), estimate.inliers[moved]
        failure = gate_failure(query.camera, kept, inliers, inlier_px, log10_chance)
        if failure is None:
            return None
        said = f"{without(unmoved_count)} {failure}"
    return said


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
    knows_same_view: bool = True,
) -> NDArray[np.bool_]:
    """Returns which 2D-3D matches (M,) are evidence: their points are at other pixels in some reference.

    Args:
        query: the photograph.
        references: in the order that the structure's tracks number them.
        structure: the points.
        matches: of the photograph with the points.
        query_matches: of the photograph with each reference; they say whether both show the same view.
        options: largest displacement of what is fixed.
        knows_same_view: whether matches at the same pixels as in a reference count if both show the same view.
    """
    keypoint_of = np.full(len(structure.x_in_world), -1)
    keypoint_of[matches.point] = matches.keypoint
    keypoint = keypoint_of[structure.tracks.point]
    rows = np.flatnonzero(keypoint >= 0)
    point, view, theirs = (
        it[rows] for it in (structure.tracks.point, structure.tracks.view, structure.tracks.keypoint)
    )
    is_moved = _are_moved(query, references, view, keypoint[rows], theirs, options)
    if knows_same_view:
        for i in np.unique(view[~is_moved]):
            is_moved[view == i] |= shows_view_of(query, references[i], query_matches[i], options)
    moved = np.zeros(len(structure.x_in_world), bool)
    moved[point[is_moved]] = True
    return np.asarray(moved[matches.point])


def _are_moved(
    query: View,
    references: Sequence[PosedView],
    view: NDArray[np.intp],
    keypoint: NDArray[np.intp],
    reference_keypoint: NDArray[np.intp],
    options: StationaryOptions,
) -> NDArray[np.bool_]:
    """Returns whether each keypoint (N,) of a photograph is elsewhere in its reference, for all references at once."""
    offsets = keypoint_offsets(references)
    scaled = [in_columns(it.view.camera, it.view.features.keypoints) for it in references]
    pixels = np.concatenate(scaled)[offsets[view] + reference_keypoint]
    apart = np.abs(in_columns(query.camera, query.features.keypoints[keypoint]) - pixels).max(axis=1)
    alike = np.array([have_same_shape(query.camera, it.view.camera) for it in references])
    return np.asarray((apart >= options.unmoved_px) | ~alike[view])
