"""The computation on the device, from the network's output to the results for the host, without reading a value."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from mapless.geometry import Camera

from ..arrays import AnyArray
from ..coarse.device import DeviceReconstruction
from ..match import MatchOptions
from ..observations import back_project
from ..scale_equations import Known, Predicted, ScaleCandidates, ScaleOptions, scale_candidates
from ..structure import StructureOptions, first_points, refine_points
from ..tracks import positive
from .match import DevicePoints, MatchInputs, match_on_device
from .structure import DeviceTracks, StructureInputs, observe_on_device


@dataclass(frozen=True, eq=False)
class Options:
    """Options of the three stages; structure and matches are computed both or not at all."""

    scale: ScaleOptions = field(default_factory=ScaleOptions)
    structure: StructureOptions | None = None
    match: MatchOptions | None = None

    def __post_init__(self) -> None:
        if (self.structure is None) != (self.match is None):
            raise ValueError("Options.structure and Options.match must both be given, or neither")


@dataclass(frozen=True, eq=False)
class Inputs:
    """The input without the reconstruction.

    Attributes:
        known: known values of the references.
        cell: (N,) index of each of their keypoints in the pixels of all maps; -1 outside.
        structure, match: None without options of these stages.
    """

    known: Known
    cell: AnyArray
    structure: StructureInputs | None
    match: MatchInputs | None


@dataclass(frozen=True, eq=False)
class Points:
    """Structure and matches, before points are removed.

    Attributes:
        x_in_world: (P, 3) metres.
        noise_level_px: level of the keypoints' noise.
        seen: (P, L) which rows are observations of a point that is kept.
        keypoint: (P,) keypoint of the query; Q for a point without a match.
        guided: (P,) see PointMatches.
    """

    x_in_world: AnyArray
    noise_level_px: AnyArray
    seen: AnyArray
    keypoint: AnyArray
    guided: AnyArray


@dataclass(frozen=True, eq=False)
class Outputs:
    """The results for the host.

    Attributes:
        broken_pixels: see DeviceReconstruction.
        candidates: candidates of the scale.
        points: structure and matches; None without their options.
    """

    broken_pixels: AnyArray
    candidates: ScaleCandidates
    points: Points | None


def compute(reconstruction: DeviceReconstruction, inputs: Inputs, query_camera: Camera, options: Options) -> Outputs:
    """Computes scale, structure and matches, with all inputs on the device of the reconstruction.

    The query's camera is in the pixels of its keypoints.
    """
    predicted = _predict(reconstruction, inputs.cell)
    candidates = scale_candidates(inputs.known, predicted, options.scale)
    broken_pixels = reconstruction.broken_pixels()
    if not (inputs.structure and inputs.match and options.structure and options.match):
        return Outputs(broken_pixels, candidates, None)

    prepared = inputs.structure
    depth_m = candidates.metres_per_unit * predicted.depth[prepared.keypoint[:, 0]]
    observations = observe_on_device(prepared, options.structure.first_noise)
    predicted_points = back_project(prepared.first_centre, prepared.first_ray, depth_m)
    start = first_points(observations, predicted_points, options.structure)
    refined = refine_points(observations, start, options.structure)
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
