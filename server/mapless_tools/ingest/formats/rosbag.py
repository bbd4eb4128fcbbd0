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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from mapless.geometry import RigidTransform
from mapless.ros import RosCamera, pixels_from_image
from mapless_tools.bags import is_recording
from mapless_tools.bags.trajectory import FrameTree
from mapless_tools.dataset import Dataset, DepthFile

from .collecting import Collector, Intrinsics, ReadOptions
from .depths import FLOAT32
from .keyframes import keyframes, sharpness
from .writing import image_name

if TYPE_CHECKING:
    from mapless_tools.bags.images import Images


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
        for stamp_ns, message, pose in keyframes(posed(), options.keyframes, _sharpness_of, refuse):
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


def _sharpness_of(message: Any) -> float:
    """The sharpness of an image; ValueError if it cannot be decoded."""
    pixels = pixels_from_image(message)
    return sharpness(pixels if pixels.ndim == 2 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), np.uint8))


def _given(intrinsics: Intrinsics, message: Any) -> RosCamera:
    """The camera that the user gives, for an image of this size."""
    height, width = pixels_from_image(message).shape[:2]
    return RosCamera(intrinsics.camera(width, height))
