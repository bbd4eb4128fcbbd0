"""Common to all readers, beside their options: a wrong frame is refused with the reason, and the others are read.

Only errors of a layout as a whole end its reading. Checks that every layout needs are made here: the image is in the
folder, exists and is named once; the pose is possible.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np

from mapless.cameras import MAX_SIDE_PX
from mapless.depth import depth_from_message, depth_to_message
from mapless.geometry import MAX_COORDINATE_M, Array, Camera, Quaternion, RigidTransform
from mapless.provenance import GIVEN_POSE, Provenance
from mapless.text_files import numbered_lines
from mapless_server.errors import InvalidArgument
from mapless_server.images import ANY_SIZE, ImageLimits, decode_depth, image_size
from mapless_tools.bags.options import BagOptions
from mapless_tools.dataset import Dataset, DepthFile, Frame, Refusal, image_file, legal_id, named, path_in, printable

from ..depth_options import DepthOptions


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera given by the user because the layout has none; (0, 0) is the centre of the top-left pixel."""

    focal_x_px: float
    focal_y_px: float
    principal_x_px: float
    principal_y_px: float

    def __post_init__(self) -> None:
        if not (self.focal_x_px > 0 and self.focal_y_px > 0):
            raise ValueError("intrinsics: focal lengths must be above 0")

    def camera(self, width_px: int, height_px: int) -> Camera:
        """The camera of an image of this size."""
        return Camera(width_px, height_px, self.focal_x_px, self.focal_y_px, self.principal_x_px, self.principal_y_px)


@dataclass(frozen=True)
class KeyframeOptions:
    """Options of choosing keyframes: the sharpest of a few images, each time the camera has moved or turned.

    The distance is a tenth of the depth of a room, so that neighbours overlap; the angle a third of a narrow lens's
    field of view.
    """

    distance_m: float = 0.3
    angle_deg: float = 15.0

    def __post_init__(self) -> None:
        if not (0 <= self.distance_m < np.inf and 0 <= self.angle_deg <= 180):
            raise ValueError(
                "keyframes: the distance must be 0 m or more and the angle 0 to 180 degrees, they are "
                f"{self.distance_m:g} and {self.angle_deg:g}"
            )


@dataclass(frozen=True)
class ReadOptions:
    """Options of reading.

    Attributes:
        images: folder of the images, if it is not the layout's usual one; only for `colmap`.
        masks: folder of masks under COLMAP's names, "a/1.jpg.png" of "a/1.jpg", or a mask of all images; None for those
            that the layout itself names.
        ground_truth: poses that replace the layout's own: a file or folder of SfM pseudo ground truth, for `7scenes`
            and `12scenes`.
        intrinsics: for layouts without them (`7scenes`, `tum`, recordings); None for the layout's usual ones.
        bag, keyframes: topics, frames and images of a recording that are used; only for `rosbag`, and keyframes also
            for `stray`.
        depths: what is used of the depths of photographs.
    """

    images: Path | None = None
    masks: Path | None = None
    ground_truth: Path | None = None
    intrinsics: Intrinsics | None = None
    bag: BagOptions = field(default_factory=BagOptions)
    keyframes: KeyframeOptions = field(default_factory=KeyframeOptions)
    depths: DepthOptions = field(default_factory=DepthOptions)


OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
"""Camera axes x right, y up, z back to x right, y down, z forward; its own inverse."""
UNUSABLE = (InvalidArgument, OSError, ValueError)
"""Errors of a depth's file, or of what it holds."""
_HEAD_BYTES = 2**16


