"""Which photographs are placed: their poses, cameras and accuracy, and why others are not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mapless import Accuracy
from mapless.geometry import Array, Camera, RigidTransform
from mapless.provenance import Provenance
from mapless_tools.progress import Progress
from mapless_tools.reconstruct.cameras import from_colmap
from mapless_tools.reconstruct.mapping import FEWEST_MATCHES, matches_reason
from mapless_tools.reconstruct.pictures import Omitted

from .accuracy import Factors, accuracy_of, measured_factors
from .model import (
    SAME_CAMERA_COST,
    Estimate,
    Fixed,
    adjusted,
    depths_of,
    pose_of,
    posed_images,
    references_seen,
    with_camera,
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
    """Photographs that fit a scene, those that do not, each with the reason, and how radii were measured."""

    placed: tuple[Placed, ...]
    omitted: tuple[Omitted, ...]
    factors: Factors | None


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
    model, fixed, estimates = _with_cameras(model, fixed, threads)
    new = [it for it in posed_images(model) if it.name not in fixed.poses]
    known = [it for it in posed_images(model) if it.name in fixed.poses]
    subjects = [it.name for it in known if it.num_points3D >= options.least_observations]
    factors = measured_factors(model, fixed, subjects, threads, progress) if new else None
    placed, refused = [], {}
    for image in new:
        estimate, reason = estimates.get(image.name), _doubt(database, model, image, pairs, options)
        if estimate is None or factors is None or reason:
            refused[image.name] = reason or _UNDETERMINED
            continue
        accuracy = accuracy_of(estimate, factors, references_seen(model, image, [*fixed.poses]), provenances)
        share = accuracy.position_95_m / float(np.median(depths_of(model, image)))
        if not share <= options.largest_radius:
            refused[image.name] = _UNCERTAIN.format(share=100 * share)
            continue
        camera = from_colmap(model.cameras[image.camera_id])
        placed.append(Placed(image.name, camera, estimate.world_from_camera, accuracy, image.num_points3D))
    left_out = _left_out(database, model, fixed, pairs)
    return Placement(tuple(placed), tuple(Omitted(*it) for it in (left_out | refused).items()), factors)


_UNDETERMINED = "its matches do not determine a pose"
_UNCERTAIN = "its position is known to {share:.0f} % of the distance to what it shows only: too little for a reference"


def _with_cameras(
    model: pycolmap.Reconstruction, fixed: Fixed, threads: int
) -> tuple[pycolmap.Reconstruction, Fixed, dict[str, Estimate]]:
    """The adjusted model, in which cameras that are the references' by all that matches show are fixed, too."""
    best, estimates, cost = adjusted(with_free_lenses(model, fixed), fixed, threads)
    for camera_id, like in _alike(model, fixed).items():
        same = Fixed(fixed.poses, fixed.cameras | {camera_id})
        other, its_estimates, its_cost = adjusted(with_camera(best, camera_id, like), same, threads)
        if its_cost <= SAME_CAMERA_COST * cost:
            best, estimates, fixed = other, its_estimates, same
    return best, fixed, estimates


def _alike(model: pycolmap.Reconstruction, fixed: Fixed) -> dict[int, pycolmap.Camera]:
    """For each unknown camera that of most references with photographs of its size, if there is one."""
    counts: dict[int, int] = {}
    for image in posed_images(model):
        if image.name in fixed.poses:
            counts[image.camera_id] = counts.get(image.camera_id, 0) + 1
    found = {}
    for camera_id in sorted(set(model.cameras) - fixed.cameras):
        size = model.cameras[camera_id].width, model.cameras[camera_id].height
        same = [it for it in counts if (model.cameras[it].width, model.cameras[it].height) == size]
        if same:
            found[camera_id] = model.cameras[max(same, key=lambda it: counts[it])]
    return found


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


def _left_out(
    database: Path, model: pycolmap.Reconstruction, fixed: Fixed, pairs: Mapping[str, Mapping[str, int]]
) -> dict[str, str]:
    """The photographs without a pose in a model, with the reasons."""
    posed = {it.name for it in posed_images(model)}
    return {
        name: matches_reason(max((count for other, count in others.items() if other in posed), default=0))
        for name, others in pairs.items()
        if name not in posed
    }
