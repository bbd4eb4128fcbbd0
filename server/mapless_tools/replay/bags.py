"""A recording, localized image by image through a server, as the robot's node would; the answers as a recording.

What it writes is a folder of rosbag2 with an MCAP file, which Foxglove opens and `ros2 bag play` plays: the poses with
their covariances, map > odom and odom > base, what the recording has of /tf_static, and a diagnostic for every image.
"""

from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from mapless import Camera, Client
from mapless.geometry import RigidTransform, rotation_angle_deg
from mapless.ros import Localizer, LocalizerOptions, Messages, Outcome, RosCamera
from mapless.ros.localizer import FAILED, LOCALIZED
from mapless.ros.messages import DIAGNOSTICS_TYPE, POSE_TYPE, TF_TYPE
from mapless_tools.bags.images import Images, open_images
from mapless_tools.bags.options import BagOptions
from mapless_tools.bags.recording import Recording
from mapless_tools.bags.source import POSES, STATIC_TF_TOPIC, TF_TOPIC, Poses, open_poses, static_tree
from mapless_tools.bags.trajectory import FrameTree
from mapless_tools.progress import Progress

POSE_TOPIC, DIAGNOSTICS_TOPIC = "/visual_localization/pose", "/diagnostics"
MAX_FAILURES = 5
"""In a row, after which the replay ends: the server is away, or no image can be read."""


@dataclass
class BagReport:
    """The results of a recording's images, as far as it was read.

    Images are counted as localized, or by the reason that their diagnostics begin with. Distances are of localized
    poses from the recording's own in the same map frame, radii the 95 % ones of the positions. `notes`
    say which camera was used and which messages were skipped, `stopped` why it ended early.
    """

    images: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    apart_cm: list[float] = field(default_factory=list)
    apart_deg: list[float] = field(default_factory=list)
    radii_cm: list[float] = field(default_factory=list)
    server_s: list[float] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    stopped: str = ""

    def add(self, outcome: Outcome) -> None:
        """Adds an image that was sent."""
        self.counts["localized" if outcome.level == LOCALIZED else outcome.message.partition(":")[0]] += 1
        if outcome.level == LOCALIZED:
            self.radii_cm.append(100 * float(outcome.values["position_95_m"]))
            self.server_s.append(float(outcome.values["server_s"]))

    def lines(self) -> list[str]:
        """The report as lines of text."""
        found = self.counts["localized"]
        others = ", ".join(f"{count} {reason}" for reason, count in self.counts.most_common() if reason != "localized")
        lines = [f"{found} of {self.counts.total()} localized{f'; {others}' if others else ''}"]
        lines[0] += f" (of {self.images} images in the recording)"
        if found:
            radius_cm, server_s = np.median(self.radii_cm), np.median(self.server_s)
            lines.append(f"median 95 % radius {radius_cm:.2f} cm, {server_s:.2f} s in the server")
        if self.apart_cm:
            apart_cm, apart_deg = np.median(self.apart_cm), np.median(self.apart_deg)
            lines.append(f"median distance from the recording's own poses {apart_cm:.2f} cm, {apart_deg:.3f} degrees")
        return [*lines, *self.notes, *([f"ended early: {self.stopped}"] if self.stopped else [])]


def replay_bag(
    path: Path,
    out: Path,
    client: Client,
    bag: BagOptions,
    options: LocalizerOptions,
    camera: Camera | None,
    progress: Progress,
    sequence_length: int = 0,
) -> BagReport:
    """Localizes a recording; `out`, a new folder, is a valid recording in any case, with what was computed so far.

    An empty `odom_frame` or `base_frame` of the options is that of the recording's poses; the rate 0 takes every image.
    The camera is for a recording without CameraInfo; `sequence_length` only for one with odometry. ValueError if the
    recording or the options cannot be used, MaplessError if there is no such server or scene; nothing is written then.
    """
    if out.exists():
        raise ValueError(f"{out} exists already")
    with ExitStack() as stack:
        recording = stack.enter_context(Recording(path))
        images = open_images(recording, bag, with_camera=camera is None)
        given = None if camera is None else RosCamera(camera)
        if given is None and images.infos is None:
            raise ValueError(f"{path} has no CameraInfo for the images of {images.topic}; give --camera")
        poses = _poses(images, bag)
        tree = static_tree(images, bag) if poses is None else poses.tree
        options = replace(_with_frames(options, images, poses), sequence_length=sequence_length)
        client.get_scene(options.scene)
        report = BagReport()
        writer = stack.enter_context(_Output(out, recording, options))
        writer.copy_static(images)
        localizer = Localizer(client, options, partial(_looked_up, images, tree))
        failures, total = 0, recording.counts[images.topic]
        try:
            for stamp_ns, time_ns, message in images:
                report.images += 1
                progress("localizing", report.images, total)
                if options.rate_hz and not localizer.is_due(stamp_ns):
                    continue
                message.header.frame_id = images.frame  # tf needs a name
                outcome = localizer.localize(message, given or images.camera(stamp_ns))
                report.add(outcome)
                writer.write(time_ns, outcome, tree, images)
                _compare(report, outcome, poses, options, images)
                failures = failures + 1 if outcome.level == FAILED else 0
                if failures == MAX_FAILURES:
                    raise ValueError(f"{failures} images in a row failed, the last: {outcome.message}")
        except ValueError as error:
            report.stopped = str(error)
        except KeyboardInterrupt:
            report.stopped = "interrupted"
        report.notes = [line for line in (images.camera_line, *recording.skipped_lines()) if line]
    return report


