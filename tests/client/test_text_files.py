"""Text files as editors write them: byte order marks, ends of lines, and what is no text."""

from pathlib import Path

import pytest

from mapless.text_files import numbered_lines, read_text

TEXT = "one ä\ntwo\n\nfour"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_marked_encodings_and_ends_of_lines_are_read(tmp_path: Path, encoding: str, end: str) -> None:
    file = tmp_path / "it.txt"
    file.write_bytes(TEXT.replace("\n", end).encode(encoding))
    assert list(numbered_lines(file)) == list(enumerate(TEXT.split("\n"), 1))
    assert read_text(file).replace(end, "\n") == TEXT


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"a\r\nb\nr\xe9f.jpg 1\n", ":3: is not text in UTF-8: byte 0xe9 after 1 others"),
        (b"a\rb\r\xe9", ":3: is not text in UTF-8: byte 0xe9 after 0 others"),
        ("abc".encode("utf-16-le"), " is UTF-16 without a byte order mark: save it as UTF-8"),
        ("abc".encode("utf-16-be"), " is UTF-16 without a byte order mark: save it as UTF-8"),
        (b"\xff\xfea", " is not the text in UTF-16 that its byte order mark announces"),
    ],
)
def test_what_is_no_text_is_named_with_its_line(tmp_path: Path, data: bytes, says: str) -> None:
    file = tmp_path / "it.txt"
    file.write_bytes(data)
    for read in (read_text, lambda it: list(numbered_lines(it))):
        with pytest.raises(ValueError, match=r"it\.txt") as error:
            read(file)
        assert str(error.value).startswith(f"{file}{says}")


def test_a_fault_far_into_a_long_file_has_its_line(tmp_path: Path) -> None:
    (tmp_path / "long.txt").write_bytes(b"word\n" * 100_000 + b"\xe9\n")
    with pytest.raises(ValueError, match=r"long\.txt:100001: "):
        list(numbered_lines(tmp_path / "long.txt"))


def test_a_secret_is_not_shown_with_a_fault(tmp_path: Path) -> None:
    (tmp_path / "token").write_bytes(b"mapless_xyz\xe9")
    with pytest.raises(ValueError, match="byte 0xe9") as error:
        read_text(tmp_path / "token")
    assert "xyz" not in str(error.value)
