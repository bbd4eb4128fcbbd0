"""Views: photographs reduced to a pinhole camera and local features, and what the coarse stage reconstructs of them.

Images are reduced, and keypoints undistorted, here and nowhere else.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.depth import implausible_median
from mapless.geometry import Array, Camera, RigidTransform
from mapless.lenses import Distortion, Fisheye, RadialTangential, lens_model_of
from mapless.provenance import GIVEN_POSE, Provenance
from mapless_server.images.exif import NO_EXIF, Exif

Matches = NDArray[np.int32]
"""(M, 2): keypoint indices in the first and in the second of two views."""

Rows = NDArray[np.intp] | NDArray[np.int32] | NDArray[np.bool_] | slice
"""Rows of an array: indices, a mask or a range."""

Ignored = NDArray[np.bool_]
"""(H, W): pixels of an image that show nothing of the place, by the mask that was given with it."""


@dataclass(frozen=True, eq=False)
class Features:
    """Local features of one photograph.

    Attributes:
        keypoints: (N, 2) float32, x and y in pixels of the view's camera, lens distortion removed.
        descriptors: (N, D): float32, unit length; or in a quarter of the bytes, int8 of any length, or uint8, a
            histogram. `unit_descriptors` converts all of them.
        sizes_px: (N,) float32, diameter of the patch that each descriptor describes.
    """

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.float32] | NDArray[np.int8] | NDArray[np.uint8]
    sizes_px: NDArray[np.float32]

    def __post_init__(self) -> None:
        n = len(self.keypoints)
        if self.keypoints.shape != (n, 2) or self.descriptors.ndim != 2 or len(self.descriptors) != n:
            raise ValueError(f"keypoints {self.keypoints.shape} and descriptors {self.descriptors.shape} do not fit")
        if self.sizes_px.shape != (n,):
            raise ValueError(f"sizes {self.sizes_px.shape} do not fit {n} keypoints")

    def __len__(self) -> int:
        return len(self.keypoints)

    @property
    def size_bytes(self) -> int:
        """Memory of the arrays, bytes."""
        return self.keypoints.nbytes + self.descriptors.nbytes + self.sizes_px.nbytes

    def pixels(self, rows: Rows = slice(None)) -> Array:
        """Some keypoints, or all, (R, 2) in double precision."""
        return self.keypoints[rows].astype(np.float64)

    def first(self, count: int) -> "Features":
        """The first features; learned ones are in the order of their scores, of each raster alike."""
        return Features(self.keypoints[:count], self.descriptors[:count], self.sizes_px[:count])

    def every(self, step: int) -> "Features":
        """The features 0, step, 2 step, ..."""
        return Features(self.keypoints[::step], self.descriptors[::step], self.sizes_px[::step])

    def but_every(self, step: int) -> "Features":
        """The features that `every` leaves out, in order."""
        rest = np.ones(len(self), bool)
        rest[::step] = False
        return Features(self.keypoints[rest], self.descriptors[rest], self.sizes_px[rest])

    @cached_property
    def inverse_lengths(self) -> NDArray[np.float32]:
        """Inverse lengths (N,) of descriptors of int8."""
        numbers = self.descriptors.astype(np.float32)
        return np.asarray(1 / np.sqrt(np.maximum(np.einsum("nd,nd->n", numbers, numbers), 1)), np.float32)

    def unit_descriptors(self, rows: NDArray[np.intp] | slice = slice(None)) -> NDArray[np.float32]:
        """Converts some descriptors, or all, to (R, D) float32 of unit length, so that a product is a cosine.

        A histogram becomes the square roots of its numbers' shares (Arandjelovic and Zisserman 2012).
        """
        chosen = self.descriptors[rows]
        if chosen.dtype == np.float32:
            return np.asarray(chosen, np.float32)
        numbers = chosen.astype(np.float32)
        if chosen.dtype == np.uint8:
            sums = numbers @ np.ones(numbers.shape[1], np.float32)  # exact, in a fifth of the time of `sum`
            np.divide(numbers, np.maximum(sums, 1)[:, None], out=numbers)
            return np.asarray(np.sqrt(numbers, out=numbers), np.float32)
        lengths = np.sqrt(np.einsum("nd,nd->n", numbers, numbers))
        return np.asarray(np.divide(numbers, np.maximum(lengths, 1)[:, None], out=numbers), np.float32)


def rounded_descriptors(descriptors: NDArray[np.floating]) -> NDArray[np.int8]:
    """Rounds descriptors (N, D) to 8 bits: each is scaled so that its largest number is the largest of them."""
    finite = np.nan_to_num(descriptors)
    largest = np.abs(finite).max(axis=1, keepdims=True, initial=np.finfo(np.float32).tiny)
    return np.asarray(np.rint(finite * (np.iinfo(np.int8).max / largest.astype(np.float64))), np.int8)


@dataclass(frozen=True, eq=False)
class Photograph:
    """The image of a view, for stages that use pixels. Reading it may involve a database and a decoder.

    Attributes:
        identify: function that returns `sha256`; called only where something is cached by it.
        camera: camera in pixels of the image, with its lens distortion.
        read: function that returns the pixels, (H, W, 3) uint8 RGB, of the camera's size.
        read_ignored: function that returns the ignored pixels, of the same size; None if all are used.
        read_exif: function that returns the EXIF of the file.
        read_depth: function that returns the depth measured with it, from its camera; None if there is none.
    """

    identify: Callable[[], str]
    camera: Camera
    read: Callable[[], NDArray[np.uint8]]
    read_ignored: Callable[[], Ignored | None] = lambda: None
    read_exif: Callable[[], Exif] = lambda: NO_EXIF
    read_depth: "Callable[[Camera], DepthMap] | None" = None

    @cached_property
    def sha256(self) -> str:
        """Hash of the encoded image, hexadecimal; key for caches of what is computed from the pixels without a mask."""
        return self.identify()

    @property
    def ignored_share(self) -> float:
        """Share of the pixels that the mask ignores, 0 to 1."""
        ignored = self.read_ignored()
        return 0.0 if ignored is None else float(ignored.mean())


@dataclass(frozen=True, eq=False)
class View:
    """A photograph as the method uses it: processed size, no distortion.

    Attributes:
        camera: pinhole camera in pixels of the processed (reduced) image.
        features: local features, in the same pixels.
        photograph: the image itself; None if no stage needs it.
        distortion: distortion of the lens, which was removed from the keypoints; None for a pinhole, and for stored
            references, where it is not needed.
        upright_deg: by how much the raster was turned clockwise to be upright by its EXIF before features were found;
            their pixels are of the raster that is not turned.
        depths: depths that a sensor measured with a photograph to be localized, at its keypoints; None without. Those
            of references are in PosedView.
    """

    camera: Camera
    features: Features
    photograph: Photograph | None = None
    distortion: Distortion | None = None
    upright_deg: float = 0.0
    depths: "KeypointDepths | None" = None

    def with_depths(self) -> "View":
        """The view with the depths that a sensor measured with its photograph; itself without."""
        if self.photograph is None or self.photograph.read_depth is None:
            return self
        return replace(self, depths=self.photograph.read_depth(self.photograph.camera).at_keypoints(self))

    def cells(self, columns: int) -> NDArray[np.int32]:
        """Indices (N,) of the keypoints' cells, row by row, in a grid of so many columns; see `grid_shape`.

        Those of keypoints outside, which lenses have, are the nearest ones.
        """
        rows, _ = grid_shape(self.camera, columns)
        at = ((self.features.keypoints + 0.5) * (columns / self.camera.width_px)).astype(np.int32)
        column, row = at[:, 0].clip(0, columns - 1), at[:, 1].clip(0, rows - 1)
        return np.asarray(row * columns + column, np.int32)

    def has_camera_of(self, other: "View") -> bool:
        """Whether both have the same intrinsics, to a thousandth of the width, and so the same errors of them.

        The photographs may have been reduced to different sizes.
        """
        ours, theirs = self.camera, other.camera
        if ours == theirs:
            return True
        widest_px = max(ours.width_px, theirs.width_px)  # reduced sides are rounded to whole pixels
        if abs(ours.width_px * theirs.height_px - theirs.width_px * ours.height_px) > widest_px:
            return False
        resized = theirs.resized(ours.width_px, ours.height_px)
        return bool(np.abs(ours.matrix() - resized.matrix()).max() < 1e-3 * ours.width_px)


def grid_shape(camera: Camera, columns: int) -> tuple[int, int]:
    """Rows and columns of a grid of about square cells over a camera's images."""
    return max(1, round(columns * camera.height_px / camera.width_px)), columns


