"""Depth images of references: what a message says of them, their bytes, and how they are kept.

Laws: a refusal names a field of the depth; what is accepted has the size of its values, each of which is above 0 or
unknown, and one at least is known, with an error within bounds; it comes back from the store and over the wire as it
was.
"""

from __future__ import annotations

from functools import cache
from random import Random

import numpy as np
from support.depths import png

from mapless.depth import (
    LEAST_SIGMA,
    MOST_SIGMA,
    DepthImage,
    DepthNoise,
    DepthSensor,
    depth_from_message,
    depth_to_message,
)
from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless.v1 import geometry_pb2 as pb
from mapless.wire import FieldError
from mapless_server.errors import InvalidArgument
from mapless_server.images import ImageLimits, check_depth, decode_depth
from mapless_server.store.depth_images import decode_depth_image, encode_depth_image

from . import messages
from .images import with_mended_checksums
from .laws import check_pose, check_received_camera
from .target import MutateBytes, Target

FIELD = "depth"
KINDS = (pb.DepthImage,)
CAMERA = Camera(44, 33, 40.0, 40.0, 21.5, 16.0)
PHOTO = 2 * CAMERA.width_px, 2 * CAMERA.height_px
LIMITS = ImageLimits(max_pixels=128 * 128, max_depth_pixels=64 * 64)
"""Small, so that a million are decoded; what is larger takes the same way."""


def check(data: bytes) -> bool:
    """See Target."""
    message = messages.decoded(KINDS, data)
    if message is None:
        return False
    assert isinstance(message, pb.DepthImage)
    try:
        depth = depth_from_message(message, FIELD)
        check_depth(depth, PHOTO, LIMITS, FIELD)
        values = decode_depth(depth, PHOTO, LIMITS, FIELD)
    except (FieldError, InvalidArgument) as error:
        assert f"{error.field}.".startswith(f"{FIELD}."), error.field
        assert len(str(error)) < 400
        return False
    assert values.dtype == np.float32
    assert values.size <= LIMITS.max_depth_pixels
    assert depth.size is None or depth.size == values.shape[::-1]
    known = values[~np.isnan(values)].astype(np.float64)
    assert len(known)
    assert (known > 0).all()
    assert np.isfinite(known).all()
    assert decode_depth_image(encode_depth_image(depth), depth.sha256).sha256 == depth.sha256
    assert depth_from_message(depth_to_message(depth), FIELD).sha256 == depth.sha256
    if depth.camera is not None:
        check_received_camera(depth.camera)
    if depth.camera_from_depth_camera is not None:
        check_pose(depth.camera_from_depth_camera)
    assert depth.noise is None or depth.noise.bounded() == depth.noise
    sigma = depth.known_noise.relative_sigma(known)
    assert (sigma >= LEAST_SIGMA).all()
    assert (sigma <= MOST_SIGMA).all()
    return True


@cache
def seeds() -> tuple[bytes, ...]:
    """Both kinds of values, with all that may be said of them."""
    random = np.random.default_rng(3)
    steps = random.integers(500, 4000, (CAMERA.height_px, CAMERA.width_px)).astype(np.uint16)
    steps[:4], steps[4:8] = 0, 65535
    metres = (steps / 1000).astype(np.float32)
    metres[8, :3] = np.nan, np.inf, 0
    pose = RigidTransform(rotation_from_vector([0.1, 0.05, 0.3]), np.array([0.05, 0.0, 0.01]))
    confidence = png(random.integers(0, 3, steps.shape).astype(np.uint8))
    made = (
        DepthImage(png(steps), 0.001),
        DepthImage(png(steps), 0.0002, sensor=DepthSensor.STRUCTURED_LIGHT, confidence=confidence, min_confidence=2),
        DepthImage(png(steps), 0.001, camera=CAMERA, camera_from_depth_camera=pose, noise=DepthNoise(0.01, 0.01)),
        DepthImage.of_metres(metres, DepthSensor.PHONE_LIDAR),
    )
    return tuple(messages.encoded(KINDS, depth_to_message(it)) for it in made)


def mutate(data: bytes, random: Random, mutate_bytes: MutateBytes) -> bytes:
    """Changes fields; or bytes of a PNG, whose checksums are mostly corrected, so that its rows are read."""
    message = messages.decoded(KINDS, data)
    if not isinstance(message, pb.DepthImage) or random.random() < 0.5:
        return messages.mutate(KINDS, data, random, mutate_bytes)
    name = "confidence" if message.confidence and random.random() < 0.4 else message.WhichOneof("values") or "png"
    changed = mutate_bytes(getattr(message, name))
    setattr(message, name, with_mended_checksums(changed) if random.random() < 0.8 else changed)
    return messages.encoded(KINDS, message)


TARGET = Target(seeds, check, mutate, max_bytes=16384, words=(b"IHDR", b"IDAT", b"IEND", b"acTL", b"tRNS"))
