"""Agreement: how far apart the poses are that disjoint halves of the data give.

A pose that is right and well determined is found again from half of the matches, and from the matches with half of the
references. A wrong one is not: chance and repeated structure put the halves at different places, wrong reference poses
put the halves of the references there, and a pose that few matches or a flat scene determine badly moves by as much as
its own error. The distance of the two cameras, as a share of their distance from what they see, means the same for
every scene, unit and kind of feature.

Matches from a guided search agree with the pose around which they were searched, so they take no part unless there are
no others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera

from ..options import check_bounds
from ..pnp import PnpOptions, ransac
from ..results import Support
from .votes import Votes

NO_AGREEMENT = 1.0
"""The disagreement of halves that give no pose: as far apart as what they see is away."""


@dataclass(frozen=True)
class AgreementOptions:
    """Options of the comparison.

    Attributes:
        splits: into halves, of which the median counts; one split may put all good matches into one half.
        shuffling: references are assigned to halves in the order of their numbers of matches, each raised by up to this
            share at random, so that the splits differ and the halves remain balanced.
        pnp: of the halves' poses. Of good matches 30 iterations give the same poses as 100; 1000 find a pose with
            a third of the matches as inliers.
    """

    splits: int = 3
    shuffling: float = 0.3
    pnp: PnpOptions = field(default_factory=lambda: PnpOptions(min_iterations=30, max_iterations=1000, max_matches=600))

    def __post_init__(self) -> None:
        check_bounds(self, "splits", at_least=1)
        check_bounds(self, "shuffling", at_least=0)


def disagreement_of_matches(support: Support, distance_m: float, options: AgreementOptions) -> float:
    """Distance of the cameras that random halves of the 2D-3D matches give, as a share of `distance_m`; at most one."""
    matches, structure = support.matches, support.structure
    rows = np.flatnonzero(~matches.guided)
    if not len(rows):
        rows = np.arange(len(matches))
    x_in_world = structure.x_in_world[matches.point[rows]]
    pixels = support.query.features.keypoints[matches.keypoint[rows]].astype(np.float64)

    def random_half(random: np.random.Generator) -> NDArray[np.bool_]:
        return np.asarray(random.permutation(len(rows)) % 2 == 0)

    return _median_disagreement(support.query.camera, x_in_world, pixels, random_half, distance_m, options)


def disagreement_of_references(support: Support, votes: Votes, distance_m: float, options: AgreementOptions) -> float:
    """The same for the matches with one half of the references and with the other.

    The halves have about as many matches each; of several matches of a keypoint within a half the first counts.
    """
    counts = np.bincount(votes.reference, minlength=len(support.references))

    def half_of_the_references(random: np.random.Generator) -> NDArray[np.bool_]:
        order = np.argsort(-counts * (1 + options.shuffling * random.random(len(counts))), kind="stable")
        in_first, totals = np.zeros(len(counts), bool), [0, 0]
        for reference in order:
            in_first[reference] = totals[0] <= totals[1]
            totals[0 if in_first[reference] else 1] += counts[reference]
        return np.asarray(in_first[votes.reference])

    camera, key = support.query.camera, votes.keypoint
    return _median_disagreement(
        camera, votes.x_in_world, votes.pixels, half_of_the_references, distance_m, options, key
    )


def _median_disagreement(
    camera: Camera,
    x_in_world: Array,
    pixels: Array,
    draw_half: Callable[[np.random.Generator], NDArray[np.bool_]],
    distance_m: float,
    options: AgreementOptions,
    keypoint: NDArray[np.intp] | None = None,
) -> float:
    """Median over the splits of the distance of the two halves' cameras, as a share of `distance_m`; at most one."""
    random, apart = np.random.default_rng(0), []
    for _ in range(options.splits):
        in_first = draw_half(random)
        centres = []
        for rows in (np.flatnonzero(in_first), np.flatnonzero(~in_first)):
            if keypoint is not None:
                rows = rows[np.unique(keypoint[rows], return_index=True)[1]]
            pose = ransac(camera, x_in_world[rows], pixels[rows], None, options.pnp) if len(rows) >= 4 else None
            centres.append(None if pose is None else pose.translation)
        first, second = centres
        apart.append(NO_AGREEMENT if first is None or second is None else math.dist(first, second) / distance_m)
    return min(NO_AGREEMENT, float(np.median(apart)))
