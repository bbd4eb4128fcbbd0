"""Scale, structure and matching on the device of a network's output: one upload, one download, no synchronization.

Input that does not depend on the network is prepared on the host while the network runs. `compute` then only launches
work: it reads no value, so that rejections too are numbers until they are fetched. The equations are those of the host
(see `arrays`), in float64; the results are those of the host's stages.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera

from ..coarse.device import DeviceReconstruction
from ..correspond import Correspondences
from ..rejection import Rejection, RejectionReason
from ..results import KeypointNoise, MetricScale, PointMatches, Structure
from ..scale import check_references, judge, not_finite
from ..scale_equations import gather
from ..structure import StructureOptions, tracks_of
from ..tracks import Tracks
from ..views import PosedView, View, map_cells
from .compute import Inputs, Options, Outputs, Points, compute
from .match import prepare_match
from .structure import prepare_structure
from .transfer import fetch, upload

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Refined:
    """The results of the three stages.

    Attributes:
        scale: the metric scale with the initial pose.
        structure: the points; None without options of structure.
        matches: matches of the query with the structure; None without options of matches.
    """

    scale: MetricScale
    structure: Structure | None
    matches: PointMatches | None


def launch_on_device(
    reconstruction: DeviceReconstruction,
    query: View,
    references: Sequence[PosedView],
    correspondences: Correspondences,
    options: Options,
) -> Callable[[], Refined | Rejection]:
    """Launches the stages scale, structure and match on the device of the reconstruction, without waiting.

    So all queries of a batch are prepared and launched while the network still computes. Without options of structure
    and matches, only the scale is computed. Returns a function that waits for the results, which are those of
    estimate_scale, build_structure and match_points. A network output that is not finite is rejected with
    SCALE_UNRELIABLE and a warning in the log, both naming the backend. ValueError if the reconstruction, whose
    references are in the same order, has another number of them.
    """
    if len(reconstruction.reference_cameras) != len(references):
        raise ValueError(f"{len(reconstruction.reference_cameras)} reconstructed references of {len(references)}")
    rejection = check_references(references, options.scale)
    if rejection is not None:
        return lambda: rejection
    prepared = prepare(reconstruction.reference_cameras, query, references, correspondences, options)
    uploaded = upload(prepared.inputs, reconstruction.point_maps.device)
    launched = compute(reconstruction, uploaded, query.camera, options)
    return lambda: _judged(fetch(launched), prepared, reconstruction, query, options)


def _judged(
    outputs: Outputs, prepared: "HostInputs", reconstruction: DeviceReconstruction, query: View, options: Options
) -> Refined | Rejection:
    reference_count = len(reconstruction.reference_cameras)
    broken = _not_finite(outputs, reference_count)
    if broken:
        message = f"{reconstruction.backend}: {broken}"
        log.warning("%s", message)
        return Rejection(RejectionReason.SCALE_UNRELIABLE, message)
    scale = judge(outputs.candidates, reference_count, options.scale)
    if isinstance(scale, Rejection):
        return scale
    if outputs.points is None or options.structure is None or options.match is None:
        return Refined(scale, None, None)
    structure = _structure(outputs.points, prepared, options.structure)
    return Refined(scale, structure, _matches(outputs.points, len(query.features), options.match.radius_px))


@dataclass(frozen=True, eq=False)
class HostInputs:
    """Input prepared on the host while the network runs.

    Attributes:
        inputs: the arrays to upload.
        tracks: tracks of the points.
        row: (O,) index of each observation of the tracks among the rows (P, L) on the device.
    """

    inputs: Inputs
    tracks: Tracks
    row: NDArray[np.intp]


def prepare(
    map_cameras: Sequence[Camera],
    query: View,
    references: Sequence[PosedView],
    correspondences: Correspondences,
    options: Options,
) -> HostInputs:
    """Prepares all inputs that do not depend on the network; `map_cameras` are those of the references' maps."""
    known, cell = gather(references, correspondences, options.scale), _cells(map_cameras, references)
    nothing = np.empty(0, np.intp)
    if options.structure is None or options.match is None:
        return HostInputs(Inputs(known, cell, None, None), Tracks(nothing, nothing, nothing), nothing)
    tracks = tracks_of(references, correspondences, options.structure)
    structure, row = prepare_structure(tracks, references)
    match = prepare_match(query, references, correspondences, structure.keypoint, options.match)
    return HostInputs(Inputs(known, cell, structure, match), tracks, row)


def _cells(map_cameras: Sequence[Camera], references: Sequence[PosedView]) -> NDArray[np.intp]:
    cells = []
    for index, (camera, reference) in enumerate(zip(map_cameras, references, strict=True)):
        rows, columns, inside = map_cells(camera, reference.view.features.keypoints, reference.view.camera)
        cells.append(np.where(inside, (index * camera.height_px + rows) * camera.width_px + columns, -1))
    return np.concatenate(cells)


def _not_finite(outputs: Outputs, reference_count: int) -> str | None:
    """Says in one sentence which part of the network's output is not finite; None if all of it is finite."""
    of_poses = not_finite(outputs.candidates, reference_count)
    if of_poses is None and outputs.broken_pixels:
        return f"{outputs.broken_pixels:.0f} predicted pixels are not finite"
    return of_poses


def _structure(points: Points, prepared: HostInputs, options: StructureOptions) -> Structure:
    """Makes the structure of the points and tracks that are kept."""
    seen = points.seen.astype(bool)
    keep, rows = seen.any(axis=1), seen.reshape(-1)[prepared.row]
    renumbered, tracks = np.cumsum(keep) - 1, prepared.tracks
    tracks = Tracks(renumbered[tracks.point[rows]], tracks.view[rows], tracks.keypoint[rows])
    noise = KeypointNoise(float(points.noise_level_px), options.first_noise.slope)
    return Structure(points.x_in_world[keep], tracks, noise)


def _matches(points: Points, keypoint_count: int, radius_px: float) -> PointMatches:
    """The matches in the order of match_points: by votes, then by guided search, each in the order of points."""
    keep = points.seen.any(axis=1)
    keypoint, guided = points.keypoint[keep].astype(np.intp), points.guided[keep].astype(bool)
    order = np.argsort(guided, kind="stable")
    order = order[keypoint[order] < keypoint_count]
    return PointMatches(order, keypoint[order], guided[order], radius_px)
