"""What is computed on the device, from the network's output to all that the host needs, without looking at a value."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mapless.geometry import Camera

from ..arrays import AnyArray
from ..coarse.device import DeviceReconstruction
from ..match import MatchOptions
from ..observations import back_project
from ..scale_equations import Known, Predicted, ScaleCandidates, ScaleOptions, scale_candidates
from ..structure import StructureOptions, refine_points
from ..tracks import positive
from .match import DevicePoints, MatchInputs, match_on_device
from .structure import DeviceTracks, StructureInputs, observe_on_device


@dataclass(frozen=True, eq=False)
class Options:
    """Options of the three stages; without structure there are no matches either."""

    scale: ScaleOptions
    structure: StructureOptions | None
    match: MatchOptions | None


@dataclass(frozen=True, eq=False)
class Inputs:
    """What is computed with beside the reconstruction.

    Attributes:
        known: of the references.
        cell: (N,) where their keypoints lie in the maps, counted through all maps; -1 outside.
        structure, match: None if they are not asked for.
    """

    known: Known
    cell: AnyArray
    structure: StructureInputs | None
    match: MatchInputs | None


@dataclass(frozen=True, eq=False)
class Points:
    """Structure and matches, before anything is taken out.

    Attributes:
        x_in_world: (P, 3) metres.
        noise_level_px: of the keypoints.
        seen: (P, L) observations that are left, of points to keep.
        keypoint: (P,) of the query; Q for a point without.
        guided: (P,) see PointMatches.
    """

    x_in_world: AnyArray
    noise_level_px: AnyArray
    seen: AnyArray
    keypoint: AnyArray
    guided: AnyArray


@dataclass(frozen=True, eq=False)
class Outputs:
    """What the host needs.

    Attributes:
        broken_pixels: see DeviceReconstruction.
        candidates: of the scale.
        points: None if they were not asked for.
    """

    broken_pixels: AnyArray
    candidates: ScaleCandidates
    points: Points | None


def compute(reconstruction: DeviceReconstruction, inputs: Inputs, query_camera: Camera, options: Options) -> Outputs:
    """Scale, structure and matches.

    Args:
        reconstruction: query and references up to scale.
        inputs: on its device.
        query_camera: in the pixels of the query's keypoints.
        options: of the stages.
    """
    predicted = _predict(reconstruction, inputs.cell)
    candidates = scale_candidates(inputs.known, predicted, options.scale)
    broken_pixels = reconstruction.broken_pixels()
    if not (inputs.structure and inputs.match and options.structure and options.match):
        return Outputs(broken_pixels, candidates, None)

    prepared = inputs.structure
    depth_m = candidates.metres_per_unit * predicted.depth[prepared.keypoint[:, 0]]
    start = back_project(prepared.first_centre, prepared.first_ray, depth_m)
    refined = refine_points(observe_on_device(prepared, options.structure.first_noise), start, options.structure)
    tracks = refined.observations.tracks
    assert isinstance(tracks, DeviceTracks)
    points = DevicePoints(refined.x_in_world, prepared.keypoint, tracks.seen & refined.trusted[:, None])
    keypoint, guided = match_on_device(
        inputs.match, points, candidates.query_rotation, candidates.query_centre, query_camera, options.match
    )
    level_px = refined.noise.level_px * torch.ones_like(candidates.metres_per_unit)
    return Outputs(broken_pixels, candidates, Points(points.x_in_world, level_px, points.seen, keypoint, guided))


def _predict(reconstruction: DeviceReconstruction, cell: Tensor) -> Predicted:
    """See scale_equations.predict."""
    depth = reconstruction.point_maps.reshape(-1, 3)[:, 2][cell.clip(0)]
    local_from_camera = reconstruction.local_from_camera.double()
    return Predicted(
        local_from_camera[:, :3, :3],
        local_from_camera[:, :3, 3],
        positive(torch.where(cell >= 0, depth, torch.nan).double()),
        reconstruction.confidence.nansum((1, 2), dtype=torch.float64),
    )
