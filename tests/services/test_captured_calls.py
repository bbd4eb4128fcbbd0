"""A captured call is read as it was written, or is refused with a sentence; no content of a file does anything else."""

import hashlib
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.captures import NOW_S, POSE, a_call

from mapless.geodesy import Datum
from mapless_server.scenes import Choice, RankedReference
from mapless_server.services.capture.calls import CapturedPart, CaptureError, decode_call, encode_call
from mapless_server.store import SceneAttributes

ODD_VALUES: tuple[Any, ...] = (
    *(math.nan, math.inf, -math.inf, 1e300, 10**400, -1, 0, True, None, NOW_S),
    *("", "..", "/", "\ud800", "\0", "acme/../other", [], [[]], {}, {"a": {}}, ["acme"], [float("nan")], "x" * 300),
)


def with_header(data: bytes, change: Callable[[dict[str, Any]], object]) -> bytes:
    """The file of a call with another header, and the digest of that."""
    header, _, messages = data[32:].partition(b"\n")
    content = json.loads(header)
    change(content)
    body = json.dumps(content).encode() + b"\n" + messages
    return hashlib.sha256(body).digest() + body


def test_a_call_is_read_as_it_was_written() -> None:
    """To the last bit, NaN among the similarities too, with a choice for each descriptor."""
    ranked = tuple(RankedReference(f"r{i}", f"key-{i}", value, POSE) for i, value in enumerate((1 / 3, float("nan"))))
    attributes = SceneAttributes(Datum(47.1, 8.2, 400.3), (0.0, 0.0, -1.0))
    choices = Choice(ranked, "vlad-1", 3), Choice(ranked[:1], "vlad-2", 3)
    parts = (CapturedPart("images[0].image", 3, {"r0": "key-0"}, choices), CapturedPart("b", 4, {}))
    call = replace(a_call(), attributes=attributes, parts=parts, circumstances={"mapless": "1"}, response=b"\x00\xff")
    data = encode_call(call)
    read = decode_call(data)
    assert encode_call(read) == data
    assert (read.request, read.response, read.attributes) == (call.request, call.response, attributes)
    assert [it.references for it in read.parts] == [{"r0": "key-0"}, {}]
    assert [it.descriptor for it in read.parts[0].choices] == ["vlad-1", "vlad-2"]
    first = read.parts[0].choices[0].references[0]
    assert (first.reference_id, first.key, first.similarity) == ("r0", "key-0", 1 / 3)
    np.testing.assert_array_equal(first.world_from_camera.matrix(), POSE.matrix())


def test_a_call_that_is_cut_or_changed_is_refused() -> None:
    data = encode_call(a_call(size=50))
    for end in (0, 3, 17, 60, -33, -1):
        with pytest.raises(CaptureError, match="cut or damaged"):
            decode_call(data[:end])
    for position in range(0, len(data), 7):
        changed = bytearray(data)
        changed[position] ^= 4
        with pytest.raises(CaptureError, match="cut or damaged"):
            decode_call(bytes(changed))


def test_a_call_of_version_0_3_is_read() -> None:
    """Its references' cameras, poses and copies are not needed."""

    def as_format_1(header: dict[str, Any]) -> None:
        header |= {"format": 1, "scene_created_us": 5}
        (reference,) = header["parts"][0]["references"]
        reference |= {"image": "0" * 64, "views": {"sift": "1" * 64}, "camera": {}, "world_from_camera": {}}

    call = a_call()
    read = decode_call(with_header(encode_call(call), as_format_1))
    assert encode_call(read) == encode_call(call)


def test_a_call_of_a_later_version_says_what_reads_it() -> None:
    data = with_header(encode_call(a_call()), lambda header: header.update(format=3))
    with pytest.raises(
        CaptureError, match=r"format 3, .* up to 2: replay it with the version of mapless that captured"
    ):
        decode_call(data)


def places_in(content: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of each of the values in a header, the inner ones too."""
    inner = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for name, it in inner:
        yield (*path, name)
        yield from places_in(it, (*path, name))


def test_any_value_in_a_header_is_read_or_refused() -> None:
    """With a correct digest; names and times that a report could not show are refused."""
    choice = Choice((RankedReference("r0", "key-0", 0.5, POSE),), "vlad-1", 3)
    data = encode_call(replace(a_call(), parts=(CapturedPart("image", 3, {"r0": "key-0"}, (choice,)),)))
    for place in places_in(json.loads(data[32:].partition(b"\n")[0])):
        for value in ODD_VALUES:

            def change(header: Any, place: tuple[Any, ...] = place, value: Any = value) -> None:
                for name in place[:-1]:
                    header = header[name]
                header[place[-1]] = value

            try:
                read = decode_call(with_header(data, change))
            except CaptureError:
                continue
            assert place not in (("tenant",), ("scene_id",))
            assert place != ("time_s",) or 0 <= read.time_s < 1e10 or read.time_s == -1
