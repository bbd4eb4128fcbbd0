"""Text files as people and editors write them: UTF-8 with or without a byte order mark, or UTF-16 with one.

Every text file of a user is opened here. Lines end as anywhere (LF, CRLF, CR), without their ends.
"""

import codecs
import re
from collections.abc import Iterator
from pathlib import Path

_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # begins with the mark of UTF-16
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_UNMARKED_UTF16 = re.compile(rb"[\t\n\r -~]\0[\t\n\r -~]\0|\0[\t\n\r -~]\0[\t\n\r -~]")
_LONGEST_MARK = 4
_LINE_END = re.compile(rb"\r\n|\r|\n")


def decode_text(data: bytes, name: str) -> str:
    """The text of a file's bytes, without a byte order mark; ValueError names the file and the line that is no text."""
    encoding = _encoding(data[:_LONGEST_MARK], name)
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        if not encoding.startswith("utf-8"):
            raise ValueError(
                f"{name} is not the text in {encoding.upper()} that its byte order mark announces; save it as UTF-8"
            ) from None
        # The line itself is not shown: files of tokens and settings are read here, too.
        before = _LINE_END.split(error.object[: error.start])
        raise ValueError(
            f"{name}:{len(before)}: is not text in UTF-8: byte 0x{error.object[error.start]:02x} after "
            f"{len(before[-1])} others of the line; save the file as UTF-8"
        ) from None


def read_text(file: Path) -> str:
    """The text of a file; ValueError names the file and the line that is no text, OSError if it cannot be read."""
    return decode_text(file.read_bytes(), str(file))


def without_mark(text: str) -> str:
    """A text that was decoded elsewhere, as an argument of a command, without a byte order mark."""
    return text.removeprefix("\ufeff")


def numbered_lines(file: Path) -> Iterator[tuple[int, str]]:
    """Yields number and text of each line, of files of any size; ValueError and OSError as in `read_text`."""
    with file.open("rb") as stream:
        encoding = _encoding(stream.read(_LONGEST_MARK), str(file))
    try:
        with file.open(encoding=encoding) as text:  # its lines end as above; those of `str.splitlines` at more
            for number, line in enumerate(text, 1):
                yield number, line.rstrip("\n")
    except UnicodeDecodeError:
        decode_text(file.read_bytes(), str(file))
        raise


def _encoding(head: bytes, name: str) -> str:
    for mark, encoding in _MARKS:
        if head.startswith(mark):
            return encoding
    if _UNMARKED_UTF16.match(head):
        raise ValueError(f"{name} is UTF-16 without a byte order mark: save it as UTF-8")
    return "utf-8"
