"""Placed photographs: their poses, cameras and accuracy, and why others are not placed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mapless import Accuracy
from mapless.geometry import Array, Camera, RigidTransform
from mapless.provenance import LARGEST_DEG, LARGEST_M, Provenance
from mapless_tools.progress import Progress
from mapless_tools.reconstruct.cameras import from_colmap
from mapless_tools.reconstruct.mapping import FEWEST_MATCHES, matches_reason
from mapless_tools.reconstruct.pictures import Omitted

from .accuracy import Factors, accuracy_of, measured_factors
from .model import (
    Fixed,
    adjusted,
    depths_of,
    pose_of,
    posed_images,
    references_seen,
    with_free_lenses,
)
from .options import ExtendOptions

AGREEING_PX = 8.0
"""Largest median distance from epipolar lines of matches that two poses fit, in pixels at a side of 1024."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A photograph with its pose in the scene, its camera, and how accurate the pose is."""

    name: str
    camera: Camera
    world_from_camera: RigidTransform
    accuracy: Accuracy
    observations: int


@dataclass(frozen=True, eq=False)
class Placement:
    """Photographs that fit a scene, those that do not, each with the reason, and how radii were measured.

    That is for photographs with known cameras (False) and with unknown ones (True), as far as there are any.
    """

    placed: tuple[Placed, ...]
    omitted: tuple[Omitted, ...]
    factors: Mapping[bool, Factors] = field(default_factory=dict)


def place(
    database: Path,
    model: pycolmap.Reconstruction,
    fixed: Fixed,
    provenances: Mapping[str, Provenance],
    options: ExtendOptions,
    threads: int,
    progress: Progress,
) -> Placement:
    """Adjusts a model, measures how accurate it is, and judges its photographs whose poses are not fixed."""
    pairs = _verified_pairs(database)
    refused = _left_out(model, pairs)
    known = [it for it in posed_images(model) if it.name in fixed.poses]
    if len(known) == len(list(posed_images(model))):
        return Placement((), tuple(Omitted(*it) for it in refused.items()))
    unknown = {it.camera_id for it in posed_images(model)} - fixed.cameras
    model = with_free_lenses(model, unknown)
    subjects = [it.name for it in known if it.num_points3D >= options.least_observations]
    kinds = {it.camera_id in unknown for it in posed_images(model) if it.name not in fixed.poses}
    factors = {it: measured_factors(model, fixed, subjects, it, threads, progress) for it in sorted(kinds)}
    model, estimates = adjusted(model, fixed, threads)
    placed = []
    for image in [it for it in posed_images(model) if it.name not in fixed.poses]:
        estimate, reason = estimates.get(image.name), _doubt(database, model, image, pairs, options)
        if estimate is None or reason:
            refused[image.name] = reason or _UNDETERMINED
            continue
        shared = references_seen(model, image, [*fixed.poses])
        accuracy = accuracy_of(estimate, factors[image.camera_id in unknown], shared, provenances)
        if reason := _uncertainty(accuracy, float(np.median(depths_of(model, image))), options):
            refused[image.name] = reason
            continue
        camera = from_colmap(model.cameras[image.camera_id])
        placed.append(Placed(image.name, camera, estimate.world_from_camera, accuracy, image.num_points3D))
    return Placement(tuple(placed), tuple(Omitted(*it) for it in refused.items()), factors)


_UNDETERMINED = "its matches do not determine a pose"


def _uncertainty(accuracy: Accuracy, depth: float, options: ExtendOptions) -> str:
    """Why a pose is not known well enough for a reference, at the depth of what it shows; empty if it is."""
    share = accuracy.position_95_m / depth
    if not share <= options.largest_radius:
        known = f"its position is known to {100 * share:.0f} % of the distance to what it shows only"
        return f"{known}: too little for a reference"
    if accuracy.position_95_m > LARGEST_M or accuracy.rotation_95_deg > LARGEST_DEG:
        return f"its radii are above {LARGEST_M:g} units or {LARGEST_DEG:g} degrees, the most that a reference may have"
    return ""


def _verified_pairs(database: Path) -> dict[str, dict[str, int]]:
    """Numbers of matches that agree, of the pairs of photographs that share enough, by the names of both."""
    with pycolmap.Database.open(database) as content:
        names = {it.image_id: it.name for it in content.read_all_images()}
        pairs, counts = content.read_two_view_geometry_num_inliers()
    found: dict[str, dict[str, int]] = {it: {} for it in names.values()}
    for pair, count in zip(pairs, counts, strict=True):
        first, second = (names[it] for it in pycolmap.pair_id_to_image_pair(pair))
        found[first][second] = found[second][first] = count
    return found


def _doubt(
    database: Path,
    model: pycolmap.Reconstruction,
    image: pycolmap.Image,
    pairs: Mapping[str, Mapping[str, int]],
    options: ExtendOptions,
) -> str:
    """Why a photograph's pose is not believed; empty if it is."""
    if image.num_points3D < options.least_observations:
        least = options.least_observations
        return f"it sees {image.num_points3D} points of the scene: fewer than {least} confirm no pose"
    posed = {it.name: it for it in posed_images(model)}
    others = [name for name, count in pairs[image.name].items() if count >= FEWEST_MATCHES and name in posed]
    with pycolmap.Database.open(database) as content:
        agreeing = sum(_agree(content, model, image, posed[it]) for it in others)
    if agreeing < options.least_agreeing * len(others):
        return (
            f"its pose contradicts {len(others) - agreeing} of {len(others)} photographs with which it shares matches: "
            "the place may be there twice, or have changed"
        )
    return ""


def _agree(
    content: pycolmap.Database, model: pycolmap.Reconstruction, image: pycolmap.Image, other: pycolmap.Image
) -> bool:
    """Whether the matches of two photographs lie near the epipolar lines of their poses."""
    first, second = sorted((image, other), key=lambda it: it.image_id)
    matches = content.read_two_view_geometry(first.image_id, second.image_id).inlier_matches
    rays = [_rays(model, it, matches[:, side]) for side, it in enumerate((first, second))]
    second_from_first = pose_of(second).inverse().compose(pose_of(first))
    turned = rays[0] @ second_from_first.rotation.T
    normals = np.cross(second_from_first.translation, turned)
    lengths = np.linalg.norm(normals[:, :2], axis=1)
    off = np.abs((normals * rays[1]).sum(axis=1)) / np.maximum(lengths, 1e-12)
    camera = model.cameras[second.camera_id]
    return float(np.median(off)) * camera.mean_focal_length() * 1024 / max(camera.width, camera.height) <= AGREEING_PX


def _rays(model: pycolmap.Reconstruction, image: pycolmap.Image, keypoints: NDArray[np.uint32]) -> Array:
    """Rays (N, 3), at depth 1, of keypoints of a photograph."""
    pixels = np.array([image.points2D[it].xy for it in keypoints.tolist()])
    plane = np.array([model.cameras[image.camera_id].cam_from_img(it) for it in pixels])
    return np.hstack([plane, np.ones((len(plane), 1))])


def _left_out(model: pycolmap.Reconstruction, pairs: Mapping[str, Mapping[str, int]]) -> dict[str, str]:
    """The photographs without a pose in a model, with the reasons."""
    posed = {it.name for it in posed_images(model)}
    return {
        name: matches_reason(max((count for other, count in others.items() if other in posed), default=0))
        for name, others in pairs.items()
        if name not in posed
    }
