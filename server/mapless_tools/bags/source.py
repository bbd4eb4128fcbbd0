"""The data of one camera in a recording: intrinsics, images, and frames from the camera to the world."""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mapless.geometry import Quaternion, RigidTransform
from mapless.ros import RosCamera, camera_from_info, transform_from_message, transform_from_pose
from mapless.ros.images import ENCODINGS
from mapless_tools.dataset import named

from .options import BagOptions
from .recording import Recording, seconds, stamp_of
from .trajectory import Edge, FrameTree, Trajectory

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ODOMETRY, TRANSFORM, TF = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped", "tf2_msgs/msg/TFMessage"
POSES = (ODOMETRY, TRANSFORM, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
TF_TOPIC, STATIC_TF_TOPIC = "/tf", "/tf_static"
RECTIFIED = "image_rect"
"""How topics of rectified images begin, after their namespace; P of their CameraInfo is theirs then."""


@dataclass(frozen=True, eq=False)
class Images:
    """The images of one camera, with its frame and perhaps its intrinsics; times in seconds count from `begin_ns`."""

    recording: Recording
    topic: str
    frame: str
    camera: RosCamera | None
    camera_topic: str
    begin_ns: int

    def __iter__(self) -> Iterator[tuple[int, int, Any]]:
        """Yields stamp and time of recording, both in nanoseconds, and message; ValueError if time jumps back."""
        previous_ns: int | None = None
        for number, (_, time_ns, message) in enumerate(self.recording.messages([self.topic]), 1):
            what = f"{self.recording.path}: message {number} of {self.topic}, recorded at {seconds(time_ns)}"
            stamp_ns = stamp_of(message, previous_ns, what)
            previous_ns = max(stamp_ns, previous_ns or 0)
            yield stamp_ns, time_ns, message

    def time_s(self, stamp_ns: int) -> float:
        """Converts a stamp to the trajectories' seconds, exact to nanoseconds, unlike a float of the epoch."""
        return (stamp_ns - self.begin_ns) / 1e9


@dataclass(frozen=True, eq=False)
class Poses:
    """The tree of a recording's frames, and the topic of its poses, which are those of `body` in `world`."""

    tree: FrameTree
    topic: str
    world: str
    body: str


def open_images(recording: Recording, options: BagOptions) -> Images:
    """Opens the images of the options' topic, or of the only one; ValueError names what is missing or ambiguous."""
    topic = _image_topic(recording, options.image_topic)
    first = next(recording.messages([topic]))[2]
    camera_topic = _camera_topic(recording, topic, options.camera_topic)
    camera = _camera(recording, camera_topic, topic) if camera_topic else None
    frame = first.header.frame_id.lstrip("/") or "(unnamed camera)"
    return Images(recording, topic, frame, camera, camera_topic, stamp_of(first, None, f"the first message of {topic}"))


def open_poses(images: Images, options: BagOptions) -> Poses:
    """Opens the poses of the options' topic, or of the only one, with the frames from the camera to them.

    ValueError if there is no such topic, there are several, or no frames connect them; names the flag that helps.
    """
    recording = images.recording
    topic = _pose_topic(recording, options)
    edges = static = _transforms(images, [STATIC_TF_TOPIC], options)
    world, body = options.world_frame, options.body_frame
    if topic != TF_TOPIC:
        named_world, named_body, trajectory = _poses(images, topic, options)
        world, body = world or named_world, body or named_body or _unnamed_body(images, topic, static, options)
        edges = static | {body: Edge(named_world, trajectory)}
    tree = FrameTree(_with_extrinsics(edges, images, body, options))
    if TF_TOPIC in recording.types and (topic == TF_TOPIC or world not in tree.lineage(images.frame)):
        moving = _transforms(images, [TF_TOPIC], options)  # where it is not needed, nothing that is wrong in it matters
        tree = FrameTree(moving | dict(tree.edges))
    world = world or tree.lineage(images.frame)[-1]
    _check_chain(tree, images, topic, world, body)
    return Poses(tree, topic, world, body)


def static_tree(images: Images, options: BagOptions) -> FrameTree:
    """The frames of a recording without poses."""
    edges = _transforms(images, [STATIC_TF_TOPIC], options)
    return FrameTree(_with_extrinsics(edges, images, options.body_frame, options))


def _unnamed_body(images: Images, topic: str, static: dict[str, Edge], options: BagOptions) -> str:
    """The frame of poses that do not name it: the body that carries the camera."""
    if options.body_from_camera:
        return "(body)"
    if images.frame in static:
        return FrameTree(static).lineage(images.frame)[-1]
    raise ValueError(
        f"{images.recording.path}: poses of {topic} do not name the frame they are of, and {STATIC_TF_TOPIC} does not "
        f"have the camera's, {images.frame!r}; give --body-frame or --body-from-camera"
    )


def _with_extrinsics(edges: dict[str, Edge], images: Images, body: str, options: BagOptions) -> dict[str, Edge]:
    body_from_camera = options.extrinsics()
    if body_from_camera is None:
        return edges
    if not body:
        raise ValueError("--body-from-camera takes --body-frame, too, where no topic of poses names the body")
    return edges | {images.frame: Edge(body, body_from_camera)}


def _check_chain(tree: FrameTree, images: Images, topic: str, world: str, body: str) -> None:
    lineage = tree.lineage(images.frame)
    path = images.recording.path
    if world not in lineage:
        known = " > ".join(reversed(lineage))
        target = f"{body!r}, whose poses {topic} has" if body and body not in lineage else repr(world)
        raise ValueError(
            f"{path}: no transform leads from the camera's frame {images.frame!r} to {target}; known is {known}; give "
            "--body-from-camera"
        )
    chain = lineage[: lineage.index(world)]
    if not any(isinstance(tree.edges[frame].pose, Trajectory) for frame in chain):
        raise ValueError(f"{path}: {topic} does not move the camera: {' > '.join(reversed(lineage))} stands still")


def _image_topic(recording: Recording, given: str) -> str:
    known = recording.topics(*IMAGES)
    if given:
        return _known(recording, given, known, "images")
    if len(known) > 1:
        shown = [it for it in known if not (it.endswith("/compressed") and it.removesuffix("/compressed") in known)]
        known = [it for it in shown if _shows_photographs(recording, it)] or shown
    if len(known) != 1:
        what = f"images on {_listed(known)}: choose with --image-topic" if known else "no topic of images"
        raise ValueError(f"{recording.path} has {what}")
    return known[0]


def _known(recording: Recording, given: str, known: list[str], what: str) -> str:
    if given not in known:
        raise ValueError(f"{recording.path} has no {what} on {given!r}, but on {_listed(known)}")
    return given


def _shows_photographs(recording: Recording, topic: str) -> bool:
    """Whether a topic shows photographs rather than depths, by its first message."""
    message = next(recording.messages([topic]))[2]
    return message.encoding in ENCODINGS if hasattr(message, "encoding") else "compressedDepth" not in message.format


def _camera_topic(recording: Recording, image_topic: str, given: str) -> str:
    known = recording.topics(CAMERA_INFO)
    if given:
        return _known(recording, given, known, "CameraInfo")
    namespace = image_topic.removesuffix("/compressed").rpartition("/")[0]
    beside = f"{namespace}/camera_info"
    if beside in known or len(known) < 2:
        return beside if beside in known else next(iter(known), "")
    what = f"CameraInfo on {_listed(known)}, none beside {image_topic}: choose with --camera-topic"
    raise ValueError(f"{recording.path} has {what}")


def _camera(recording: Recording, topic: str, image_topic: str) -> RosCamera:
    """The camera of all CameraInfo messages; ValueError if they differ."""
    is_rectified = image_topic.removesuffix("/compressed").rpartition("/")[2].startswith(RECTIFIED)
    known: tuple[Any, ...] | None = None
    camera: RosCamera | None = None
    for _, time_ns, message in recording.messages([topic]):
        matrices = (it.tobytes() for it in (message.k, message.d, message.p))
        state = (message.width, message.height, message.distortion_model, *matrices)
        if known is None:
            with named(f"{recording.path}: {topic}"):
                known, camera = state, camera_from_info(message, is_rectified)
        if state != known:
            raise ValueError(f"{recording.path}: {topic} changes at {seconds(time_ns)}: a camera must stay as it is")
    assert camera is not None  # topics without messages are left out
    return camera


def _pose_topic(recording: Recording, options: BagOptions) -> str:
    known = recording.topics(*POSES)
    has_tf = recording.types.get(TF_TOPIC) == TF
    if options.pose_topic:
        return _known(recording, options.pose_topic, [*known, *([TF_TOPIC] if has_tf else [])], "poses")
    if has_tf and (options.world_frame or not known):
        return TF_TOPIC
    if len(known) != 1:
        what = f"poses on {_listed(known)}: choose with --pose-topic" if known else "no poses: neither a topic nor /tf"
        raise ValueError(f"{recording.path} has {what}")
    return known[0]


@dataclass
class _Rows:
    """Poses of a child frame while they are read, each stored as eight doubles."""

    parent: str
    table: "array[float]" = field(default_factory=lambda: array("d"))
    previous_ns: int | None = None

    def add(self, time_s: float, pose: RigidTransform) -> None:
        q = pose.quaternion()
        self.table.extend([time_s, *pose.translation.tolist(), q.x, q.y, q.z, q.w])

    def trajectory(self, max_gap_s: float) -> Trajectory:
        return Trajectory(np.frombuffer(self.table).reshape(-1, 8), max_gap_s)


def _transforms(images: Images, topics: list[str], options: BagOptions) -> dict[str, Edge]:
    """Edges of all TFMessages by child frame; known at one time only it is static. Of static poses the last counts."""
    rows: dict[str, _Rows] = {}
    is_static = topics == [STATIC_TF_TOPIC]
    for topic, time_ns, message in images.recording.messages([it for it in topics if it in images.recording.types]):
        for transform in message.transforms:
            child, parent = transform.child_frame_id.lstrip("/"), transform.header.frame_id.lstrip("/")
            what = f"{images.recording.path}: {topic}, {parent} > {child}, recorded at {seconds(time_ns)}"
            found = rows.setdefault(child, _Rows(parent))
            if found.parent != parent:
                raise ValueError(f"{what}: was {found.parent} > {child} before: a frame has one parent")
            stamp_ns = time_ns if is_static else stamp_of(transform, found.previous_ns, what)
            found.previous_ns = max(stamp_ns, found.previous_ns or 0)
            with named(what):
                found.add(images.time_s(stamp_ns), transform_from_message(transform.transform))
    return {
        child: Edge(it.parent, _pose_of(it, -1) if is_static else _moving(it, options)) for child, it in rows.items()
    }


def _moving(rows: _Rows, options: BagOptions) -> RigidTransform | Trajectory:
    times = rows.table[::8]
    return _pose_of(rows, 0) if min(times) == max(times) else rows.trajectory(options.max_pose_gap_s)


def _pose_of(rows: _Rows, index: int) -> RigidTransform:
    x, y, z, *quaternion = np.frombuffer(rows.table).reshape(-1, 8)[index, 1:].tolist()
    return RigidTransform(Quaternion(*quaternion).matrix(), np.array([x, y, z]))


def _poses(images: Images, topic: str, options: BagOptions) -> tuple[str, str, Trajectory]:
    recording = images.recording
    rows: _Rows | None = None
    body = ""
    for number, (_, time_ns, message) in enumerate(recording.messages([topic]), 1):
        what = f"{recording.path}: message {number} of {topic}, recorded at {seconds(time_ns)}"
        frame, child = message.header.frame_id.lstrip("/"), getattr(message, "child_frame_id", "").lstrip("/")
        if rows is None:
            rows, body = _Rows(frame), child
        if (frame, child) != (rows.parent, body):
            raise ValueError(f"{what}: is of {frame} > {child}, those before of {rows.parent} > {body}")
        stamp_ns = stamp_of(message, rows.previous_ns, what)
        rows.previous_ns = max(stamp_ns, rows.previous_ns or 0)
        with named(what):
            rows.add(images.time_s(stamp_ns), _pose(message))
    assert rows is not None  # topics without messages are left out
    try:
        return rows.parent or "world", body, rows.trajectory(options.max_pose_gap_s)
    except ValueError as error:
        raise ValueError(f"{recording.path}: {topic} {error}") from error


def _pose(message: Any) -> RigidTransform:
    if hasattr(message, "transform"):
        return transform_from_message(message.transform)
    pose = message.pose
    return transform_from_pose(pose.pose if hasattr(pose, "pose") else pose)


def _listed(topics: list[str]) -> str:
    return ", ".join(topics) or "none"