class Collector:
    """Frames of a layout as they are read, and those that were refused."""

    def __init__(self, folder: Path, depths: DepthOptions) -> None:
        """Paths of images are relative to `folder`."""
        self.folder = folder
        self.depths = depths
        self.frames: list[Frame] = []
        self.refused: list[Refusal] = []
        self.notes: list[str] = []
        self._unused_depths: list[str] = []
        self._ids: set[str] = set()
        self._images: set[Path] = set()

    @contextmanager
    def attempt(self, frame: str) -> Iterator[None]:
        """Refuses the frame if the block raises ValueError."""
        try:
            yield
        except ValueError as error:
            self.refused.append(Refusal(frame, str(error)))

    @contextmanager
    def attempt_depth(self, depth: str) -> Iterator[None]:
        """Leaves the depth out, with a note, if the block raises an error of its file or of what it holds."""
        try:
            yield
        except UNUSABLE as error:
            self.leave_out_depth(depth, error)

    def leave_out_depth(self, depth: str, error: Exception) -> None:
        """Notes that a depth cannot be used."""
        self._unused_depths.append(f"{depth}: {str(error).removeprefix('image: ')}")

    def image(self, image: str) -> Path:
        """The file of an image; ValueError as in `image_file`, or if an earlier frame has the same file."""
        file = image_file(self.folder, image)
        if file in self._images:
            raise ValueError(f"image: {image!r} is named twice")
        return file

    def add(
        self,
        image: str,
        camera: Camera,
        world_from_camera: RigidTransform,
        split: str = "",
        name: str = "",
        mask: str | None = None,
        provenance: Provenance = GIVEN_POSE,
        depth: DepthFile | None = None,
    ) -> None:
        """Adds a frame; ValueError names what is wrong.

        Image and mask are paths from the folder. The frame's id is made from `name`, or else from the image's path
        without its ending.
        """
        file = self.image(image)
        check_camera(camera)
        if not np.abs(world_from_camera.translation).max() <= MAX_COORDINATE_M:  # NaN where a reader's sums overflowed
            raise ValueError(f"pose: lies more than {MAX_COORDINATE_M:g} m from the origin")
        # The folders belong to the id: sequences count their frames from 0, each of them.
        parts = PurePosixPath(name or file.relative_to(self.folder).with_suffix("")).parts
        identifier = legal_id("_".join(parts), self._ids)
        chosen = self.depths.of(depth)
        frame = Frame(identifier, file, camera, world_from_camera, split, self._mask(mask), provenance, chosen)
        self.frames.append(frame)
        self._ids.add(identifier)
        self._images.add(file)

    def depth(self, depth: DepthFile, photo: tuple[int, int], folder: Path | None = None) -> DepthFile | None:
        """The depth of a frame of this size, (width, height) pixels; None, and a note, if it cannot be used.

        Its paths are from a folder, by default that of the images.
        """
        folder = folder or self.folder
        if self.depths.no_depth:
            return None
        try:
            confidence = depth.confidence_path and path_in(folder, str(depth.confidence_path))
            whole = replace(depth, path=path_in(folder, str(depth.path)), confidence_path=confidence)
            found = self.depths.of(whole) or whole
            sent = depth_from_message(depth_to_message(found.read()), "depth")  # as a server checks it
            decode_depth(sent, photo, ImageLimits())
        except UNUSABLE as error:
            self.leave_out_depth(str(depth.path), error)
            return None
        return found

    def _mask(self, mask: str | None) -> Path | None:
        if mask is None:
            return None
        if not isinstance(mask, str) or not mask:
            raise ValueError(f"mask: must be a path, is {mask!r}")
        try:
            return image_file(self.folder, mask)
        except ValueError as error:
            raise ValueError(f"mask: {str(error).removeprefix('image: ')}") from None

    def dataset(self, name: str, layout: str, *, metric: bool, source: str = "", ground_truth: str = "") -> Dataset:
        """Makes the dataset of all added frames; ValueError if there is none."""
        if not self.frames:
            first = f"; the first, {self.refused[0].frame}: {self.refused[0].reason}" if self.refused else ""
            raise ValueError(f"{self.folder}: none of {len(self.refused)} frames can be used{first}")
        notes = list(self.notes)
        if with_depth := sum(frame.depth is not None for frame in self.frames):
            notes.append(f"depth: {with_depth} of {len(self.frames)} photographs have one")
        if self._unused_depths:
            notes.append(
                printable(f"{len(self._unused_depths)} depths are left out; the first, {self._unused_depths[0]}")
            )
        return Dataset(
            name, tuple(self.frames), metric, source, ground_truth, layout, tuple(self.refused), tuple(notes)
        )


def check_camera(camera: Camera) -> None:
    """Raises ValueError if no camera can have this size and these intrinsics."""
    if not (1 <= camera.width_px <= MAX_SIDE_PX and 1 <= camera.height_px <= MAX_SIDE_PX):
        raise ValueError(f"camera: {camera.width_px}x{camera.height_px} is no size")
    numbers = [camera.focal_x_px, camera.focal_y_px, camera.principal_x_px, camera.principal_y_px]
    if camera.distortion is not None:
        numbers += list(vars(camera.distortion).values())
    if not np.isfinite(numbers).all():
        raise ValueError("camera: intrinsics are not finite")
    if not (camera.focal_x_px > 0 and camera.focal_y_px > 0):
        raise ValueError("camera: focal lengths must be above 0")


def from_corner(camera: Camera) -> Camera:
    """Converts a camera whose principal point counts from the top-left pixel's corner, as COLMAP's and ARKit's."""
    return replace(camera, principal_x_px=camera.principal_x_px - 0.5, principal_y_px=camera.principal_y_px - 0.5)


def from_opengl(world_from_camera: RigidTransform) -> RigidTransform:
    """Converts a camera's pose from OpenGL's axes: x right, y up, z back."""
    return RigidTransform(world_from_camera.rotation @ OPENCV_FROM_OPENGL, world_from_camera.translation)


def size_of(file: Path) -> tuple[int, int]:
    """Width and height of an image file, from its header; ValueError if it is not an image."""
    try:
        with file.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
            try:
                return image_size(head, ANY_SIZE)
            except InvalidArgument as error:
                if error.reason != "IMAGE_TRUNCATED":
                    raise
            return image_size(head + stream.read(), ANY_SIZE)
    except InvalidArgument as error:
        raise ValueError(f"image: {file}: {error}") from error
    except OSError as error:
        raise ValueError(f"image: {file} cannot be read: {error.strerror}") from error


def text_lines(file: Path) -> Iterator[tuple[int, str]]:
    """Yields number and text of the lines of a file of any size; ValueError, naming it, if it cannot be read."""
    try:
        yield from numbered_lines(file)
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error


def filled_lines(file: Path) -> Iterator[tuple[int, str]]:
    """Yields those of `text_lines` that are neither empty nor comments."""
    return ((number, line) for number, line in text_lines(file) if line.strip() and not line.lstrip().startswith("#"))


def read_words(file: Path) -> list[str]:
    """The words of a text file; ValueError, naming it, if it cannot be read."""
    return [word for _, line in text_lines(file) for word in line.split()]


def rotation_of(quaternion: Array, what: str) -> Array:
    """The rotation of a unit quaternion (w, x, y, z); ValueError, naming `what` it belongs to, if it is not one."""
    w, x, y, z = quaternion.tolist()
    with named(what):
        return Quaternion(x, y, z, w).matrix()


def natural_order(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts "frame-9" before "frame-10"."""
    key: list[tuple[int, int, str]] = []
    for part in filter(None, re.split(r"(\d+)", name)):
        digits = part.lstrip("0")  # not as a number: Python reads none of thousands of digits
        key.append((0, len(digits), digits) if part.isdecimal() else (1, 0, part))
    return key
