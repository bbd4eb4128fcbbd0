"""Messages of a recording: a folder of rosbag2, or one of its files (.mcap, .db3).

Standard messages are the same in every version of ROS 2, so they are read by the definitions of one version, not by
those in the recording: many recordings have no definitions, or unreadable ones of messages that are not needed.
"""

from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from . import storages

MAX_JUMP_BACK_NS = 500_000_000
"""How much earlier a stamp may be than one before it: messages of several threads are a little out of order."""

_HINTS = (
    ("end magic", ": it is truncated; `mcap recover` saves what can be read"),
    ("Profile is not ros2", ": only recordings of ROS 2 are read"),
)
"""What to say after a message of the library that has a text."""


class Recording:
    """A recording, open until its block ends; `types` and `counts` are each topic's type and number of messages."""

    def __init__(self, path: Path) -> None:
        """Opens a recording; raises ValueError, with the file's name, if it cannot be opened."""
        self.path = path
        self.typestore = get_typestore(Stores.ROS2_HUMBLE)
        self._stack = ExitStack()
        with self._named():
            self._reader = self._stack.enter_context(Reader(_openable(path)))
            connections = [it for it in self._reader.connections if it.msgcount]
            self._connections = connections
        self.types = {it.topic: it.msgtype for it in connections}
        self.counts = {name: sum(it.msgcount for it in connections if it.topic == name) for name in self.types}

    def __enter__(self) -> "Recording":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._stack.close()

    def topics(self, *types: str) -> list[str]:
        """Topics whose messages have one of these types."""
        return sorted(name for name, kind in self.types.items() if kind in types)

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Yields topic, time of recording (ns) and message in that order; ValueError names what is damaged."""
        connections = [it for it in self._connections if it.topic in topics]
        if not connections:
            return
        seen = dict.fromkeys(topics, 0)
        where = "before its first message"
        with self._named():
            stream = self._reader.messages(connections)
        while True:
            with self._named(f"after {where}" if any(seen.values()) else where):
                found = next(stream, None)
            if found is None:
                break
            connection, time_ns, data = found
            seen[connection.topic] += 1
            where = f"message {seen[connection.topic]} of {connection.topic}, recorded at {seconds(time_ns)}"
            with self._named(where):
                message = self.typestore.deserialize_cdr(data, connection.msgtype)
            yield connection.topic, time_ns, message
        for topic in topics:
            if seen[topic] < self.counts.get(topic, 0):
                raise ValueError(
                    f"{self.path} is damaged: it holds {seen[topic]} of {self.counts[topic]} messages of {topic}"
                )

    @contextmanager
    def _named(self, where: str = "") -> Iterator[None]:
        """Converts the library's errors, of any kind if bytes are damaged, to one that names the file."""
        try:
            yield
        except Exception as error:
            place = f" {where}" if where else ""
            what = str(error).rstrip(".") or type(error).__name__
            hint = next((hint for part, hint in _HINTS if part in what), "")
            raise ValueError(f"{self.path} cannot be read{place}: {what}{hint}") from error


def stamp_of(message: Any, previous_ns: int | None, what: str) -> int:
    """Stamp of a message's header, nanoseconds; ValueError, naming `what` it is, without one or if time jumps back."""
    stamp_ns = int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)
    if not stamp_ns:
        raise ValueError(f"{what} has no time: header.stamp is 0")
    if previous_ns is not None and stamp_ns < previous_ns - MAX_JUMP_BACK_NS:
        back_s = (previous_ns - stamp_ns) / 1e9
        raise ValueError(
            f"{what}: time jumps back by {back_s:.3f} s, from {seconds(previous_ns)} to {seconds(stamp_ns)}; cut the "
            "recording there"
        )
    return stamp_ns


def seconds(time_ns: int) -> str:
    """A time in the form that tools for recordings print."""
    return f"{time_ns // 1_000_000_000}.{time_ns % 1_000_000_000:09d} s"


def _openable(path: Path) -> Path:
    """The folder, or its only file if the recorder was stopped before it wrote metadata.yaml."""
    files = [path] if path.is_file() else storages(path)
    for file in files:
        _check_whole(file)
    if path.is_file() or (path / "metadata.yaml").is_file():
        return path
    if len(files) != 1:
        raise ValueError(f"no metadata.yaml beside {len(files)} files; `ros2 bag reindex` writes it")
    return files[0]


def _check_whole(file: Path) -> None:
    """Raises ValueError if an SQLite file is shorter than its header says; missing pages would be read as zeros."""
    with file.open("rb") as stream:
        head = stream.read(100)
    if head.startswith(b"SQLite format 3\0"):
        page_bytes = int.from_bytes(head[16:18], "big")
        expected = int.from_bytes(head[28:32], "big") * (65536 if page_bytes == 1 else page_bytes)
        if (size := file.stat().st_size) < expected:
            raise ValueError(f"{file.name} is truncated: {size} of {expected} bytes; `sqlite3 .recover` saves a part")
