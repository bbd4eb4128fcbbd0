"""Cameras, poses, features, matches and scene attributes as bytes: exact to the bit, and checked when they are read.

Geometry and scene attributes are JSON text: Python writes the shortest decimal that reads back as the same float64. A
view is one blob:

    byte 0       format version
    bytes 4..8   length of the header, uint32
    header       JSON (camera, count, dimension, upright_deg unless 0), padded with spaces: the arrays are aligned
    arrays       keypoints (N, 2), sizes (N,), descriptors (N, D)

In format 1 the arrays are float32. In format 2 descriptors have 8 bits, keypoints are 24-bit multiples of the header's
step from its origin, and sizes are float16: 136 bytes a keypoint with 128 numbers instead of 524. The step is a power
of two, the smallest that spans the photograph: 2^-14 px up to 1024 px. Rounded sizes change the noise of a keypoint by
at most 0.05 %.

A global descriptor is its numbers as float16: similarities of unit vectors change by less than 0.001. Matches are the
numbers of their keypoints, int32.

A depth map is its logarithm in steps of 1 %, which err by 0.3 %; 0 is no depth. Holes are filled with what is before
them, and marked by bits. A pixel is predicted from three neighbours, as on a plane, and the differences compressed:

    byte 0       format version
    bytes 4..8   length of the header, uint32
    header       JSON (camera, the first step's logarithm, relative_sigma)
    zlib         the three bytes of all differences, the lowest first; bits of the pixels with a depth

Everything is little-endian.
"""

import hashlib
import json
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapless.geodesy import Datum
from mapless.geometry import Camera, Quaternion, RigidTransform
from mapless.lenses import LENS_MODELS, Distortion, lens_model_of
from mapless.provenance import GIVEN_POSE, Provenance, provenance_from_json, provenance_to_json
from mapless.scenes import AdoptionPolicy, Calibration
from mapless_server.method.features.views import Features, KeptDepth, Matches, View

from .attributes import SceneAttributes, SelfCalibration

VIEW_FORMAT_VERSION, SMALL_VIEW_FORMAT_VERSION = 1, 2
DEPTH_FORMAT_VERSION = 1
_DEPTH_STEP = 0.01
_LARGEST_STEP = 60_000
PREFIX = struct.Struct("<B3xI")
_ALIGNMENT_BYTES = 16
_FLOAT32 = np.dtype("<f4")
_FLOAT16 = np.dtype("<f2")
_INT32 = np.dtype("<i4")
_STEPS = 2**24


class Damaged(Exception):
    """Stored bytes are damaged."""


def sha256_for(owner: str, data: bytes) -> str:
    """Hexadecimal SHA-256 of `data` and its owner, so that bytes of another row fail the check."""
    digest = hashlib.sha256(owner.encode() + b"\0")
    digest.update(data)
    return digest.hexdigest()


def encode_geometry(camera: Camera, world_from_camera: RigidTransform, provenance: Provenance = GIVEN_POSE) -> bytes:
    """Camera, pose and how the pose is known as JSON; ValueError if a number is not finite.

    A given pose of unknown accuracy is written as servers before 0.4 write it, who do not read the rest either.
    """
    pose = {"rotation": world_from_camera.rotation.tolist(), "translation": world_from_camera.translation.tolist()}
    known = provenance_to_json(provenance)
    content = {"camera": camera_to_dict(camera), "world_from_camera": pose}
    return to_json(content if known is None else content | {"provenance": known})


def decode_geometry(owner: str, data: bytes, sha256: str) -> tuple[Camera, RigidTransform, Provenance]:
    """The camera, pose and provenance that `encode_geometry` was given; read-only arrays.

    Damaged if the checksum or the form of the data is wrong.
    """
    with _checked(owner, data, sha256, "camera and pose"):
        content = json.loads(data)
        pose = content["world_from_camera"]
        rotation, translation = np.array(pose["rotation"], float), np.array(pose["translation"], float)
        rotation.setflags(write=False)
        translation.setflags(write=False)
        provenance = provenance_from_json(content.get("provenance"))
        return camera_from_dict(content["camera"]), RigidTransform(rotation, translation), provenance


