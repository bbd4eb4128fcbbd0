"""Keypoints that are fixed to the camera: a bonnet, a gripper, a badge, a time stamp, a watermark.

They match at the same pixels wherever the camera is, so they would say "the pose of the reference". Between two
references whose poses say that what is seen there must have moved, such matches are found; where several pairs show
them, all keypoints around are ignored in the references of that camera, and in a photograph of it.

At the same pixels, poses predict far points, and those near the point that a camera moves towards. So it is asked
whether a point at any depth in front of both cameras, up to infinity, can be seen there: with x a pixel of the first
camera, its point at depth z is seen in the second one at

    K2 (R K1^-1 x + t / z),   0 < 1 / z < infinity,

a part of the epipolar line, from the pixel of infinite depth to the epipole. A reference at the same pose, or one that
looks along its own motion, so proves nothing, and neither does a pair of photographs that show the same from the same
place though their poses differ: there the poses are wrong.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera
from mapless_server.bounds import check_bounds

from ..features.limits import MAX_SIDE_PX
from ..features.views import Matches, PosedView, View, grid_shape


@dataclass(frozen=True)
class StationaryOptions:
    """Options of finding what is fixed to the camera; pixels are those of an image of `MAX_SIDE_PX` columns.

    Attributes:
        same_px: largest distance between the pixels of a match that are the same.
        contradicted_px: smallest distance of a pixel from all those that the poses can explain; greater than what poses
            and intrinsics of references are off. Evidence: stationary-contradicted-px.
        unmoved_px: largest distance between the pixels of a match that what is fixed to the camera may have: strokes of
            half-transparent letters are found less exactly than corners. Evidence: stationary-unmoved-px,
            stationary-overlays-auto.
        same_view_share: if two photographs match at the same pixels in so many of the parts where either has keypoints,
            both show the same from the same place. Parts, because a badge in a corner may have most of the keypoints.
            Evidence: stationary-same-view-share.
        parts: number of columns of the grid of these parts.
        support: number of matches, of different pairs or at different pixels, that show that a cell is fixed. Evidence:
            stationary-support.
        cells: number of columns of the grid on which they are counted.
        reach: cells to each side that are counted together, and ignored around a cell that is fixed. Evidence:
            stationary-overlays.
    """

    same_px: float = 1.0
    contradicted_px: float = 4.0
    unmoved_px: float = 4.0
    same_view_share: float = 0.4
    parts: int = 12
    support: int = 3
    cells: int = 160
    reach: int = 2

    def __post_init__(self) -> None:
        check_bounds(self, "same_px contradicted_px", above=0)
        check_bounds(self, "same_view_share", above=0, at_most=1)
        check_bounds(self, "support cells parts", at_least=1)
        check_bounds(self, "unmoved_px reach", at_least=0)


def stationary_matches(
    first: PosedView, second: PosedView, matches: Matches, options: StationaryOptions
) -> NDArray[np.bool_]:
    """Returns which matches (M,) of two references are at one pixel, where their poses allow no point at any depth."""
    found = np.zeros(len(matches), bool)
    moved_px = displacements_px(first.view, second.view, matches)
    same = np.flatnonzero(moved_px <= options.same_px)
    if not len(same):
        return found
    pixels, others = (it.view.features.pixels(matches[same, side]) for side, it in enumerate((first, second)))
    off_px = distance_from_explained_px(first, second, pixels, others)
    same = same[off_px > options.contradicted_px * second.view.camera.width_px / MAX_SIDE_PX]
    if len(same) and not show_same_view(first.view, second.view, matches[moved_px <= options.unmoved_px], options):
        found[same] = True
    return found


def displacements_px(first: View, second: View, matches: Matches) -> Array:
    """Distances (M,) of the pixels of matches in two photographs of `MAX_SIDE_PX` columns, along the farther axis.

    Photographs may have been reduced to different sizes; infinite if their sides have different ratios.
    """
    ours, theirs = first.camera, second.camera
    if not have_same_shape(ours, theirs):
        return np.full(len(matches), np.inf)
    a, b = (in_columns(it.camera, it.features.keypoints[matches[:, side]]) for side, it in enumerate((first, second)))
    return np.asarray(np.abs(a - b).max(axis=1))


def in_columns(camera: Camera, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Pixels (N, 2) of an image as those of `MAX_SIDE_PX` columns, which photographs of any size share."""
    return np.asarray((pixels + np.float32(0.5)) * np.float32(MAX_SIDE_PX / camera.width_px))