class DepthSource(str, Enum):
    """Where depths of a reference come from: predicted by a network, or measured by a sensor."""

    NETWORK = "network"
    MEASURED = "measured"


@dataclass(frozen=True, eq=False)
class KeypointDepths:
    """Depths at the keypoints of a photograph, of any source.

    Attributes:
        depth: (N,) float32, in the unit of poses, along the viewing direction; NaN where there is none.
        relative_sigma: (N,) standard deviation of each depth, as a share of it, above 0.
        common_sigma: standard deviation of the factor that all share, as a share.
        source: where they come from.
        median: the median of the whole image, in the unit of poses; NaN if it is not known.
    """

    depth: NDArray[np.float32]
    relative_sigma: NDArray[np.float32]
    common_sigma: float
    source: DepthSource = DepthSource.NETWORK
    median: float = np.nan

    @property
    def is_plausible(self) -> bool:
        """Whether the median can be metres; true if it is not known."""
        return not implausible_median(self.median)


class DepthMap(Protocol):
    """Depths of a whole photograph."""

    def at_keypoints(self, view: View) -> KeypointDepths:
        """The depths at the keypoints of the photograph's view."""
        ...


@dataclass(frozen=True, eq=False)
class KeptDepth:
    """The depth map that is stored with a reference.

    Attributes:
        camera: pinhole camera in pixels of the map: the reference's own, moved and scaled along the axes.
        depth: (H, W) float32, in the unit of its pose, along the viewing direction; NaN where nothing is kept.
        relative_sigma: standard deviation of a depth, as a share of it, above 0.
    """

    camera: Camera
    depth: NDArray[np.float32]
    relative_sigma: float

    def __post_init__(self) -> None:
        if self.depth.shape != (self.camera.height_px, self.camera.width_px):
            raise ValueError(f"a depth map {self.depth.shape} does not fit its camera")
        if not 0 < self.relative_sigma < np.inf:
            raise ValueError(f"relative_sigma must be above 0, is {self.relative_sigma}")

    def at_keypoints(self, view: View) -> KeypointDepths:
        """The depths at the keypoints of the reference, nearest neighbour."""
        rows, columns, inside = map_cells(self.camera, view.features.keypoints, view.camera)
        depth, sigma = np.where(inside, self.depth[rows, columns], np.float32(np.nan)), self.relative_sigma
        return KeypointDepths(depth, np.full(len(depth), sigma, np.float32), sigma)


