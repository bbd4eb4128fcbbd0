"""Encoding and decoding of the database's columns of bytes.

Laws: whatever is encoded comes back to the bit; bytes that are not what was stored, or that belong to another row, are
Damaged, and so is what has the right checksum and another form; nothing else is raised.
"""

from __future__ import annotations

import struct
from datetime import datetime, timezone

import numpy as np

from mapless.geodesy import Datum
from mapless.geometry import Camera, Fisheye, Quaternion, RadialTangential, RigidTransform
from mapless.scenes import Calibration
from mapless_server.method.views import Features, View
from mapless_server.store import ContradictingDown, SceneAttributes, codec

from . import folders
from .localization import POSE
from .target import Target

OWNER, OTHER = "scene a", "scene b"
_CAMERAS = (
    Camera(32, 33, 30.0, 31.0, 15.5, 16.25),
    Camera(640, 480, 1e-3, 1e300, -1.5, 0.1, RadialTangential(0.1, -0.2, 1e-9, 0.0, 5e-324)),
    Camera(16384, 32, 500.0, 500.0, 0.0, 0.0, Fisheye(0.1, 0.2, 0.3, 0.4)),
)
_ATTRIBUTES = SceneAttributes(
    Datum(48.0, 11.5, 520.0, Quaternion(0.0, 0.0, 0.0, 1.0)),
    (0.0, 0.0, -1.0),
    Calibration(
        1.0, 2.0, 3.0, 4.0, 5, "sift", "geometric", "BEST", "0.1.0", datetime(2026, 11, 21, tzinfo=timezone.utc)
    ),
)


def check(data: bytes) -> bool:
    """See Target."""
    kind, contents = folders.split(data)
    content = contents[0]
    if kind % 4 == 0:
        return _check_read(content)
    if kind % 4 == 1:
        return _check_geometry(content)
    if kind % 4 == 2:
        return _check_view(content)
    return _check_attributes(contents)


def _check_read(data: bytes) -> bool:
    """Bytes from the disk: whatever they are, with a checksum of their own, of others, and of others' rows."""
    readers = (codec.decode_geometry, codec.decode_attributes, codec.decode_view)
    sha256 = codec.sha256_for(OWNER, data)
    for reader in readers:
        for owner, found in ((OTHER, data), (OWNER, data + b" "), (OWNER, data[1:])):
            if (owner, found) != (OWNER, data):
                assert _read(reader, owner, found, sha256) is None
        assert _read(reader, OWNER, data.decode(errors="replace"), sha256) is None
    whole = [_read(reader, OWNER, data, sha256) for reader in readers]
    return any(it is not None for it in whole)


def _read(reader: object, owner: str, data: object, sha256: str) -> object:
    try:
        return reader(owner, data, sha256)  # type: ignore[operator]
    except codec.Damaged:
        return None


def _floats(content: bytes, count: int) -> list[float]:
    padded = (content + bytes(8 * count))[: 8 * count]
    return list(struct.unpack(f"<{count}d", padded))


def _check_geometry(content: bytes) -> bool:
    numbers = _floats(content, 21)
    lens = (None, RadialTangential(*numbers[4:9]), Fisheye(*numbers[4:8]))[len(content) % 3]
    focal_x_px, focal_y_px, x_px, y_px = numbers[:4]
    camera = Camera(len(content), 33, focal_x_px, focal_y_px, x_px, y_px, lens)
    pose = RigidTransform(np.reshape(numbers[9:18], (3, 3)), np.array(numbers[18:21]))
    used = [*numbers[:4], *(vars(lens).values() if lens else ()), *numbers[9:]]
    try:
        encoded = codec.encode_geometry(camera, pose)
    except ValueError:
        assert not np.isfinite(used).all()
        return False
    assert np.isfinite(used).all()
    again, its_pose = codec.decode_geometry(OWNER, encoded, codec.sha256_for(OWNER, encoded))
    assert again == camera
    assert its_pose.rotation.tobytes() == pose.rotation.tobytes()
    assert its_pose.translation.tobytes() == pose.translation.tobytes()
    (alone,) = codec.decode_poses([encoded])
    assert alone.matrix().tobytes() == pose.matrix().tobytes()
    _check_damage(codec.decode_geometry, encoded, content)
    return True


