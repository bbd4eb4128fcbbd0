"""Which known points a camera should show: in its image, and seen about as a reference sees them.

A local feature is matched when it is seen from about the same direction and distance: SIFT tolerates a turn of the
surface of some tens of degrees and, in a photograph of limited size, a factor of about two in scale. A point counts as
visible if this holds for one of the references that observe it. Occlusion is not known, so the count is an upper bound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform
from mapless_server.method.options import check_bounds

from .neighbourhood import Neighbourhood


@dataclass(frozen=True)
class VisibilityOptions:
    """Options of visibility.

    Attributes:
        max_turn_deg: largest angle between the viewing rays of the camera and of a reference that observes the point.
        max_scale: largest ratio of the point's sizes in pixels in both.
    """

    max_turn_deg: float = 40.0
    max_scale: float = 2.5

    def __post_init__(self) -> None:
        check_bounds(self, "max_turn_deg", above=0, below=90)
        check_bounds(self, "max_scale", above=1)


@dataclass(frozen=True, eq=False)
class Visible:
    """Points that a camera should show.

    Attributes:
        point: (V,) indices into the structure.
        pixel: (V, 2) where.
        turn_deg: (V,) angle to the viewing ray of the most similar observation.
        scale: (V,) ratio of the point's sizes in that reference's image and here, 1 or more.
        reference: (V,) index of that reference.
    """

    point: NDArray[np.intp]
    pixel: Array
    turn_deg: Array
    scale: Array
    reference: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.point)


def visible_points(
    camera: Camera, world_from_camera: RigidTransform, neighbourhood: Neighbourhood, options: VisibilityOptions
) -> Visible:
    """The neighbourhood's points that a pinhole camera at this pose should show."""
    structure = neighbourhood.structure
    x_in_camera = world_from_camera.inverse().apply(structure.x_in_world)
    pixel = camera.project(x_in_camera)
    size = np.array([camera.width_px, camera.height_px])
    inside = np.all((pixel >= -0.5) & (pixel < size - 0.5), axis=1)

    centres = np.stack([r.world_from_camera.translation for r in neighbourhood.references])
    focals = np.array([r.view.camera.focal_x_px for r in neighbourhood.references])
    point, view = structure.tracks.point, structure.tracks.view
    theirs = structure.x_in_world[point] - centres[view]
    ours = structure.x_in_world[point] - world_from_camera.translation
    their_distance, our_distance = np.linalg.norm(theirs, axis=1), np.linalg.norm(ours, axis=1)
    cosine = (theirs * ours).sum(axis=1) / np.maximum(their_distance * our_distance, 1e-12)
    turn_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    ratio = (camera.focal_x_px / np.maximum(our_distance, 1e-12)) / (focals[view] / their_distance)
    scale = np.maximum(ratio, 1 / np.maximum(ratio, 1e-12))

    alike: NDArray[np.bool_] = inside[point] & (turn_deg < options.max_turn_deg) & (scale < options.max_scale)
    rows = np.flatnonzero(alike)
    # Of a point's observations the most similar one, weighing angle and scale by their bounds.
    unlikeness = turn_deg[rows] / options.max_turn_deg + np.log(scale[rows]) / np.log(options.max_scale)
    rows = rows[np.lexsort((unlikeness, point[rows]))]
    rows = rows[np.diff(point[rows], prepend=-1) != 0]
    return Visible(point[rows], pixel[point[rows]], turn_deg[rows], scale[rows], view[rows])