def encode_attributes(attributes: SceneAttributes) -> bytes | None:
    """Scene attributes as JSON; None if there are none."""
    if attributes == SceneAttributes():
        return None
    content = asdict(attributes)
    if not attributes.self_calibrations:  # which are stored apart from these, and captured together
        del content["self_calibrations"]
    if not attributes.contradiction:  # likewise
        del content["contradiction"]
    if attributes.adoption is None:  # as before schema 14
        del content["adoption"]
    if attributes.calibration is not None and attributes.calibration.create_time is not None:
        content["calibration"]["create_time"] = attributes.calibration.create_time.isoformat()
    return to_json(content)


def decode_attributes(owner: str, data: bytes | None, sha256: str | None) -> SceneAttributes:
    """The attributes that `encode_attributes` was given; Damaged if the checksum or the form of the data is wrong."""
    if data is None and sha256 is None:
        return SceneAttributes()
    with _checked(owner, data, sha256 or "", "datum, down and calibration"):
        assert data is not None
        content = json.loads(data)
        datum, down, calibration = content["datum"], content["down_in_world"], content["calibration"]
        if calibration and calibration["create_time"]:
            calibration["create_time"] = datetime.fromisoformat(calibration["create_time"])
        return SceneAttributes(
            Datum(**{**datum, "enu_from_world": Quaternion(**datum["enu_from_world"])}) if datum else None,
            tuple(down) if down else None,
            Calibration(**calibration) if calibration else None,
            content.get("arbitrary_unit", False),  # which 0.2.0 did not write
            tuple(_calibration_from_dict(it) for it in content.get("self_calibrations", ())),
            content.get("contradiction", ""),
            AdoptionPolicy(**content["adoption"]) if content.get("adoption") else None,
        )


def encode_calibration(calibration: SelfCalibration) -> bytes:
    """A self-calibration as JSON; ValueError if a number is not finite."""
    return to_json(asdict(calibration))


def decode_calibration(owner: str, data: bytes, sha256: str) -> SelfCalibration:
    """The self-calibration that `encode_calibration` was given.

    Damaged if the checksum or the form of the data is wrong.
    """
    with _checked(owner, data, sha256, "calibration"):
        return _calibration_from_dict(json.loads(data))


def encode_view(view: View) -> bytes:
    """Processed camera and features as one blob, of format 2 if descriptors have 8 bits.

    ValueError if an array is not float32 (storing it would round it), or a number is not finite.
    """
    features = view.features
    if features.descriptors.dtype.itemsize == 1:
        return _encode_small_view(view)
    arrays = (features.keypoints, features.sizes_px, features.descriptors)
    if any(array.dtype != np.float32 for array in arrays):
        raise ValueError(f"features must be float32, are {', '.join(str(array.dtype) for array in arrays)}")
    return _blob(VIEW_FORMAT_VERSION, view, {}, [array.astype(_FLOAT32, copy=False) for array in arrays])


def _encode_small_view(view: View) -> bytes:
    features = view.features
    keypoints = features.keypoints.astype(np.float64)
    if not np.isfinite(keypoints).all():
        raise ValueError("a keypoint's coordinate is not finite")
    origin = np.floor(keypoints.min(axis=0, initial=0.0))
    span = float((keypoints - origin).max(initial=1.0))
    step = 2.0 ** (np.frexp(span)[1] - 24)
    steps = np.minimum(np.rint((keypoints - origin) / step), _STEPS - 1).astype("<u4", order="C")
    sizes = np.clip(features.sizes_px, 0, np.finfo(_FLOAT16).max).astype(_FLOAT16)
    kind = "histogram" if features.descriptors.dtype == np.uint8 else "direction"
    how = {"kind": kind, "origin": origin.tolist(), "step": step}
    packed = steps.view(np.uint8).reshape(-1, 4)[:, :3]
    return _blob(SMALL_VIEW_FORMAT_VERSION, view, how, [packed, sizes, features.descriptors])


def _blob(version: int, view: View, how: dict[str, Any], arrays: Sequence[NDArray[Any]]) -> bytes:
    count, dimension = view.features.descriptors.shape
    if view.upright_deg:
        how = how | {"upright_deg": view.upright_deg}
    header = to_json({"camera": camera_to_dict(view.camera), "count": count, "dimension": dimension} | how)
    header += b" " * (-(PREFIX.size + len(header)) % _ALIGNMENT_BYTES)
    return b"".join([PREFIX.pack(version, len(header)), header, *(array.tobytes() for array in arrays)])


