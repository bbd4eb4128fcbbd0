"""The depths of a camera in a recording: of one topic, each the nearest in time to a photograph."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from mapless.depth import DepthSensor
from mapless.ros import CameraInfos
from mapless.ros.depths import METRES, MILLIMETRES, RosDepth

from .images import CAMERA_INFO, IMAGES, Images, camera_infos, first_message, known_topic, listed
from .recording import Recording, Unusable, stamp_of

MAX_GAP_NS = 20_000_000
"""A hand-held camera moves millimetres in that time; depth cameras take 30 images a second."""
_TRANSPORT = "/compressedDepth"


@dataclass(frozen=True, eq=False)
class BagDepths:
    """The depths of a topic, in a frame; `infos` is None where they have no CameraInfo."""

    recording: Recording
    topic: str
    frame: str
    infos: CameraInfos | None

    def nearest(self, stamps_ns: Sequence[int]) -> Iterator[tuple[int, RosDepth]]:
        """Yields stamps of photographs, which are sorted, with their depth; a nearer one may come after another."""
        gaps_ns: dict[int, int] = {}
        for it in self.recording.messages([self.topic]):
            if it.message is None:
                continue
            try:
                stamp_ns = stamp_of(it.message)
            except Unusable as error:
                self.recording.skip(it, str(error))
                continue
            first = bisect_left(stamps_ns, stamp_ns - MAX_GAP_NS)
            for photo_ns in stamps_ns[first : bisect_right(stamps_ns, stamp_ns + MAX_GAP_NS)]:
                gap_ns = abs(photo_ns - stamp_ns)
                if gap_ns < gaps_ns.get(photo_ns, MAX_GAP_NS + 1):
                    gaps_ns[photo_ns] = gap_ns
                    camera = None if self.infos is None else self.infos.at(stamp_ns)
                    yield photo_ns, RosDepth(it.message, camera, DepthSensor.UNKNOWN)


def open_depths(images: Images, wanted: str) -> BagDepths | None:
    """Opens the depths of a topic, or of the only one in the images' frame, or of the only one; None without any.

    ValueError if there are several, there is no such topic, or its CameraInfo has no camera.
    """
    recording = images.recording
    frames = _frames(images, known_topic(recording, wanted, recording.topics(*IMAGES), "depths") if wanted else "")
    aligned = [topic for topic, frame in frames.items() if frame == images.frame]
    topics = aligned or list(frames)
    if not topics:
        return None
    if len(topics) > 1:
        raise ValueError(f"they are on {listed(topics)}: choose with --depth-topic")
    (topic,) = topics
    infos_topic = f"{topic.removesuffix(_TRANSPORT).rpartition('/')[0]}/camera_info"
    has_infos = recording.types.get(infos_topic) == CAMERA_INFO
    infos = camera_infos(recording, infos_topic, topic, None)[0] if has_infos else None
    return BagDepths(recording, topic, frames[topic], infos)


def _frames(images: Images, wanted: str) -> dict[str, str]:
    """Frames of the topics that show depths, by their first messages, or of the wanted one."""
    known = images.recording.topics(*IMAGES)
    found = {}
    for topic in [wanted] if wanted else known:
        if topic == images.topic or topic.removesuffix(_TRANSPORT) in (known if topic.endswith(_TRANSPORT) else ()):
            continue
        message = first_message(images.recording, topic)
        encoding = message.encoding if hasattr(message, "encoding") else ""
        if wanted or encoding in (MILLIMETRES, METRES) or _TRANSPORT.strip("/") in getattr(message, "format", ""):
            found[topic] = message.header.frame_id.lstrip("/") or images.frame
    return found
