"""Recordings of ROS 2: a folder of rosbag2, or one of its files (.mcap, .db3).

Keyframes are taken from the images of one camera: whenever it has moved or turned far enough since the last one, the
sharpest of the next few images. They are written to a folder of their own, which is removed when the process ends;
JPEGs and PNGs as they are, others as PNGs. Poses are those of Odometry, PoseStamped or tf, interpolated, and moved to
the camera by /tf_static. The recording is read twice, as a stream: what stays in memory is the poses and one message.

A topic of depth images, if there is one, is read a third time: each keyframe has the nearest in time. Depths are of the
images' own frame (aligned), or of a frame that /tf_static connects with it.
"""

from __future__ import annotations

import atexit
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from mapless.geometry import RigidTransform, rotation_angle_deg
from mapless.ros import RosCamera, pixels_from_image
from mapless_tools.bags import is_recording
from mapless_tools.bags.trajectory import FrameTree
from mapless_tools.dataset import Dataset, DepthFile

from .collecting import Collector, Intrinsics, KeyframeOptions, ReadOptions
from .depths import FLOAT32
from .writing import image_name

if TYPE_CHECKING:
    from mapless_tools.bags.images import Images

CANDIDATES = 5
"""Images of which the sharpest becomes a keyframe; at 30 Hz, a sixth of a second."""
SLACK = 0.2
"""Tolerance of distance and angle, as a share: the candidates are no farther from the first of them."""


def fits(path: Path) -> bool:
    """Whether a path has this layout."""
    return is_recording(path)


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the recording; see `read_dataset`."""
    from mapless_tools.bags.images import open_images
    from mapless_tools.bags.recording import Recording
    from mapless_tools.bags.source import open_poses

    with Recording(path) as recording:
        images = open_images(recording, options.bag, with_camera=options.intrinsics is None)
        poses = open_poses(images, options.bag)
        folder = TemporaryDirectory(prefix="mapless-keyframes-")
        atexit.register(folder.cleanup)
        collector = Collector(Path(folder.name), options.depths)
        if images.infos is None and options.intrinsics is None:
            raise ValueError(f"{path} has no CameraInfo for the images of {images.topic}; give --intrinsics")
        found, unposed, is_undistorted = 0, _Unposed(collector), False

        def posed() -> Iterator[tuple[int, Any, RigidTransform]]:
            nonlocal found
            for stamp_ns, _, message in images:
                found += 1
                time_s = images.time_s(stamp_ns)
                try:
                    pose = poses.tree.lookup(poses.world, images.frame, time_s)
                except ValueError as error:
                    unposed.add(found, time_s, str(error))
                    continue
                unposed.end()
                yield stamp_ns, message, pose

        prefix = images.topic.strip("/")

        def refuse(stamp_ns: int, reason: str) -> None:
            with collector.attempt(f"{images.topic} at {images.time_s(stamp_ns):.3f} s"):
                raise ValueError(reason)

        photos: dict[int, _Photo] = {}
        for stamp_ns, message, pose in keyframes(posed(), options.keyframes, refuse):
            with collector.attempt(f"{images.topic} at {images.time_s(stamp_ns):.3f} s"):
                known = _given(options.intrinsics, message) if options.intrinsics else images.camera(stamp_ns)
                is_undistorted = is_undistorted or known.undistortion is not None
                photo = known.photo(message, lossless=True)
                name = image_name(str(stamp_ns), photo)
                (collector.folder / name).write_bytes(photo)
                photos[stamp_ns] = _Photo(name, known, pose)
        unposed.end()
        depths = {} if options.depths.no_depth else _depths(images, poses.tree, photos, collector, options)
    for stamp_ns, it in photos.items():
        with collector.attempt(f"{images.topic} at {images.time_s(stamp_ns):.3f} s"):
            depth = depths.get(stamp_ns)
            its = depth and collector.depth(depth, (it.camera.camera.width_px, it.camera.camera.height_px))
            collector.add(it.name, it.camera.camera, it.world_from_camera, name=f"{prefix}/{stamp_ns}", depth=its)
    skipped = recording.skipped_lines()
    collector.notes.append(
        f"{len(collector.frames)} keyframes of {found} images on {images.topic} (frame {images.frame}, "
        f"{images.camera_topic or '--intrinsics'}), poses of {poses.topic} in frame {poses.world}"
    )
    collector.notes += [images.camera_line] if images.camera_line else []
    collector.notes += skipped
    if is_undistorted:
        collector.notes.append(
            "the lens is rational_polynomial, which mapless does not have: images are undistorted to a pinhole"
        )
    name = path.resolve().name
    return collector.dataset(name, "rosbag", metric=True, source=f"recording {name}", ground_truth=poses.topic)


@dataclass(frozen=True, eq=False)
class _Photo:
    """A keyframe: the name of its file, its camera and its pose."""

    name: str
    camera: RosCamera
    world_from_camera: RigidTransform


def _depths(
    images: Images, tree: FrameTree, photos: Mapping[int, _Photo], collector: Collector, options: ReadOptions
) -> dict[int, DepthFile]:
    """Writes the depths of keyframes beside them; by stamp, with paths from the collector's folder."""
    from mapless_tools.bags.depths import open_depths

    found: dict[int, DepthFile] = {}
    try:
        depths = open_depths(images, options.depths.depth_topic)
    except ValueError as error:
        collector.notes.append(f"depths are left out: {error}")
        return found
    if depths is None:
        return found
    try:
        is_same = depths.frame == images.frame
        camera_from_depth = None if is_same else tree.lookup(images.frame, depths.frame, 0.0)
    except (LookupError, ValueError) as error:
        collector.notes.append(f"depths of {depths.topic} are left out: {error}")
        return found
    for stamp_ns, depth in depths.nearest(sorted(photos)):
        with collector.attempt_depth(f"{depths.topic} at {images.time_s(stamp_ns):.3f} s"):
            image = depth.image(photos[stamp_ns].camera, camera_from_depth)
            path = Path(f"{stamp_ns}.depth{'.png' if image.size is None else FLOAT32}")
            (collector.folder / path).write_bytes(image.data)
            found[stamp_ns] = DepthFile(
                path, image.unit_m, image.sensor, image.camera, image.camera_from_depth_camera, size=image.size
            )
    collector.notes.append(f"depths are those of {depths.topic} (frame {depths.frame}), nearest in time within 20 ms")
    return found


