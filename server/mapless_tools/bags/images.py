"""The images of one camera in a recording, with its frame and the camera of each image."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from mapless.ros import CameraInfos, RosCamera, rectified_differs, says_rectified
from mapless.ros.images import ENCODINGS

from .options import BagOptions
from .recording import Recording, Unusable, check_order, stamp_of

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


@dataclass(frozen=True, eq=False)
class Images:
    """The images of one camera, with its frame and perhaps its intrinsics; times in seconds count from `begin_ns`.

    `camera_line` says for people which intrinsics are used, and why.
    """

    recording: Recording
    topic: str
    frame: str
    infos: CameraInfos | None
    camera_topic: str
    camera_line: str
    begin_ns: int

    def __iter__(self) -> Iterator[tuple[int, int, Any]]:
        """Yields stamp and time of recording, both in nanoseconds, and message; ValueError if time jumps back."""
        previous_ns = 0
        for it in self.recording.messages([self.topic]):
            if it.message is None:
                continue
            try:
                stamp_ns = stamp_of(it.message)
            except Unusable as error:
                self.recording.skip(it, str(error))
                continue
            check_order(stamp_ns, previous_ns, f"{self.recording.path}: {it.where}")
            previous_ns = max(stamp_ns, previous_ns)
            yield stamp_ns, it.time_ns, it.message

    def time_s(self, stamp_ns: int) -> float:
        """Converts a stamp to the trajectories' seconds, exact to nanoseconds, unlike a float of the epoch."""
        return (stamp_ns - self.begin_ns) / 1e9

    def camera(self, stamp_ns: int) -> RosCamera:
        """The camera of an image of this time: that of the nearest CameraInfo."""
        camera = self.infos.at(stamp_ns) if self.infos is not None else None
        assert camera is not None  # the caller has asked for `infos`, which are not empty
        return camera


def open_images(recording: Recording, options: BagOptions, *, with_camera: bool = True) -> Images:
    """Opens the images of the options' topic, or of the only one; ValueError names what is missing or ambiguous.

    Without a camera, as where intrinsics are given, CameraInfo does not matter.
    """
    topic = _image_topic(recording, options.image_topic)
    first = first_message(recording, topic)
    camera_topic = _camera_topic(recording, topic, options.camera_topic) if with_camera else ""
    infos, line = camera_infos(recording, camera_topic, topic, options.rectified) if camera_topic else (None, "")
    frame = first.header.frame_id.lstrip("/") or "(unnamed camera)"
    return Images(recording, topic, frame, infos, camera_topic, line, stamp_of(first))


def known_topic(recording: Recording, given: str, known: list[str], what: str) -> str:
    """The given topic; ValueError, with those that are known, if the recording has no such."""
    if given not in known:
        raise ValueError(f"{recording.path} has no {what} on {given!r}, but on {listed(known)}")
    return given


def listed(topics: list[str]) -> str:
    """Topics as a text."""
    return ", ".join(topics) or "none"


def first_message(recording: Recording, topic: str) -> Any:
    """The first image that has a time."""
    for it in recording.messages([topic]):
        if it.message is not None:
            try:
                stamp_of(it.message)
            except Unusable as error:
                recording.skip(it, str(error))
                continue
            return it.message
    raise ValueError(f"{recording.path}: no image of {topic} can be read; {'; '.join(recording.skipped_lines())}")


def _image_topic(recording: Recording, given: str) -> str:
    known = recording.topics(*IMAGES)
    if given:
        return known_topic(recording, given, known, "images")
    if len(known) > 1:
        shown = [it for it in known if not (it.endswith("/compressed") and it.removesuffix("/compressed") in known)]
        known = [it for it in shown if _shows_photographs(recording, it)] or shown
    if len(known) != 1:
        what = f"images on {listed(known)}: choose with --image-topic" if known else "no topic of images"
        raise ValueError(f"{recording.path} has {what}")
    return known[0]


def _shows_photographs(recording: Recording, topic: str) -> bool:
    """Whether a topic shows photographs rather than depths, by its first message."""
    message = first_message(recording, topic)
    return message.encoding in ENCODINGS if hasattr(message, "encoding") else "compressedDepth" not in message.format


def _camera_topic(recording: Recording, image_topic: str, given: str) -> str:
    known = recording.topics(CAMERA_INFO)
    if given:
        return known_topic(recording, given, known, "CameraInfo")
    namespace = image_topic.removesuffix("/compressed").rpartition("/")[0]
    beside = f"{namespace}/camera_info"
    if beside in known or len(known) < 2:
        return beside if beside in known else next(iter(known), "")
    what = f"CameraInfo on {listed(known)}, none beside {image_topic}: choose with --camera-topic"
    raise ValueError(f"{recording.path} has {what}")


def camera_infos(recording: Recording, topic: str, image_topic: str, given: bool | None) -> tuple[CameraInfos, str]:
    """All messages of a topic that have a camera, and which of their matrices is used; ValueError if none has one."""
    is_rectified = says_rectified(image_topic) if given is None else given
    infos = CameraInfos(is_rectified)
    count, differ = 0, False
    for it in recording.messages([topic]):
        if it.message is None:
            continue
        try:
            infos.add(it.message, it.time_ns)
        except ValueError as error:
            recording.skip(it, str(error))
            continue
        count += 1
        differ = differ or rectified_differs(it.message)
    if not count:
        reason = next(iter(recording.skipped[topic].values()))
        raise ValueError(f"{recording.path}: {topic}: {reason}; give --intrinsics")
    return infos, _camera_line(topic, image_topic, is_rectified, given, differ)


def _camera_line(topic: str, image_topic: str, is_rectified: bool, given: bool | None, differ: bool) -> str:
    used, other = ("P", "K and D") if is_rectified else ("K and D", "P")
    if not differ:
        return f"the camera is that of {topic}, which is the same for raw and for rectified images"
    if given is not None:
        why = "as --rectified says" if given else "as --no-rectified says"
        return f"the camera is {used} of {topic}, {why}"
    named = "says" if is_rectified else "does not say"
    flag = "--no-rectified" if is_rectified else "--rectified"
    return (
        f"the camera is {used} of {topic}, since the name {image_topic} {named} that the images are rectified; with "
        f"{flag} it is {other}"
    )