def _check_view(content: bytes) -> bool:
    dimension = 1 + len(content) % 5
    count = len(content) // (4 * (3 + dimension))
    floats = np.frombuffer(content, "<f4", count * (3 + dimension)).astype(np.float32)
    keypoints, sizes, descriptors = np.split(floats, [2 * count, 3 * count])
    features = Features(keypoints.reshape(-1, 2), descriptors.reshape(-1, dimension), sizes)
    view = View(_CAMERAS[len(content) % 3], features)
    encoded = codec.encode_view(view)
    again = codec.decode_view(OWNER, encoded, codec.sha256_for(OWNER, encoded))
    assert again.camera == view.camera
    for name in ("keypoints", "sizes_px", "descriptors"):
        assert getattr(again.features, name).tobytes() == getattr(features, name).tobytes()
    _check_damage(codec.decode_view, encoded, content)
    try:
        descriptor = codec.encode_descriptor(floats)
    except ValueError:
        with np.errstate(over="ignore"):
            assert not count or not np.isfinite(floats.astype(np.float16)).all()
        return False
    (vector,) = codec.decode_descriptors([descriptor])
    assert (vector == floats.astype(np.float16)).all()
    return True


def _check_attributes(contents: list[bytes]) -> bool:
    numbers = _floats(contents[0], 14)
    texts = [content.decode(errors="replace") for content in [*contents[1:], b"", b"", b"", b""][:4]]
    try:
        attributes = SceneAttributes(
            Datum(numbers[0], numbers[1], numbers[2], Quaternion(*numbers[3:7])),
            (numbers[7], numbers[8], numbers[9]) if len(texts[0]) % 2 else None,
            Calibration(*numbers[10:14], len(contents[0]), *texts),  # type: ignore[call-arg, arg-type]
        )
    except (ContradictingDown, ValueError):
        return False
    if not np.isfinite(numbers[7:10]).all() and attributes.down_in_world:
        return False  # `unit_vector` makes directions
    encoded = codec.encode_attributes(attributes)
    assert encoded is not None
    assert codec.decode_attributes(OWNER, encoded, codec.sha256_for(OWNER, encoded)) == attributes
    _check_damage(codec.decode_attributes, encoded, contents[0])
    return True


def _check_damage(reader: object, encoded: bytes, content: bytes) -> None:
    """One byte that is another, wherever it is."""
    sha256 = codec.sha256_for(OWNER, encoded)
    at = sum(content) % len(encoded)
    damaged = bytearray(encoded)
    damaged[at] ^= 1 + len(content) % 255
    assert _read(reader, OWNER, bytes(damaged), sha256) is None


def seeds() -> list[bytes]:
    """What the store holds, and the numbers that it is made of."""
    features = Features(np.ones((2, 2), np.float32), np.ones((2, 3), np.float32), np.ones(2, np.float32))
    attributes = codec.encode_attributes(_ATTRIBUTES)
    assert attributes is not None
    stored = [
        *(codec.encode_geometry(it, POSE) for it in _CAMERAS),
        codec.encode_view(View(_CAMERAS[2], features)),
        attributes,
    ]
    datum = struct.pack("<14d", 48, 11.5, 520, 0, 0, 0, 1, 0, 0, -1, 1, 2, 3, 4)
    numbers = struct.pack("<21d", *range(9), *POSE.rotation.ravel(), *POSE.translation)
    return [
        *(b"\0" + it for it in stored),
        b"\1" + numbers,
        b"\2" + np.arange(48, dtype="<f4").tobytes(),
        folders.joined(3, [datum, b"sift", b"geometric", b"BEST", b"0.1.0"]),
    ]


TARGET = Target(
    seeds,
    check,
    folders.mutate,
    max_bytes=4096,
    words=(b'"camera"', b'"distortion"', b'"model"', b'"fisheye"', b"null", b"NaN", b'"world_from_camera"', b'"count"')
    + tuple(struct.pack("<d", it) for it in (0.0, 1.0, -1.0, 1e308, 5e-324, float("nan"), float("inf"))),
)
