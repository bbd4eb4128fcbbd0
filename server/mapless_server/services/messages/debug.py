"""Message of a pose's support: pixels of the photographs as they were sent, points in the scene's world.

The method works on reduced photographs without distortion. A pixel is converted to a ray by the camera of the reduced
photograph, and to a pixel by the camera that was sent: that undoes the reduction and distorts again in one step.
"""

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, normalize
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.method.bundle.estimate import PosedSupport, Support
from mapless_server.method.features.views import DepthSource, PosedView, View
from mapless_server.method.structure.model import MetricScale, ScaleStage

MAX_MATCHES = 2000
"""About 100 KB of message, and more than can be seen in a picture."""


def debug_to_message(support: Support, scale: MetricScale | None = None) -> pb.Debug:
    """Message of a support's matches, of an answer with this scale.

    If there are too many, inliers are preferred and sampled evenly.
    """
    matches = support.matches
    inlier, error_px = np.zeros(len(matches), bool), np.full(len(matches), np.nan)
    if isinstance(support, PosedSupport):
        inlier, error_px = support.estimate.inliers, support.estimate.errors_px
    chosen = _chosen(inlier)
    point = matches.point[chosen]
    query_px = sent_pixels(support.query, support.query.features.keypoints[matches.keypoint[chosen]])
    x_in_world = support.structure.x_in_world[point] + support.origin
    reference, reference_px = _best_observations(support, point)
    return pb.Debug(
        query_x_px=query_px[:, 0].tolist(),
        query_y_px=query_px[:, 1].tolist(),
        point_x_m=x_in_world[:, 0].tolist(),
        point_y_m=x_in_world[:, 1].tolist(),
        point_z_m=x_in_world[:, 2].tolist(),
        is_inlier=inlier[chosen].tolist(),
        error_px=error_px[chosen].tolist(),
        reference=reference.tolist(),
        reference_x_px=reference_px[:, 0].tolist(),
        reference_y_px=reference_px[:, 1].tolist(),
        source=_sources(support, scale)[point].tolist(),
    )


def sent_pixels(view: View, pixels: NDArray[np.floating]) -> Array:
    """Converts pixels (N, 2) of a view to pixels (N, 2) of the photograph as it was sent."""
    if view.photograph is None:
        return np.asarray(pixels, np.float64)
    return view.photograph.camera.project(view.camera.rays(pixels))


def _chosen(inlier: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Indices of the matches to report, ascending."""
    inliers, others = np.flatnonzero(inlier), np.flatnonzero(~inlier)
    inliers = _thinned(inliers, MAX_MATCHES)
    return np.sort(np.concatenate([inliers, _thinned(others, MAX_MATCHES - len(inliers))]))


def _thinned(rows: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    if len(rows) <= count:
        return rows
    return rows[np.linspace(0, len(rows) - 1, count).round().astype(np.intp)]


def _sources(support: Support, scale: MetricScale | None) -> NDArray[np.int32]:
    """The source (P,) of each point of the structure, of `pb.PointSource`."""
    structure, count = support.structure, len(support.structure.x_in_world)
    sources = np.full(count, pb.POINT_SOURCE_TRIANGULATED, np.int32)
    is_single = np.bincount(structure.tracks.point, minlength=count) == 1
    of_reference = np.array([_source_of(it, scale) for it in support.references], np.int32)
    of_reference = of_reference[structure.tracks.view[structure.tracks.starts]]
    is_all_by_depth = bool(is_single.all())  # as `solve_by_depths` has it
    has_plane = is_all_by_depth if structure.planes is None else structure.planes.information > 0
    by_reference = is_single & has_plane
    sources[by_reference] = of_reference[by_reference]
    if is_all_by_depth and support.query.depths is not None:
        sources[~by_reference] = pb.POINT_SOURCE_PHOTOGRAPH_DEPTH
    return sources


def _source_of(reference: PosedView, scale: MetricScale | None) -> int:
    """The source of the points at a reference's depths."""
    if scale is not None and scale.stage is ScaleStage.NETWORK:
        return pb.POINT_SOURCE_NETWORK_DEPTH
    if reference.depths is None:
        return pb.POINT_SOURCE_TRIANGULATED
    is_measured = reference.depths.source is DepthSource.MEASURED
    return pb.POINT_SOURCE_MEASURED_DEPTH if is_measured else pb.POINT_SOURCE_KEPT_DEPTH


def _best_observations(support: Support, points: NDArray[np.intp]) -> tuple[NDArray[np.intp], Array]:
    """For each point, the reference whose keypoint is nearest to its projection, and that keypoint as sent."""
    tracks, x_in_world = support.structure.tracks, support.structure.x_in_world
    error_px = np.full(len(tracks.point), np.inf)
    pixels = np.zeros((len(tracks.point), 2))
    for number, reference in enumerate(support.references):
        rows = np.flatnonzero(tracks.view == number)
        camera, keypoints = reference.view.camera, reference.view.features.keypoints[tracks.keypoint[rows]]
        x_in_camera = reference.world_from_camera.inverse().apply(x_in_world[tracks.point[rows]])
        offsets = normalize(x_in_camera) - camera.rays(keypoints)[:, :2]
        error_px[rows] = np.nan_to_num(
            np.linalg.norm(offsets * (camera.focal_x_px, camera.focal_y_px), axis=1), nan=np.inf
        )
        pixels[rows] = sent_pixels(reference.view, keypoints)
    # Sorted by point, then error: the first row of each point is its best.
    order = np.lexsort((error_px, tracks.point))
    best = order[tracks.starts[points]] if len(points) else np.empty(0, np.intp)
    return tracks.view[best], pixels[best]
