"""The support of a pose: references that agree with their own poses, and matches that are not fixed to the camera.

No pose is right that rests on references which do not agree with their own poses, however many matches it explains.
Their agreement is known from matches that took no part in the pose.

Matches at the same pixels as in a reference may be fixed to the camera: a badge, a display or a watermark makes them in
photographs of any place. They may take part in a pose, but the pose must be no chance without them. They are evidence
where they lie all over the image: the photograph shows the same as the reference, from the same place.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..bundle.estimate import SUPPORTING_SHARE, PosedSupport, Support
from ..features.limits import MAX_SIDE_PX
from ..features.tracks import keypoint_offsets
from ..features.views import PosedView, ReferenceErrors, View
from ..pairs.agreement import MAX_ERROR_PX
from ..pairs.stationary import StationaryOptions, have_same_shape, in_columns, shows_view_of
from ..pose.pnp import gate_failure
from ..rejection import Advice, Hint, Rejection, RejectionReason

MIN_INLIERS = 6
"""Inliers of a reference that a pose rests on, at least; and `SUPPORTING_SHARE` of those of the one with the most."""

MOST_REFERENCES = 5
"""Those with the most inliers are compared: ten pairs."""


@dataclass(frozen=True)
class Supporters:
    """The references that support a pose.

    Attributes:
        names: their names.
        inlier_counts: for each, inliers of the pose that rest on it.
        error_px: returns the error of a pair of them; None if they were not matched with one another.
        stated_px: for each, how far what it states of its pose's errors displaces what it shows, see `stated_px`; empty
            if none states a covariance.
    """

    names: Sequence[str]
    inlier_counts: Sequence[int]
    error_px: ReferenceErrors | None
    stated_px: Sequence[float] = ()

    def errors_px(self) -> list[float]:
        """Errors of the pairs of those that a pose rests on most, as far as they are known.

        An error is made smaller by as much as what both state would make it larger than `MAX_ERROR_PX`.
        """
        if self.error_px is None:
            return []
        least = max(MIN_INLIERS, SUPPORTING_SHARE * max(self.inlier_counts, default=0))
        used = [i for i, count in enumerate(self.inlier_counts) if count >= least]
        used = sorted(used, key=lambda i: -self.inlier_counts[i])[:MOST_REFERENCES]
        found = {pair: self.error_px(*sorted(pair)) for pair in combinations(used, 2)}
        return [it / self._tolerance(pair) for pair, it in found.items() if it is not None]

    def _tolerance(self, pair: tuple[int, int]) -> float:
        return math.hypot(1.0, *(self.stated_px[i] / MAX_ERROR_PX for i in pair)) if self.stated_px else 1.0


def stated_px(references: Sequence[PosedView], distance_m: float) -> list[float]:
    """How far errors of poses by two standard deviations displace what is at a distance, pixels of `MAX_SIDE_PX`.

    0 for references without a covariance; empty if none has one.
    """
    if all(it.provenance.covariance is None for it in references):
        return []
    found = []
    for it in references:
        own = np.zeros((6, 6)) if it.provenance.covariance is None else np.array(it.provenance.covariance)
        position_m, rotation = (2 * math.sqrt(np.linalg.eigvalsh(own[i : i + 3, i : i + 3])[-1]) for i in (0, 3))
        camera = it.view.camera
        focal_px = camera.focal_x_px * MAX_SIDE_PX / max(camera.width_px, camera.height_px)
        found.append(focal_px * math.hypot(position_m / distance_m, rotation))
    return found


def supporters_of(support: PosedSupport) -> Supporters:
    """The references that support the estimate of a support."""
    names = [reference.name for reference in support.references]
    stated = stated_px(support.references, support.distance_m())
    return Supporters(names, support.inliers_by_reference(), support.reference_error_px, stated)


def disagreeing_references(photographs: Sequence[Supporters]) -> Rejection | None:
    """Rejects a pose, of one photograph or of several together, whose supporting references mostly do not agree."""
    errors_px = [it for photograph in photographs for it in photograph.errors_px()]
    agreeing = sum(it <= MAX_ERROR_PX for it in errors_px)
    if not errors_px or 2 * agreeing >= len(errors_px):
        return None
    message = (
        f"of {len(errors_px)} pairs of references that the pose rests on, {agreeing} agree with their own poses: what "
        f"they show in common is {sorted(errors_px)[len(errors_px) // 2]:.0f} px off, in the median (of an image of "
        f"1024 pixels, at most {MAX_ERROR_PX:g})"
    )
    return _wrong_references(message, [it for it in photographs if it.errors_px()])


def without_agreement(photographs: Sequence[Supporters]) -> Rejection | None:
    """Rejects a pose in a scene that contradicts itself unless two references that support it agree.

    The pose is that of one photograph, or of several together. Elsewhere references of which nothing is known are taken
    to have right poses.
    """
    if any(it <= MAX_ERROR_PX for photograph in photographs for it in photograph.errors_px()):
        return None
    return _wrong_references("no two of the references that the pose rests on agree with their own poses", photographs)


def _wrong_references(message: str, photographs: Sequence[Supporters]) -> Rejection:
    """The rejection whose hint names the reference with the most inliers."""
    counted = [pair for it in photographs for pair in zip(it.inlier_counts, it.names, strict=True)]
    _, best = max(counted, default=(0, None))
    return Rejection(RejectionReason.GATE, message, Hint("judge", Advice.CHECK_REFERENCE_POSES, ADVICE, best))


ADVICE = (
    "Check the references' poses, not the photograph: world_from_camera (not its inverse) with OpenCV's axes (x right, "
    "y down, z forward), all in one world; `mapless-server audit` compares all of a scene."
)
"""The hint beside CHECK_REFERENCE_POSES."""


def with_contradiction(rejection: Rejection, contradiction: str) -> Rejection:
    """The rejection of a photograph in a scene that contradicts itself: that is said, and no advice of other causes."""
    if not contradiction:
        return rejection
    hint = rejection.hint
    stage, best = ("", None) if hint is None else (hint.stage, hint.best_reference)
    advice = Hint(stage, Advice.CHECK_REFERENCE_POSES, ADVICE, best)
    # The message of a group's rejection may be that of one of its photographs.
    is_said = contradiction in rejection.message
    message = rejection.message if is_said else f"{rejection.message}; {contradiction}"
    return Rejection(rejection.reason, message, advice, rejection.hypotheses, rejection.tried)


def unmoved_failure(
    support: PosedSupport, inlier_px: float, options: StationaryOptions, log10_chance: float = 0.0
) -> str | None:
    """Says in one sentence that a pose rests on what may be fixed to the camera; None if it passes without that.

    The estimate of the support has passed the gate; for the others see `pnp.gate_failure`.
    """
    inliers, said = support.estimate.inliers, None
    for knows_same_view in (False, True):  # the comparison of whole photographs is seldom needed
        moved = moved_matches(support, options, knows_same_view)
        unmoved_count = int((inliers & ~moved).sum())
        if not unmoved_count:
            return None
        kept = support.matches.select(moved)
        failure = gate_failure(support.query.camera, kept, inliers[moved], inlier_px, log10_chance)
        if failure is None:
            return None
        said = f"{without(unmoved_count)} {failure}"
    return said


def without(unmoved_count: int) -> str:
    """The beginning of the sentence why a pose is not accepted without so many matches at the same pixels."""
    return (
        f"{unmoved_count} matches are at the same pixels as in the references, as if fixed to the camera; without them"
    )


def moved_matches(support: Support, options: StationaryOptions, knows_same_view: bool = True) -> NDArray[np.bool_]:
    """Returns which 2D-3D matches (M,) are evidence: their points are at other pixels in some reference.

    `options` have the largest displacement of what is fixed; `knows_same_view` is whether matches at the same pixels as
    in a reference count if both show the same view.
    """
    query, references, structure, matches = support.query, support.references, support.structure, support.matches
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
            is_moved[view == i] |= shows_view_of(query, references[i], support.query_matches[i], options)
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
