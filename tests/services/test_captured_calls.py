"""A captured call is read as it was written, or is damaged; whatever its file says, it is deleted in time."""

import hashlib
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.captures import (
    CAMERA,
    IMAGES,
    NOW_S,
    POSE,
    ROOM,
    a_call,
    blobs_of,
    files,
    opened,
    reference,
    write_one,
)

from mapless.geodesy import Datum
from mapless_server.scenes import Choice, RankedReference
from mapless_server.services.capture import folder as folder_module
from mapless_server.services.capture.calls import (
    CapturedPart,
    CaptureError,
    DamagedCapture,
    decode_call,
    encode_call,
)
from mapless_server.services.capture.files import write_whole
from mapless_server.store import SceneAttributes

ODD_VALUES: tuple[Any, ...] = (
    *(math.nan, math.inf, -math.inf, 1e300, -1e300, 10**400, -1, 0, True, None, NOW_S + 61, NOW_S + 59),
    *("", "..", "/", "\ud800", "\0", "acme/../other", [], [[]], {}, {"a": {}}, ["acme"], [float("nan")], "x" * 300),
)


def test_a_call_is_read_as_it_was_written() -> None:
    """To the last bit, NaN among the similarities too."""
    ranked = tuple(RankedReference(f"r{i}", f"key-{i}", value, POSE) for i, value in enumerate((1 / 3, float("nan"))))
    attributes = SceneAttributes(Datum(47.1, 8.2, 400.3), (0.0, 0.0, -1.0))
    choices = Choice(ranked, "vlad-1", 3), Choice(ranked[:1], "vlad-2", 3)
    parts = (CapturedPart("images[0].image", 3, (reference(1),), choices), CapturedPart("b", 4, ()))
    call = replace(a_call(), attributes=attributes, parts=parts, circumstances={"mapless": "1"}, response=b"\x00\xff")
    data = encode_call(call)
    read = decode_call(data)
    assert encode_call(read) == data
    assert (read.request, read.response, read.attributes) == (call.request, call.response, attributes)
    assert [it.descriptor for it in read.parts[0].choices] == ["vlad-1", "vlad-2"]
    first = read.parts[0].references[0]
    assert first.camera == CAMERA
    np.testing.assert_array_equal(first.world_from_camera.matrix(), POSE.matrix())


@pytest.mark.parametrize("end", [0, 3, 17, 60, -33, -1])
def test_a_call_that_is_cut_is_damaged(end: int) -> None:
    with pytest.raises(DamagedCapture):
        decode_call(encode_call(a_call())[:end])


def test_a_call_with_a_bit_changed_is_damaged() -> None:
    data = encode_call(a_call(size=50))
    for position in range(0, len(data), 7):
        changed = bytearray(data)
        changed[position] ^= 4
        with pytest.raises(CaptureError):
            decode_call(bytes(changed))


def with_header(data: bytes, change: Callable[[dict[str, Any]], object]) -> bytes:
    """The file of a call with another header, and the digest of that."""
    header, _, messages = data[32:].partition(b"\n")
    content = json.loads(header)
    change(content)
    body = json.dumps(content).encode() + b"\n" + messages
    return hashlib.sha256(body).digest() + body


def places_in(content: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Of each of the values in a header, the inner ones too."""
    inner = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for name, it in inner:
        yield (*path, name)
        yield from places_in(it, (*path, name))


def set_at(place: tuple[Any, ...], value: Any, content: Any) -> None:
    for name in place[:-1]:
        content = content[name]
    content[place[-1]] = value


def test_no_header_keeps_a_call_beyond_its_time(tmp_path: Path) -> None:
    """Any value of it is changed to anything, with a correct digest: the call is deleted at once, or on time."""
    now_s, kept = [NOW_S], 0
    path = tmp_path / "c"
    folder = opened(path)
    call = replace(
        a_call(size=10), parts=(CapturedPart("image", 7, (replace(reference(0), views={"a": f"{1:064x}"}),)),)
    )
    folder.add(call, blobs_of(call))
    (entry,) = folder.entries()
    folder.close()
    data = entry.path.read_bytes()
    places = list(places_in(json.loads(data[32:].partition(b"\n")[0])))
    random = np.random.default_rng(0)
    for place in places:
        is_vital = place in (("tenant",), ("scene_id",), ("time_s",))
        for index in range(len(ODD_VALUES)) if is_vital else random.choice(len(ODD_VALUES), 1).tolist():
            now_s[0] = NOW_S
            changed = with_header(data, partial(set_at, place, ODD_VALUES[index]))
            write_whole(entry.path, changed)
            for blob in entry.blobs:
                write_whole(blob, IMAGES[blob.name])
            try:
                folder = opened(path, clock=lambda: now_s[0])
            except CaptureError as error:  # of a format to come
                assert "its format" in str(error)  # noqa: PT017
                continue
            kept += len(folder.entries())
            now_s[0] += ROOM.keep_s + 60
            assert 0 < folder.expire() <= ROOM.keep_s
            assert (files(path), len(folder.entries()), folder.disk_bytes) == ([], 0, 0)
            folder.close()
    assert kept > 10


def test_a_call_of_another_scene_than_its_place_says_is_deleted(tmp_path: Path) -> None:
    """It would remain after its scene was deleted."""
    entry = write_one(tmp_path / "c")
    write_whole(entry.path, with_header(entry.path.read_bytes(), lambda header: header.update(scene_id="other")))
    folder = opened(tmp_path / "c")
    assert files(tmp_path / "c") == []
    folder.close()


def test_calls_of_the_same_moment_do_not_replace_each_other(tmp_path: Path) -> None:
    """As of two servers, one after the other, with the same process id, when the clock is set back between."""
    for count in (1, 2, 3):
        folder = opened(tmp_path / "c")
        folder.add(a_call(count, ()), {})
        assert len(folder.entries()) == len(files(tmp_path / "c")) == count
        folder.close()


def test_an_oversized_file_is_deleted_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may be larger than the memory."""
    entry = write_one(tmp_path / "c")
    with entry.path.open("r+b") as file:
        file.truncate(ROOM.max_bytes + 1)
    monkeypatch.setattr(folder_module, "decode_call", lambda _: pytest.fail("read"))
    folder = opened(tmp_path / "c")
    assert files(tmp_path / "c") == []
    folder.close()
