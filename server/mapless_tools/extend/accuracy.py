"""The accuracy of placed photographs: by residuals, and by the scene's own references, which are placed as well.

Keypoints are not all that is wrong: references have errors of their own, and a lens is not quite as it is modelled. So
some of the references are placed as if their poses were not known, and compared with these. The ratio of errors to
radii is that of the new photographs, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from mapless import Accuracy
from mapless.geometry import RigidTransform, rotation_angle_deg
from mapless.provenance import RADII, Provenance
from mapless_server.method.bundle.estimate import accuracy_from_covariance
from mapless_tools.progress import Progress, tracked

from .model import Estimate, Fixed, adjusted, posed_images, with_free_lenses, without

FOLDS = 3
"""Groups of references, one of which is placed by the others at a time."""
MOST = 24
"""References that are placed, at most."""
USUAL_POSITION, USUAL_ROTATION, USUAL_COUNT = 3.0, 8.0, 4
"""Factors where there are no references to measure them by, and how many of these weigh as much: of five scenes the
factors were 1 to 8 and 2 to 23."""
FEWEST_LEFT = 2
"""References that stay fixed."""


@dataclass(frozen=True)
class Factors:
    """Ratios of errors to the radii of 68 % that follow from residuals, and the number of references measured."""

    position: float
    rotation: float
    count: int


def measured_factors(
    model: pycolmap.Reconstruction,
    fixed: Fixed,
    names: Sequence[str],
    unknown_cameras: bool,
    threads: int,
    progress: Progress,
) -> Factors:
    """Places references of these names, group by group, by all others, and compares.

    Each reference has a camera of its own in the model; with `unknown_cameras`, they are estimated with the poses.
    """
    names = names[:: max(1, -(-len(names) // MOST))]
    groups = [names[i::FOLDS] for i in range(FOLDS)]
    groups = [it for it in groups if it and len(fixed.poses) - len(it) >= FEWEST_LEFT]
    cameras = {it.name: it.camera_id for it in posed_images(model)}
    ratios = []
    for group in tracked("accuracy", groups, len(groups), progress):
        ids = [cameras[it] for it in group] if unknown_cameras else []
        _, estimates = adjusted(with_free_lenses(model, ids), without(fixed, group, ids), threads)
        ratios += [_ratios(estimates[it], fixed.poses[it]) for it in group if it in estimates]
    return _factors(ratios)


def _ratios(estimate: Estimate, given: RigidTransform) -> tuple[float, float]:
    radii = accuracy_from_covariance(estimate.covariance)
    off = float(np.linalg.norm(estimate.world_from_camera.translation - given.translation))
    turned_deg = rotation_angle_deg(estimate.world_from_camera.rotation.T @ given.rotation)
    return off / radii.position_68_m, turned_deg / radii.rotation_68_deg


def _factors(ratios: Sequence[tuple[float, float]]) -> Factors:
    """Factors that 68 % of the ratios of position and rotation do not exceed, with what is usual."""
    count = len(ratios)
    found = np.quantile(np.array(ratios), 0.68, axis=0) if count else np.zeros(2)
    usual = np.array([USUAL_POSITION, USUAL_ROTATION])
    mixed = np.sqrt((count * found**2 + USUAL_COUNT * usual**2) / (count + USUAL_COUNT))
    return Factors(float(mixed[0]), float(mixed[1]), count)


def accuracy_of(
    estimate: Estimate, factors: Factors, observed: Mapping[str, int], provenances: Mapping[str, Provenance]
) -> Accuracy:
    """Radii of a placed photograph that shares so many points with each reference.

    Where these have an accuracy themselves, as those that were placed before, its mean square is added: over the shared
    points, or over all references if it shares none, as a photograph that was placed by other new ones.
    """
    scale = np.diag([factors.position] * 3 + [factors.rotation] * 3)
    own = accuracy_from_covariance(scale @ estimate.covariance @ scale)
    weights = observed if any(observed.values()) else dict.fromkeys(observed, 1)
    total = sum(weights.values())
    squares = np.zeros(4)
    for name, weight in weights.items():
        known = provenances[name].accuracy
        if known is not None:
            squares += weight / total * np.square([getattr(known, it) for it in RADII])
    radii = [math.hypot(radius, math.sqrt(square)) for radius, square in zip(vars(own).values(), squares, strict=True)]
    position_68_m, position_95_m, rotation_68_deg, rotation_95_deg = radii
    return Accuracy(position_68_m, position_95_m, rotation_68_deg, rotation_95_deg)