def show_same_view(first: View, second: View, unmoved: Matches, options: StationaryOptions) -> bool:
    """Whether two photographs show the same from the same place, by their matches at the same pixels (M, 2)."""
    return share_of_parts(first, second, unmoved, options.parts) > options.same_view_share


def share_of_parts(first: View, second: View, matches: Matches, columns: int) -> float:
    """Share of the cells with matches (M, 2), among those where either photograph has keypoints."""
    ours, theirs = first.cells(columns), second.cells(columns)
    size = 1 + max(ours.max(initial=0), theirs.max(initial=0))
    matched, occupied = np.zeros(size, bool), np.zeros(size, bool)
    occupied[ours] = occupied[theirs] = True
    matched[ours[matches[:, 0]]] = True
    return float(matched.sum() / max(1, occupied.sum()))


def are_moved(
    query: View, reference: PosedView, pairs: Matches, query_matches: Matches | None, options: StationaryOptions
) -> NDArray[np.bool_]:
    """Returns whether each match (M, 2) of a photograph with a reference is at other pixels.

    All, if both show the same view, as all their matches, `query_matches`, say; None is not asked.
    """
    moved = displacements_px(query, reference.view, pairs) >= options.unmoved_px
    if query_matches is None or moved.all():
        return moved
    return moved | shows_view_of(query, reference, query_matches, options)


def shows_view_of(query: View, reference: PosedView, query_matches: Matches, options: StationaryOptions) -> bool:
    """Whether a photograph shows the same as a reference from the same place, by all their matches."""
    unmoved = query_matches[displacements_px(query, reference.view, query_matches) <= options.unmoved_px]
    return show_same_view(query, reference.view, unmoved, options)


