"""The poses of the camera in a recording: frames from the camera to the world."""

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mapless.geometry import Quaternion, RigidTransform
from mapless.ros import transform_from_message, transform_from_pose

from .images import Images, known_topic, listed
from .options import BagOptions
from .recording import Recording, Unusable, check_order, seconds, stamp_of
from .trajectory import Edge, FrameTree, Trajectory

ODOMETRY, TRANSFORM, TF = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped", "tf2_msgs/msg/TFMessage"
POSES = (ODOMETRY, TRANSFORM, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
TF_TOPIC, STATIC_TF_TOPIC = "/tf", "/tf_static"


@dataclass(frozen=True, eq=False)
class Poses:
    """The tree of a recording's frames, and the topic of its poses, which are those of `body` in `world`."""

    tree: FrameTree
    topic: str
    world: str
    body: str


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
        skipped = "; ".join(["", *images.recording.skipped_lines()])
        raise ValueError(
            f"{path}: no transform leads from the camera's frame {images.frame!r} to {target}; known is {known}; give "
            f"--body-from-camera{skipped}"
        )
    chain = lineage[: lineage.index(world)]
    if not any(isinstance(tree.edges[frame].pose, Trajectory) for frame in chain):
        raise ValueError(f"{path}: {topic} does not move the camera: {' > '.join(reversed(lineage))} stands still")


def _pose_topic(recording: Recording, options: BagOptions) -> str:
    known = recording.topics(*POSES)
    has_tf = recording.types.get(TF_TOPIC) == TF
    if options.pose_topic:
        return known_topic(recording, options.pose_topic, [*known, *([TF_TOPIC] if has_tf else [])], "poses")
    if has_tf and (options.world_frame or not known):
        return TF_TOPIC
    if len(known) != 1:
        what = f"poses on {listed(known)}: choose with --pose-topic" if known else "no poses: neither a topic nor /tf"
        raise ValueError(f"{recording.path} has {what}")
    return known[0]


@dataclass
class _Rows:
    """Poses of a child frame while they are read, each stored as eight doubles."""

    parent: str
    table: "array[float]" = field(default_factory=lambda: array("d"))
    previous_ns: int = 0
    lost_s: list[float] = field(default_factory=list)
    is_lost: bool = False

    def lose(self) -> None:
        """There is a message without a pose between the last pose and the next."""
        self.is_lost = bool(self.table)

    def add(self, time_s: float, pose: RigidTransform) -> None:
        if self.is_lost:
            self.lost_s.append((self.table[-8] + time_s) / 2)
        self.is_lost = False
        q = pose.quaternion()
        self.table.extend([time_s, *pose.translation.tolist(), q.x, q.y, q.z, q.w])

    def trajectory(self, max_gap_s: float) -> Trajectory:
        return Trajectory(np.frombuffer(self.table).reshape(-1, 8), max_gap_s, self.lost_s)


def _transforms(images: Images, topics: list[str], options: BagOptions) -> dict[str, Edge]:
    """Edges of all TFMessages by child frame; known at one time only it is static. Of static poses the last counts."""
    rows: dict[str, _Rows] = {}
    is_static = topics == [STATIC_TF_TOPIC]
    for it in images.recording.messages([it for it in topics if it in images.recording.types]):
        if it.message is None:
            for found in rows.values():
                found.lose()
            continue
        for transform in it.message.transforms:
            child, parent = transform.child_frame_id.lstrip("/"), transform.header.frame_id.lstrip("/")
            what = f"{images.recording.path}: {it.topic}, {parent} > {child}, recorded at {seconds(it.time_ns)}"
            found = rows.setdefault(child, _Rows(parent))
            if found.parent != parent:
                raise ValueError(f"{what}: was {found.parent} > {child} before: a frame has one parent")
            try:
                stamp_ns = it.time_ns if is_static else stamp_of(transform)
                pose = _usable(transform_from_message, transform.transform)
            except Unusable as error:
                images.recording.skip(it, f"{parent} > {child}: {error}")
                found.lose()
                continue
            if not is_static:
                check_order(stamp_ns, found.previous_ns, what)
            found.previous_ns = max(stamp_ns, found.previous_ns)
            found.add(images.time_s(stamp_ns), pose)
    rows = {child: it for child, it in rows.items() if it.table}
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
    for it in recording.messages([topic]):
        try:
            if it.message is None:
                raise Unusable("damaged")
            stamp_ns, pose = stamp_of(it.message), _usable(_pose, it.message)
        except Unusable as error:
            if it.message is not None:
                recording.skip(it, str(error))
            if rows is not None:
                rows.lose()
            continue
        what = f"{recording.path}: {it.where}"
        frame = it.message.header.frame_id.lstrip("/")
        child = getattr(it.message, "child_frame_id", "").lstrip("/")
        if rows is None:
            rows, body = _Rows(frame), child
        if (frame, child) != (rows.parent, body):
            raise ValueError(f"{what}: is of {frame} > {child}, those before of {rows.parent} > {body}")
        check_order(stamp_ns, rows.previous_ns, what)
        rows.previous_ns = max(stamp_ns, rows.previous_ns)
        rows.add(images.time_s(stamp_ns), pose)
    skipped = "; ".join(["", *recording.skipped_lines()])
    if rows is None:
        raise ValueError(f"{recording.path}: {topic} holds no pose{skipped}")
    try:
        return rows.parent or "world", body, rows.trajectory(options.max_pose_gap_s)
    except ValueError as error:
        raise ValueError(f"{recording.path}: {topic} {error}{skipped}") from error


def _usable(convert: Callable[[Any], RigidTransform], message: Any) -> RigidTransform:
    """A pose of a message; Unusable if its numbers are none, as those of odometry are while it is lost."""
    try:
        return convert(message)
    except ValueError as error:
        raise Unusable(str(error)) from error


def _pose(message: Any) -> RigidTransform:
    if hasattr(message, "transform"):
        return transform_from_message(message.transform)
    pose = message.pose
    return transform_from_pose(pose.pose if hasattr(pose, "pose") else pose)