def _poses(images: Images, bag: BagOptions) -> Poses | None:
    """Poses of the recording; None if it has none, and none are requested."""
    is_there = images.recording.topics(*POSES) or TF_TOPIC in images.recording.types
    return open_poses(images, bag) if is_there or bag.pose_topic else None


def _with_frames(options: LocalizerOptions, images: Images, poses: Poses | None) -> LocalizerOptions:
    if poses is None:
        return replace(options, base_frame=options.base_frame or images.frame, odom_frame="")
    odom = options.odom_frame or poses.world
    base = options.base_frame or poses.body or images.frame
    return replace(options, base_frame=base, odom_frame="" if odom == options.map_frame else odom)


def _looked_up(images: Images, tree: FrameTree, target: str, source: str, stamp_ns: int) -> RigidTransform:
    try:
        return tree.lookup(target, source, images.time_s(stamp_ns))
    except ValueError as error:
        raise LookupError(str(error)) from error


def _compare(
    report: BagReport, outcome: Outcome, poses: Poses | None, options: LocalizerOptions, images: Images
) -> None:
    """Adds the distance of a pose from the recording's own, if both are in the same frame."""
    if poses is None or poses.world != options.map_frame or outcome.map_from_body is None:
        return
    try:
        own = poses.tree.lookup(poses.world, outcome.frame, images.time_s(outcome.stamp_ns))
    except (LookupError, ValueError):  # no pose at that time
        return
    apart = own.inverse().compose(outcome.map_from_body)
    report.apart_cm.append(100 * float(np.linalg.norm(apart.translation)))
    report.apart_deg.append(rotation_angle_deg(apart.rotation))


class _Output:
    def __init__(self, out: Path, recording: Recording, options: LocalizerOptions) -> None:
        self._recording = recording
        self._options = options
        self._types = recording.typestore
        self._messages = Messages(lambda name: self._types.types[name])
        self._writer = Writer(out, version=8, storage_plugin=StoragePlugin.MCAP)
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> "_Output":
        self._writer.open()
        for topic, kind in ((POSE_TOPIC, POSE_TYPE), (TF_TOPIC, TF_TYPE), (DIAGNOSTICS_TOPIC, DIAGNOSTICS_TYPE)):
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._types)
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def copy_static(self, images: Images) -> None:
        """Writes the recording's /tf_static, at the time of the first image."""
        for it in images.recording.messages([STATIC_TF_TOPIC]):
            if it.message is None:
                continue
            topic, message = it.topic, it.message
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(topic, TF_TYPE, typestore=self._types)
            self._put(topic, images.begin_ns, message)

    def write(self, time_ns: int, outcome: Outcome, tree: FrameTree, images: Images) -> None:
        self._put(DIAGNOSTICS_TOPIC, time_ns, self._messages.diagnostics(outcome, self._options.scene))
        if outcome.map_from_body is None:
            return
        self._put(POSE_TOPIC, time_ns, self._messages.pose(outcome))
        if outcome.tf_edge is None:
            return
        tf = self._messages.tf(outcome)
        if odom := self._options.odom_frame:
            pose = tree.lookup(odom, outcome.frame, images.time_s(outcome.stamp_ns))
            tf.transforms.append(self._messages.transform(outcome.stamp_ns, odom, outcome.frame, pose))
        self._put(TF_TOPIC, time_ns, tf)

    def _put(self, topic: str, time_ns: int, message: Any) -> None:
        data = self._types.serialize_cdr(message, message.__msgtype__)
        self._writer.write(self._connections[topic], time_ns, data)