def distance_from_explained_px(first: PosedView, second: PosedView, pixels: Array, others: Array) -> Array:
    """Distances (N,) of pixels of the second view (N, 2) from where it sees the points at these of the first (N, 2).

    The distance is that from the nearest pixel of a point at any depth in front of both cameras; infinite if there is
    no such point.
    """
    second_from_first = second.world_from_camera.rotation.T @ first.world_from_camera.rotation
    # The difference first: world coordinates may be millions of metres.
    apart = first.world_from_camera.translation - second.world_from_camera.translation
    length = float(np.linalg.norm(apart))
    towards = second.world_from_camera.rotation.T @ (apart / length if length > 1e-9 else 0 * apart)
    matrix = second.view.camera.matrix()
    infinite = first.view.camera.rays(pixels) @ (matrix @ second_from_first).T
    epipole = np.broadcast_to(matrix @ towards, infinite.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        line = np.cross(infinite, epipole)
        line = line / np.linalg.norm(line[:, :2], axis=1, keepdims=True)
        signed = (line[:, :2] * others).sum(axis=1) + line[:, 2]
        foot = others - signed[:, None] * line[:, :2]
        # The inverse depth at which the line's nearest point is seen.
        from_infinite, from_epipole = (it[:, :2] - foot * it[:, 2:] for it in (infinite, epipole))
        inverse_depth = -(from_infinite * from_epipole).sum(axis=1) / (from_epipole**2).sum(axis=1)
        is_seen = (inverse_depth >= 0) & (infinite[:, 2] + inverse_depth * epipole[:, 2] > 0)
        ends = [
            np.where(it[:, 2] > 0, np.linalg.norm(it[:, :2] / it[:, 2:] - others, axis=1), np.inf)
            for it in (infinite, epipole)
        ]
    return np.asarray(np.where(is_seen, np.abs(signed), np.fmin(*ends)))


class IgnoredKeypoints:
    """Parts of images that are fixed to their cameras, as some references show."""

    def __init__(
        self,
        references: Sequence[PosedView],
        stationary: Mapping[tuple[int, int], Matches],
        options: StationaryOptions,
    ) -> None:
        """Counts the stationary matches of pairs of references, by the references' indices."""
        self._options = options
        self._fixed: list[tuple[View, NDArray[np.bool_]]] = []
        found = {pair: matches for pair, matches in stationary.items() if len(matches)}
        if not found:
            return
        for members in _by_camera(references):
            fixed = _fixed_cells(references, members, found, options)
            if fixed.any():
                self._fixed.append((references[members[0]].view, fixed))

    def __bool__(self) -> bool:
        return bool(self._fixed)

    @property
    def size_bytes(self) -> int:
        """Memory of the grids, bytes."""
        return sum(fixed.nbytes for _, fixed in self._fixed)

    def of(self, view: View) -> NDArray[np.bool_]:
        """Returns which keypoints (N,) of a reference or of a photograph are ignored; none of another camera."""
        for example, fixed in self._fixed:
            if view.has_camera_of(example):
                # The sides of reduced images are rounded, so that one may have a row more.
                return np.asarray(fixed.ravel()[np.minimum(view.cells(self._options.cells), fixed.size - 1)])
        return np.zeros(len(view.features), bool)


def _fixed_cells(
    references: Sequence[PosedView],
    members: Sequence[int],
    stationary: Mapping[tuple[int, int], Matches],
    options: StationaryOptions,
) -> NDArray[np.bool_]:
    """The cells of one camera's images that are fixed to it."""
    shape = grid_shape(references[members[0]].view.camera, options.cells)
    size, own = shape[0] * shape[1], frozenset(members)
    cells, pairs = [np.empty(0, np.int32)], [0]
    for (i, j), matches in stationary.items():
        one, side = (i, 0) if i in own else (j, 1)
        if one in own:
            cells.append(references[one].view.cells(options.cells)[matches[:, side]])
            pairs.append(len(matches))
    # A cell counts once for a pair, however many keypoints are at one place.
    seen = np.repeat(np.arange(len(pairs)) * size, pairs) + np.minimum(np.concatenate(cells), size - 1)
    count = np.bincount(np.unique(seen) % size, minlength=size).reshape(shape).astype(np.float32)
    side = 2 * options.reach + 1
    around = cv2.boxFilter(count, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
    fixed = ((count > 0) & (np.rint(around) >= options.support)).astype(np.uint8)
    return np.asarray(cv2.dilate(fixed, np.ones((side, side), np.uint8)) > 0)


def without_ignored(matches: Matches, first: NDArray[np.bool_], second: NDArray[np.bool_]) -> Matches:
    """Matches of keypoints that are not ignored, of either view (N,), (M,)."""
    return matches[~(first[matches[:, 0]] | second[matches[:, 1]])]


def fixed_in(
    references: Sequence[PosedView],
    pairs: Mapping[tuple[int, int], Matches],
    options: StationaryOptions | None = None,
) -> IgnoredKeypoints:
    """Finds what is fixed to the cameras of references by the matches of their pairs, which no poses have filtered."""
    options = options or StationaryOptions()
    found = {
        (i, j): matches[stationary_matches(references[i], references[j], matches, options)]
        for (i, j), matches in pairs.items()
    }
    return IgnoredKeypoints(references, found, options)


def _by_camera(references: Sequence[PosedView]) -> list[list[int]]:
    """Indices of the references of each camera."""
    groups: list[list[int]] = []
    for i, reference in enumerate(references):
        group = next((it for it in groups if reference.view.has_camera_of(references[it[0]].view)), None)
        if group is None:
            groups.append([i])
        else:
            group.append(i)
    return groups


def have_same_shape(first: Camera, second: Camera) -> bool:
    """Whether the sides of two images have the same ratio, as far as their reduced sizes are whole pixels."""
    across = abs(first.width_px * second.height_px - second.width_px * first.height_px)
    return across <= max(first.width_px, second.width_px)