def decode_view(owner: str, blob: bytes, sha256: str) -> View:
    """The view that `encode_view` was given, apart from the rounding of format 2; read-only arrays.

    Damaged if the checksum does not match, or the format is unknown.
    """
    with _checked(owner, blob, sha256, "features"):
        version, header_length = PREFIX.unpack_from(blob)
        if version not in (VIEW_FORMAT_VERSION, SMALL_VIEW_FORMAT_VERSION):
            raise Damaged(f"features (format {version} is unknown)")
        offset = PREFIX.size + header_length
        header = json.loads(blob[PREFIX.size : offset])
        count, dimension = header["count"], header["dimension"]
        if version == SMALL_VIEW_FORMAT_VERSION:
            features = _small_features(blob[offset:], header, count, dimension)
        else:
            floats = np.frombuffer(blob, _FLOAT32, offset=offset)
            keypoints, sizes_px, descriptors = np.split(floats, [2 * count, 3 * count])
            features = Features(keypoints.reshape(count, 2), descriptors.reshape(count, dimension), sizes_px)
        return View(camera_from_dict(header["camera"]), features, upright_deg=header.get("upright_deg", 0.0))


def _small_features(body: bytes, header: dict[str, Any], count: int, dimension: int) -> Features:
    if len(body) != count * (8 + dimension):
        raise ValueError("it has another length than its header says")
    padded = np.zeros((2 * count, 4), np.uint8)
    padded[:, :3] = np.frombuffer(body, np.uint8, 6 * count).reshape(-1, 3)
    steps = padded.view("<u4").reshape(count, 2).astype(np.float64)
    keypoints = (np.array(header["origin"]) + header["step"] * steps).astype(np.float32)
    sizes_px = np.frombuffer(body, _FLOAT16, count, 6 * count).astype(np.float32)
    kind: Any = {"histogram": np.uint8, "direction": np.int8}[header["kind"]]
    descriptors = np.frombuffer(body, kind, offset=8 * count).reshape(count, dimension).copy()
    for array in (keypoints, sizes_px, descriptors):
        array.setflags(write=False)
    return Features(keypoints, descriptors, sizes_px)


def decode_poses(geometries: Sequence[bytes]) -> list[RigidTransform]:
    """The poses of many encoded geometries, whose checksums must have been checked; read-only arrays."""
    # One call for all is faster than one for each.
    poses = [it["world_from_camera"] for it in json.loads(b"[" + b",".join(geometries) + b"]")]
    rotations = np.array([pose["rotation"] for pose in poses], float)
    translations = np.array([pose["translation"] for pose in poses], float)
    rotations.setflags(write=False)
    translations.setflags(write=False)
    return list(map(RigidTransform, rotations, translations))


def encode_descriptor(vector: NDArray[np.float32]) -> bytes:
    """A global descriptor, rounded to float16.

    ValueError if it is not a vector, is empty, or a number is not finite as float16.
    """
    if vector.ndim != 1 or not len(vector):
        raise ValueError(f"a global descriptor must be a vector, has shape {vector.shape}")
    with np.errstate(over="ignore"):
        rounded = vector.astype(_FLOAT16)
    if not np.isfinite(rounded).all():
        raise ValueError("a global descriptor's number is not finite, or too large for float16")
    return rounded.tobytes()


def decode_descriptors(blobs: Sequence[bytes]) -> list[NDArray[np.float32]]:
    """Many global descriptors, whose checksums must have been checked; read-only arrays."""
    if not blobs:
        return []
    if len(set(map(len, blobs))) > 1:  # only if two descriptors were given the same name
        return [decode_descriptors([blob])[0] for blob in blobs]
    vectors = np.frombuffer(b"".join(blobs), _FLOAT16).reshape(len(blobs), -1).astype(np.float32)
    vectors.setflags(write=False)
    return [*vectors]


def encode_matches(matches: Matches) -> bytes:
    """Matches (M, 2) of the keypoints of two views."""
    return matches.astype(_INT32).tobytes()


def decode_matches(owner: str, data: bytes, sha256: str) -> Matches:
    """The matches that `encode_matches` was given; read-only.

    Damaged if the checksum or the form of the data is wrong.
    """
    with _checked(owner, data, sha256, "matches"):
        return np.frombuffer(data, _INT32).reshape(-1, 2)