@dataclass
class _Unposed:
    """Consecutive images without a pose, which are refused together, since a gap of poses concerns hundreds."""

    collector: Collector
    first: int = 0
    last: int = 0
    begin_s: float = 0.0
    end_s: float = 0.0
    reason: str = ""

    def add(self, number: int, time_s: float, reason: str) -> None:
        """Adds an image; number and time are those of the recording."""
        if not self.first:
            self.first, self.begin_s, self.reason = number, time_s, reason
        self.last, self.end_s = number, time_s

    def end(self) -> None:
        if self.first:
            which = f"images {self.first} to {self.last}, {self.begin_s:.3f} to {self.end_s:.3f} s after the first"
            with self.collector.attempt(which):
                raise ValueError(self.reason)
        self.first = 0


def keyframes(
    images: Iterator[tuple[int, Any, RigidTransform]], options: KeyframeOptions, refuse: Callable[[int, str], None]
) -> Iterator[tuple[int, Any, RigidTransform]]:
    """Yields the images, with time and pose, that are far enough from the last keyframe and the sharpest nearby.

    Calls `refuse`, with time and reason, for images that cannot be decoded and would have been candidates.
    """
    if 0 in (options.distance_m, options.angle_deg):
        yield from images
        return
    last: RigidTransform | None = None
    begin: RigidTransform | None = None
    best: tuple[int, Any, RigidTransform] | None = None
    sharpest, count = -1.0, 0
    for image in images:
        pose = image[2]
        if best is not None and begin is not None and (count == CANDIDATES or _is_far(begin, pose, options, SLACK)):
            yield best
            last, best, begin = best[2], None, None
        if best is None and last is not None and not _is_far(last, pose, options):
            continue
        try:
            sharpness = sharpness_of(image[1])
        except ValueError as error:
            refuse(image[0], str(error))
            continue
        if best is None:
            begin, sharpest, count = pose, -1.0, 0
        count += 1
        if sharpness > sharpest:
            best, sharpest = image, sharpness
    if best is not None:
        yield best


def sharpness_of(message: Any) -> float:
    """Variance of the Laplacian of an image at half its size; ValueError if it cannot be decoded."""
    pixels = pixels_from_image(message)
    grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(half, cv2.CV_32F).var())


def _is_far(before: RigidTransform, now: RigidTransform, options: KeyframeOptions, share: float = 1.0) -> bool:
    moved = before.inverse().compose(now)
    is_away = bool(np.linalg.norm(moved.translation) >= share * options.distance_m)
    return is_away or rotation_angle_deg(moved.rotation) >= share * options.angle_deg


def _given(intrinsics: Intrinsics, message: Any) -> RosCamera:
    """The camera that the user gives, for an image of this size."""
    height, width = pixels_from_image(message).shape[:2]
    return RosCamera(intrinsics.camera(width, height))
