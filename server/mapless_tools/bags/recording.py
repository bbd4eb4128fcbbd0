"""Messages of a recording: a folder of rosbag2, or one of its files (.mcap, .db3).

Standard messages are the same in every version of ROS 2, so they are read by the definitions of one version, not by
those in the recording: many recordings have no definitions, or unreadable ones of messages that are not needed.
"""

from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
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
"""Explanations that follow a message of the library, by a text in it."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """A message with its topic and time of recording; None if it is damaged. `where` is for error messages."""

    topic: str
    time_ns: int
    message: Any
    where: str


class Recording:
    """A recording, open until its block ends; `types` and `counts` are each topic's type and number of messages.

    Bad messages among good ones are skipped: `skipped` has the reason of each by its place, for each topic.
    """

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
        self.skipped: dict[str, dict[str, str]] = {}
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

    def skip(self, recorded: Recorded, reason: str) -> None:
        """Counts a message that cannot be used; the same one may be read, and skipped, several times."""
        self.skipped.setdefault(recorded.topic, {})[recorded.where] = reason

    def skipped_lines(self) -> list[str]:
        """A line for each topic of which messages were skipped."""
        found = []
        for topic, reasons in self.skipped.items():
            where, reason = next(iter(reasons.items()))
            found.append(
                f"{len(reasons)} of {self.counts[topic]} messages of {topic} cannot be used and are skipped, the "
                f"first: {where}: {reason}"
            )
        return found

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """Yields messages in the order of recording, damaged ones, too, which are skipped by this.

        ValueError names what is wrong with the file.
        """
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
            try:
                message = self.typestore.deserialize_cdr(data, connection.msgtype)
            except Exception as error:  # of any kind, as `_named` says
                damaged = Recorded(connection.topic, time_ns, None, where)
                self.skip(damaged, f"damaged: {str(error).rstrip('.') or type(error).__name__}")
                yield damaged
                continue
            yield Recorded(connection.topic, time_ns, message, where)
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


class Unusable(Exception):
    """A message cannot be used, and may be skipped; the message is the reason."""


def stamp_of(message: Any) -> int:
    """Stamp of a message's header, nanoseconds; Unusable without one."""
    stamp_ns = int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)
    if not stamp_ns:
        raise Unusable("it has no time: header.stamp is 0")
    return stamp_ns


def check_order(stamp_ns: int, previous_ns: int, where: str) -> None:
    """Raises ValueError, naming where it is, if time jumps back."""
    if stamp_ns < previous_ns - MAX_JUMP_BACK_NS:
        back_s = (previous_ns - stamp_ns) / 1e9
        raise ValueError(
            f"{where}: time jumps back by {back_s:.3f} s, from {seconds(previous_ns)} to {seconds(stamp_ns)}; cut the "
            "recording there"
        )


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
