"""Inputs that are the contents of a folder's files, and folders in memory that they are written to.

Which files there are is the layout's matter: an input is one byte that chooses the layout, then the contents, file
after file, with a line between them that no format has. Nothing in an input can name a file to be written.
"""

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from random import Random

from .target import MutateBytes

MEMORY_VARIABLE = "FUZZ_MEMORY"
"""Environment variable: where folders are made for a process that ends without clearing up, as libFuzzer does."""

SEPARATOR = b"\n\xff\xfe\xff\n"
_NUMBERS = (
    b"nan -inf 1e400 1e308 1e-320 -0 0 0.1 1 -1 2147483648 4294967296 18446744073709551616 0x10 1_0 1e5 .5 "
    b'99999999999999999999999999 1e154 1.7976931348623157e308 \xd9\xa3 true null [] {} "" [[[]]]'
).split(b" ")
_TEXTS = (
    b"..",
    b"../x.png",
    b"/etc/passwd",
    b"a" * 300,
    b"\0",
    b"\x1b[2J",
    b"\\ud800",
    b"\xc2\xa0",
    b"\xe2\x80\xa8",
    b"\n",
)


def joined(number: int, contents: Sequence[bytes]) -> bytes:
    """The input of a layout's number and its contents."""
    return bytes([number]) + SEPARATOR.join(contents)


def split(data: bytes) -> tuple[int, list[bytes]]:
    """The inverse, whatever the input."""
    return (data[0] if data else 0), data[1:].split(SEPARATOR)


def mutate(data: bytes, random: Random, mutate_bytes: MutateBytes) -> bytes:
    """Changes one of an input's files: its bytes, or one of its words for another number or text."""
    number, contents = split(data)
    chosen = random.randrange(len(contents))
    content, kind = contents[chosen], random.random()
    if kind < 0.4:
        contents[chosen] = mutate_bytes(content)
    elif kind < 0.9:
        contents[chosen] = _with_other_word(content, random)
    elif kind < 0.95:
        contents[chosen] = content[: random.randrange(len(content) + 1)]
    elif kind < 0.97:
        number = random.randrange(256)
    else:
        lines = content.splitlines(keepends=True) or [b""]
        line = random.randrange(len(lines))
        contents[chosen] = b"".join([*lines[: line + 1], *lines[line:]])
    return joined(number, contents)


def _with_other_word(content: bytes, random: Random) -> bytes:
    """The content with one run of characters that are neither space nor punctuation of JSON replaced."""
    if not content:
        return random.choice(_NUMBERS)
    at = random.randrange(len(content))
    start = end = at
    while start > 0 and content[start - 1] not in b' \t\n",:[]{}/=':
        start -= 1
    while end < len(content) and content[end] not in b' \t\n",:[]{}/=':
        end += 1
    return content[:start] + random.choice(_NUMBERS if random.random() < 0.7 else _TEXTS) + content[end:]


def memory() -> Path | None:
    """Where folders are made: in memory where the system has such a place; None for the usual place."""
    given = os.environ.get(MEMORY_VARIABLE)
    place = Path(given) if given else Path("/dev/shm")
    return place if place.is_dir() else None


class Folder:
    """A folder in memory, which goes with the process; files are written where their content has changed."""

    def __init__(self, name: str) -> None:
        self._temporary = tempfile.TemporaryDirectory(prefix="fuzz-", dir=memory())
        self.path = Path(self._temporary.name) / name
        self._written: dict[str, bytes] = {}

    def write(self, files: Sequence[str], contents: Sequence[bytes]) -> None:
        """Writes the files; those for which there is no content are not there."""
        for i, name in enumerate(files):
            content = contents[i] if i < len(contents) else None
            if content == self._written.get(name):
                continue
            file = self.path / name
            if content is None:
                file.unlink()
                del self._written[name]
                continue
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
            self._written[name] = content