ReferenceErrors = Callable[[int, int], float | None]
"""Returns the error of a pair of a query's references, by their indices; None if it is not known."""


@dataclass(frozen=True, eq=False)
class PosedView:
    """A reference as the method uses it.

    Attributes:
        key: permanent identifier of the stored reference (references never change, keys are never reused); key for
            caches of anything computed from it.
        name: "scenes/{scene}/references/{reference}".
        view: camera and features.
        world_from_camera: its pose, metric.
        depths: depths stored with it, if any.
        provenance: how its pose is known.
    """

    key: str
    name: str
    view: View
    world_from_camera: RigidTransform
    depths: KeypointDepths | None = None
    provenance: Provenance = GIVEN_POSE


@dataclass(frozen=True, eq=False)
class ReconstructedView:
    """One view's part of a reconstruction.

    Attributes:
        camera: pinhole camera in pixels of the maps below: the view's own, moved and scaled along the axes.
        point_map: (H, W, 3) float32, the point seen at each pixel, in this camera's frame, up to the common scale; NaN
            where unknown.
        confidence: (H, W) float32, 0 to 1; 0 where unknown.
        local_from_camera: the camera's pose in the reconstruction's frame, up to the common scale.
    """

    camera: Camera
    point_map: NDArray[np.float32]
    confidence: NDArray[np.float32]
    local_from_camera: RigidTransform

    def depth_at(self, pixels: NDArray[np.floating], camera: Camera) -> NDArray[np.float64]:
        """Depth (N,) at pixels (N, 2) of the view's camera, nearest neighbour; NaN where unknown."""
        rows, columns, inside = map_cells(self.camera, pixels, camera)
        return np.where(inside, self.point_map[rows, columns, 2].astype(np.float64), np.nan)


