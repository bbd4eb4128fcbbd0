"""The coarse stage without a network: the default on a machine without a GPU or weights.

Features matched among the references are triangulated from the references' known poses, or have depths, and the query
is posed by PnP on its matches with these points. That is metric: `Variant.BEST` needs no further scale and structure.
For the paper's variants the sparse points are scattered into point maps, in a local frame with a scale of its own, like
a network's.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, Similarity

from ..bundle.priors import NO_PRIORS, Priors
from ..features.views import PosedView, ReconstructedView, Reconstruction, View, map_cells
from ..pairs.correspond import Correspondences
from ..pose.pnp import MIN_MATCHES, PnpOptions, gate_failure, ransac
from ..pose.with_priors import informed_pose
from ..rejection import Rejection, RejectionReason
from ..structure.kept_depth import with_kept_depths
from ..structure.match import vote
from ..structure.model import PointMatches, Structure
from ..structure.structure import StructureOptions, triangulated_structure
from . import Outcome, Request, Triangulation
from .scale import unit_frame

CELL_PX = 2
"""Side of a cell of the point maps, pixels of the view; so small that two keypoints seldom share a cell."""


MIN_BASELINE_M = 0.02
"""Least distance of the farthest reference from the mean of all; below it, nothing is triangulated."""

STRUCTURE, PNP = StructureOptions(), PnpOptions()
"""Options as of the later stages."""


@dataclass(frozen=True)
class GeometricReconstructor:
    """A `Reconstructor` by triangulation and PnP; see the module."""

    name: str = "geometric"
    weights_sha256: str = ""
    uses_correspondences: bool = True
    is_batched: bool = False

    def close(self) -> None:
        """Nothing to release."""

    def bucket(self, query: View, references: Sequence[PosedView]) -> str:
        """See Reconstructor.bucket."""
        return f"{self.name}-{len(references)}"

    def reconstruct_many(self, requests: Sequence[Request]) -> "list[Outcome | Exception]":
        """See Reconstructor.reconstruct_many; requests are computed one after the other."""
        return [self._attempt(request) for request in requests]

    def _attempt(self, request: Request) -> "Outcome | Exception":
        try:
            return self._reconstruct(request)
        except Exception as error:  # an error of one request does not fail the others
            return error

    def _reconstruct(self, request: Request) -> Triangulation | Rejection:
        references, correspondences = request.references, request.correspondences
        if correspondences is None:
            raise ValueError(f"{self.name} reconstructs from correspondences, and there are none")
        has_depths = any(it.depths is not None for it in references)
        if not has_depths and (rejection := _check(references)):
            return rejection
        structure = triangulated_structure(references, correspondences, STRUCTURE)
        if has_depths:
            structure = with_kept_depths(structure, references, correspondences)
        if not len(structure.x_in_world):
            message = "the references share no points that could be triangulated"
            return Rejection(RejectionReason.NO_USABLE_REFERENCES, message)
        return self._posed(request, structure, correspondences)

    def _posed(
        self, request: Request, structure: Structure, correspondences: Correspondences
    ) -> Triangulation | Rejection:
        query, references = request.query, request.references
        matches = vote(structure, [len(r.view.features) for r in references], correspondences)
        seen, priors = matches.seen(query, structure.x_in_world), request.priors
        enough = len(matches) >= MIN_MATCHES
        pose = ransac(seen, None, PNP) if enough else None
        rejection, inliers = self._judge(query, structure, matches, pose, NO_PRIORS)
        without_priors = rejection
        if rejection and enough and priors:
            informed = informed_pose(seen, pose, priors, PNP.inlier_px)
            pose = informed.world_from_camera if informed else None
            rejection, inliers = self._judge(query, structure, matches, pose, priors)
        if rejection:
            known = priors.pose
            if known is None:
                return rejection
            # With too few matches here, the pose prior is the initial pose from which more are searched.
            pose, inliers = known.world_from_camera, np.zeros(len(matches), bool)
        assert pose is not None
        return Triangulation(structure, pose, matches.point[inliers], matches.keypoint[inliers], without_priors)

    def _judge(
        self, query: View, structure: Structure, matches: PointMatches, pose: RigidTransform | None, priors: Priors
    ) -> tuple[Rejection | None, NDArray[np.bool_]]:
        """Returns the reason to reject the pose, if any, and which of the matches (M,) are its inliers."""
        inliers, named = np.zeros(len(matches), bool), "matches with the references' points"
        count = f"{len(matches)} of {len(structure.x_in_world)} points"
        failure: str | None = f"the photograph matches {count} of the references"
        if pose is not None:
            inliers = matches.seen(query, structure.x_in_world).errors_px(pose) < PNP.inlier_px
            chance = priors.log10_chance(pose)
            failure = gate_failure(query.camera, matches, inliers, PNP.inlier_px, chance, named=named)
        return Rejection(RejectionReason.LOW_OVERLAP, failure, tried=len(matches)) if failure else None, inliers


def _check(references: Sequence[PosedView]) -> Rejection | None:
    """Rejects references from which no depth can be triangulated."""
    count = len(references)
    if count < 2:
        return Rejection(RejectionReason.NO_USABLE_REFERENCES, f"{count} reference, at least 2 are needed for depth")
    centres = np.stack([r.world_from_camera.translation for r in references])
    extent_m = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    if extent_m < MIN_BASELINE_M:
        message = f"all {count} references stand within {extent_m:.3f} m: without a baseline there is no scale"
        return Rejection(RejectionReason.DEGENERATE_REFERENCES, message)
    return None


def point_maps(triangulation: Triangulation, query: View, references: Sequence[PosedView]) -> Reconstruction:
    """Makes point maps in the frame of the first reference, scaled so that the median point is one unit away."""
    structure = triangulation.structure
    local_from_world = unit_frame(references[0].world_from_camera, structure.x_in_world).inverse()
    tracks = structure.tracks
    views = []
    for index, reference in enumerate(references):
        seen = tracks.view == index
        points, keypoints = structure.x_in_world[tracks.point[seen]], tracks.keypoint[seen]
        views.append(_map(reference.view, reference.world_from_camera, local_from_world, points, keypoints))
    points = structure.x_in_world[triangulation.point]
    pose, keypoints = triangulation.world_from_query, triangulation.keypoint
    return Reconstruction(_map(query, pose, local_from_world, points, keypoints), tuple(views))


def _map(
    view: View,
    world_from_camera: RigidTransform,
    local_from_world: Similarity,
    points: Array,
    keypoints: NDArray[np.intp],
) -> ReconstructedView:
    shape = (-(-view.camera.height_px // CELL_PX), -(-view.camera.width_px // CELL_PX))
    maps = ReconstructedView(
        view.camera.resized(shape[1], shape[0]),
        np.full((*shape, 3), np.nan, np.float32),
        np.zeros(shape, np.float32),
        local_from_world.transform_pose(world_from_camera),
    )
    pixels = view.features.pixels(keypoints)
    rows, columns, inside = map_cells(maps.camera, pixels, view.camera)
    x_in_camera = world_from_camera.inverse().apply(points[inside])
    maps.point_map[rows[inside], columns[inside]] = local_from_world.scale * x_in_camera
    maps.confidence[rows[inside], columns[inside]] = 1.0
    return maps