def encode_depth(kept: KeptDepth) -> bytes:
    """A depth map, rounded to 1 %.

    ValueError if a depth is not above 0, or the farthest is e^600 times as far as the nearest.
    """
    known = np.isfinite(kept.depth)
    if not (kept.depth[known] > 0).all():
        raise ValueError(f"a stored depth must be above 0, the smallest is {kept.depth[known].min():.3g}")
    logarithm = np.log(kept.depth, where=known, out=np.zeros(kept.depth.shape), dtype=np.float64)
    first = float(logarithm[known].min(initial=np.inf)) if known.any() else 0.0
    steps = np.where(known, np.rint((logarithm - first) / _DEPTH_STEP), 0).astype(np.int64)
    if steps.max(initial=0) > _LARGEST_STEP:
        raise ValueError("kept depths must not differ by so much")
    before = np.maximum.accumulate(np.where(known.ravel(), np.arange(known.size), 0))
    filled = steps.ravel()[before].reshape(steps.shape)
    differences = np.diff(np.diff(filled, axis=1, prepend=0), axis=0, prepend=0)
    words = ((differences << 1) ^ (differences >> 63)).astype("<u4")  # small ones of either sign as small numbers
    planes = words.reshape(-1, 1).view(np.uint8).reshape(-1, 4).T[:3]
    header = to_json({"camera": camera_to_dict(kept.camera), "first": first, "sigma": kept.relative_sigma})
    body = zlib.compress(planes.tobytes() + np.packbits(known).tobytes(), 9)
    return b"".join([PREFIX.pack(DEPTH_FORMAT_VERSION, len(header)), header, body])


def decode_depth(owner: str, blob: bytes, sha256: str) -> KeptDepth:
    """The depth map that `encode_depth` was given, rounded; read-only.

    Damaged if the checksum or the form of the data is wrong, or the format is unknown.
    """
    with _checked(owner, blob, sha256, "depth"):
        version, header_length = PREFIX.unpack_from(blob)
        if version != DEPTH_FORMAT_VERSION:
            raise Damaged(f"depth (format {version} is unknown)")
        offset = PREFIX.size + header_length
        header = json.loads(blob[PREFIX.size : offset])
        camera = camera_from_dict(header["camera"])
        shape = camera.height_px, camera.width_px
        size = shape[0] * shape[1]
        data = np.frombuffer(zlib.decompress(blob[offset:]), np.uint8)
        low, middle, high = data[: 3 * size].reshape(3, *shape).astype(np.int64)
        words = low | middle << 8 | high << 16
        steps = ((words >> 1) ^ -(words & 1)).cumsum(axis=0).cumsum(axis=1)
        known = np.unpackbits(data[3 * size :], count=size).reshape(shape).astype(bool)
        depth = np.where(known, np.exp(header["first"] + _DEPTH_STEP * steps), np.nan).astype(np.float32)
        depth.setflags(write=False)
        return KeptDepth(camera, depth, header["sigma"])


def check(owner: str, data: object, sha256: str, what: str) -> None:
    """Raises Damaged unless these are the bytes that were stored for this owner."""
    # One flipped bit can make SQLite take a blob for text, so the type is checked, too.
    if not isinstance(data, bytes) or sha256_for(owner, data) != sha256:
        raise Damaged(what)


@contextmanager
def _checked(owner: str, data: object, sha256: str, what: str) -> Iterator[None]:
    """Raises Damaged as of `check`, and for data that have a correct checksum, but a wrong form."""
    check(owner, data, sha256, what)
    try:
        yield
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError, struct.error, zlib.error) as error:
        raise Damaged(f"{what} (of an unknown form)") from error


def to_json(content: dict[str, Any]) -> bytes:
    """Compact JSON; ValueError if a number is not finite."""
    return json.dumps(content, allow_nan=False, separators=(",", ":")).encode()


def _calibration_from_dict(content: dict[str, Any]) -> SelfCalibration:
    lists = {name: tuple(value) for name, value in content.items() if isinstance(value, list)}
    return SelfCalibration(**(content | lists))


def camera_to_dict(camera: Camera) -> dict[str, Any]:
    """A camera as values of JSON, its lens with the name of the model."""
    content = asdict(camera)
    if camera.distortion is not None:
        content["distortion"] = {"model": lens_model_of(camera.distortion), **asdict(camera.distortion)}
    return content


def camera_from_dict(content: dict[str, Any]) -> Camera:
    """The camera that `camera_to_dict` was given."""
    distortion: Distortion | None = None
    if content["distortion"] is not None:
        parameters = dict(content["distortion"])
        distortion = LENS_MODELS[parameters.pop("model")](**parameters)
    return Camera(**{**content, "distortion": distortion})