def map_cells(
    map_camera: Camera, pixels: NDArray[np.floating], camera: Camera
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Rows and columns (N,) of the cells of one camera's maps at pixels (N, 2) of another, and which are inside."""
    ideal = camera.rays(pixels)[:, :2]
    focal = map_camera.focal_x_px, map_camera.focal_y_px
    mapped = np.rint(ideal * focal + (map_camera.principal_x_px, map_camera.principal_y_px))
    inside = np.asarray(((mapped >= 0) & (mapped < (map_camera.width_px, map_camera.height_px))).all(axis=1))
    columns, rows = np.where(inside[:, None], mapped, 0).astype(np.intp).T
    return rows, columns, inside


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Query and references in one local frame whose scale is unknown.

    Attributes:
        query: the query.
        references: the references, in order.
        metre_sigma: relative standard deviation of the unit, if that is approximately the metre; None if it is
            arbitrary.
    """

    query: ReconstructedView
    references: tuple[ReconstructedView, ...]
    metre_sigma: float | None = None


def reduce_image(
    image: NDArray[np.uint8], camera: Camera, max_side_px: int, multiple_px: int = 1
) -> tuple[NDArray[np.uint8], Camera]:
    """Reduces an image, (H, W) or (H, W, 3), so that its longer side is at most `max_side_px`.

    Returns it and its camera. Both sides of the result are multiples of `multiple_px`, as is its longest side: the
    nearest ones that keep the aspect. The image may grow for that by less than one multiple.
    """
    height, width = image.shape[:2]
    scale = min(1.0, max_side_px / max(height, width))
    columns, rows = (max(1, round(side * scale / multiple_px)) * multiple_px for side in (width, height))
    if (columns, rows) == (width, height):
        return image, camera
    reduced = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(reduced, np.uint8), camera.resized(columns, rows)


MAX_INCIDENCE_DEG = 80.0
"""Rays further from the optical axis are dropped: a pinhole's pixels run to infinity towards 90 degrees."""

ALONG_SIDE = 17
"""Positions along a side of an image at which a lens is sampled."""

MAX_ITERATIONS = 50
"""Largest number of iterations of the undistortion."""


def undistort_pixels(pixels: Array, camera: Camera) -> Array:
    """Undistorts pixels (N, 2) to the ideal pinhole camera with the same K; NaN where the lens model has no inverse."""
    if camera.distortion is None or not len(pixels):  # OpenCV returns None for no pixels
        return pixels
    d, k = camera.distortion, camera.matrix()
    lens_model_of(d)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, MAX_ITERATIONS, 1e-9)
    points = np.ascontiguousarray(pixels, np.float64)[:, None]
    if isinstance(d, RadialTangential):
        coefficients = np.array([d.k1, d.k2, d.p1, d.p2, d.k3], float)
        ideal = cv2.undistortPoints(points, k, coefficients, R=None, P=k, criteria=criteria).reshape(-1, 2)
    elif isinstance(d, Fisheye):
        ideal = cv2.fisheye.undistortPoints(
            points, k, np.array([d.k1, d.k2, d.k3, d.k4], float), P=k, criteria=criteria
        )[:, 0]
    else:
        ideal = camera.pinhole().project(_undistorted(d, camera.rays(pixels)))
    # The iteration may diverge where the model folds over; only pixels that project back to themselves are solutions.
    rays = camera.rays(ideal)
    returned = camera.project(rays)
    good = np.linalg.norm(returned - pixels, axis=1) < 0.05
    good &= np.linalg.norm(rays[:, :2], axis=1) < np.tan(np.radians(MAX_INCIDENCE_DEG))
    return np.where(good[:, None], ideal, np.nan)


def _undistorted(lens: Distortion, seen: Array) -> Array:
    """The rays (N, 3) at depth 1 that a lens shows at these (N, 3), by Newton's method."""
    ideal, shown = seen[:, :2], seen[:, :2]
    with np.errstate(all="ignore"):  # where the model folds over
        for _ in range(MAX_ITERATIONS):
            by_ideal, error = lens.by_ideal(ideal), lens.distort(ideal) - shown
            (a, b), (c, d) = np.moveaxis(by_ideal, 0, -1)
            x, y = error.T
            change = np.stack([d * x - b * y, a * y - c * x], axis=1) / (a * d - b * c)[:, None]
            ideal = ideal - change
            if not np.nanmax(np.abs(change), initial=0.0) > 1e-9:
                break
    return np.concatenate([ideal, seen[:, 2:]], axis=1)


def seen_share(camera: Camera) -> float:
    """Share of the image, 0 to 1, whose pixels have a ray through the lens; small for wrong coefficients."""
    if camera.distortion is None:
        return 1.0
    across, down = (np.linspace(-0.5, side - 0.5, ALONG_SIDE)[1::2] for side in (camera.width_px, camera.height_px))
    pixels = np.stack(np.meshgrid(across, down), -1).reshape(-1, 2)
    return float(np.isfinite(undistort_pixels(pixels, camera)).all(axis=1).mean())


def view_of(
    camera: Camera,
    pixels: Array,
    descriptors: NDArray[np.float32] | NDArray[np.int8] | NDArray[np.uint8],
    sizes_px: NDArray[np.float32],
) -> View:
    """Makes the view of keypoints found in an image: undistorted, without those that have no undistorted pixel.

    The camera is the image's, with its lens distortion; pixels (N, 2), descriptors and sizes are as in Features, but
    descriptors that are float32 are rounded to 8 bits, for queries as for stored references.
    """
    is_exact = descriptors.dtype in (np.uint8, np.int8)
    rounded = descriptors if is_exact else rounded_descriptors(np.asarray(descriptors, np.float32))
    ideal = undistort_pixels(pixels, camera)
    usable = np.isfinite(ideal).all(axis=1)
    features = Features(ideal[usable].astype(np.float32), rounded[usable], sizes_px[usable])
    return View(camera.pinhole(), features, distortion=camera.distortion)
