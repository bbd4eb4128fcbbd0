"""The depth that a sensor measured with a reference as bytes, without loss.

    byte 0       format version
    bytes 4..8   length of the header, uint32
    header       JSON (all but the bytes, and the length of the values)
    values       the PNG; or zlib of the four bytes of all float32 values, the lowest first
    confidence   the PNG

Everything is little-endian.
"""

import json
import struct
import zlib
from dataclasses import asdict

import numpy as np

from mapless.depth import DepthImage, DepthNoise, DepthSensor
from mapless.geometry import RigidTransform

from . import codec

DEPTH_IMAGE_FORMAT_VERSION = 1


def encode_depth_image(depth: DepthImage) -> bytes:
    """A measured depth image, without loss; its checksum is `DepthImage.sha256`."""
    pose, data = depth.camera_from_depth_camera, depth.data
    if depth.size is not None:
        data = zlib.compress(np.frombuffer(data, np.uint8).reshape(-1, 4).T.tobytes())
    header = codec.to_json(
        {
            "unit_m": depth.unit_m,
            "size": depth.size,
            "sensor": depth.sensor.value,
            "camera": depth.camera and codec.camera_to_dict(depth.camera),
            "camera_from_depth_camera": pose
            and {name: it.tolist() for name, it in vars(pose).items() if name[0] != "_"},
            "min_confidence": depth.min_confidence,
            "noise": depth.noise and asdict(depth.noise),
            "length": len(data),
        }
    )
    return b"".join([codec.PREFIX.pack(DEPTH_IMAGE_FORMAT_VERSION, len(header)), header, data, depth.confidence])


def decode_depth_image(blob: object, sha256: str) -> DepthImage:
    """The depth image that `encode_depth_image` was given.

    Damaged if the checksum or the form of the data is wrong, or the format is unknown.
    """
    if not isinstance(blob, bytes):
        raise codec.Damaged("depth")
    try:
        version, header_length = codec.PREFIX.unpack_from(blob)
        if version != DEPTH_IMAGE_FORMAT_VERSION:
            raise codec.Damaged(f"depth (format {version} is unknown)")
        begin = codec.PREFIX.size + header_length
        header = json.loads(blob[codec.PREFIX.size : begin])
        end = begin + header.pop("length")
        data, size, pose, noise = blob[begin:end], header["size"], header["camera_from_depth_camera"], header["noise"]
        if size is not None:
            data = np.frombuffer(zlib.decompress(data), np.uint8).reshape(4, -1).T.tobytes()
        found = DepthImage(
            data,
            header["unit_m"],
            size and tuple(size),
            DepthSensor(header["sensor"]),
            header["camera"] and codec.camera_from_dict(header["camera"]),
            pose and RigidTransform(np.array(pose["rotation"]), np.array(pose["translation"])),
            blob[end:],
            header["min_confidence"],
            noise and DepthNoise(**noise),
        )
        is_whole = found.sha256 == sha256
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError, struct.error, zlib.error) as error:
        raise codec.Damaged("depth (of an unknown form)") from error
    if not is_whole:
        raise codec.Damaged("depth")
    return found
