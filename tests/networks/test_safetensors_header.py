"""Headers of safetensors files: other formats are refused by name, damage never passes."""

import gzip
import io
import math
import os
import pickle
import re
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.safetensors_files import entry, safetensors, with_header

from mapless_server.networks.weights import (
    CheckpointError,
)
from mapless_server.networks.weights.safetensors_header import Header, opened, read_header

CONTENT = safetensors({"a.weight": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.zeros(2, np.float16)})


def header_of(content: bytes, folder: Path) -> Header:
    path = folder / "file.safetensors"
    path.write_bytes(content)
    return read_header(path)


def test_a_header_has_types_and_shapes_in_the_order_of_bytes(tmp_path: Path) -> None:
    header = header_of(CONTENT, tmp_path)
    assert [(name, it.dtype, it.shape) for name, it in header.entries.items()] == [
        ("a.weight", "F32", (2, 3)),
        ("b", "F16", (2,)),
    ]
    assert header.size_bytes == len(CONTENT) - 28


def test_a_header_length_like_a_pickles_magic_is_accepted(tmp_path: Path) -> None:
    content = with_header({"__metadata__": {"filler": "x" * (0x0280 - 30)}})
    assert content[:2] == b"\x80\x02"
    assert header_of(content, tmp_path).entries == {}


def zip_archive() -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("data.pkl", b"")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (zip_archive(), "not a safetensors file: it is a zip archive, as PyTorch's pickles are"),
        *((pickle.dumps([1] * 40, protocol), "it is a pickle") for protocol in (2, 3, 4, 5)),
        (b"<!doctype html><html>", "it is a web page"),
        (b"version https://git-lfs.github.com/spec/v1\n", "it is a Git LFS pointer"),
        (gzip.compress(CONTENT), "it is gzip"),
        (b"\x05", "not a safetensors file"),
        (b"\xff" * 7 + b"\x7f{", "header is damaged: header too large"),
        (CONTENT[:60], "cut short within its header"),
        (CONTENT[:-1], "cut short, or longer than its tensors"),
        (CONTENT + b"!", "cut short, or longer than its tensors"),
        (with_header(b'{"a":'), "damaged"),
        (with_header(b'{"a":' * 50_000), "damaged"),
        (with_header({"a": {"dtype": "F32", "shape": [2]}}), "header is damaged: .*data_offsets"),
        (with_header({"a": entry(shape=(-2,))}, bytes(8)), "header is damaged: .*-2"),
        (with_header({"a": entry(shape=(3,))}, bytes(8)), "header is damaged: invalid shape"),
        (with_header({"a": entry(begin=8, end=16)}, bytes(16)), "header is damaged: invalid offset for tensor `a`"),
        (with_header({"a": entry(), "b": entry(begin=4, end=12)}, bytes(12)), "invalid offset for tensor `b`"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_other_formats_are_refused_by_name(content: bytes, words: str, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError) as caught:
        header_of(content, tmp_path)
    assert re.search(words, str(caught.value))
    assert "file.safetensors" in str(caught.value)
    assert "\n" not in str(caught.value)


@given(position=st.integers(0, len(CONTENT) - 1), byte=st.integers(0, 255), length=st.integers(0, len(CONTENT)))
def test_a_damaged_file_is_read_or_raises_checkpoint_error(position: int, byte: int, length: int) -> None:
    content = (CONTENT[:position] + bytes([byte]) + CONTENT[position + 1 :])[:length]
    with tempfile.TemporaryDirectory() as folder:
        try:
            header = header_of(content, Path(folder))
        except CheckpointError:
            return
    item_bytes = {"F64": 8, "I64": 8, "F32": 4, "I32": 4, "F16": 2, "I16": 2, "U16": 2, "BF16": 2}
    data = sum(math.prod(it.shape) * item_bytes[it.dtype] for it in header.entries.values())
    assert header.size_bytes + data == len(content)


def test_an_unreadable_file_is_reported(tmp_path: Path) -> None:
    file = tmp_path / "file.safetensors"
    file.touch()
    file.chmod(0)
    user = os.geteuid()
    if user == 0:  # root may read everything
        os.seteuid(65534)
    try:
        with pytest.raises(CheckpointError, match="Permission denied"), opened(file):
            pass
    finally:
        os.seteuid(user)
