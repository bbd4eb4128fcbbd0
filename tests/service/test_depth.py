"""Measured depth through a server: kept with its reference, read with photographs, or refused by its field."""

from dataclasses import replace

import numpy as np
import pytest
from support.depths import png
from support.servers import CAMERA, PHOTO, pose

from mapless import (
    Client,
    DepthImage,
    DepthNoise,
    DepthSensor,
    InvalidArgument,
    NewReference,
    RigidTransform,
    RigImage,
    SequenceFrame,
)
from mapless.geometry import rotation_from_vector

STEPS = np.full((CAMERA.height_px, CAMERA.width_px), 1500, np.uint16)
DEPTH = DepthImage(
    png(STEPS),
    0.001,
    sensor=DepthSensor.STEREO,
    camera=replace(CAMERA, focal_x_px=CAMERA.focal_x_px * 1.1),
    camera_from_depth_camera=RigidTransform(rotation_from_vector([0.1, 0.2, 0.3]), np.array([0.02, 0.0, 0.001])),
    confidence=png(np.full(STEPS.shape, 2, np.uint8)),
    noise=DepthNoise(0.002, 0.0, 0.0, 0.01),
)


def new(depth: DepthImage | None = DEPTH, name: str = "deep") -> NewReference:
    return NewReference(name, PHOTO, CAMERA, pose(5.0), depth=depth)


def test_a_depth_is_kept_with_its_reference(client: Client, scene: str) -> None:
    stored = client.add_reference(scene, new())
    assert (stored.depth, len(stored.depth_sha256)) == (None, 64)
    found = client.get_reference(scene, "deep", include_image=True)
    assert found.depth is not None
    assert found.depth.sha256 == found.depth_sha256 == stored.depth_sha256
    assert (found.depth.data, found.depth.confidence) == (DEPTH.data, DEPTH.confidence)
    assert client.get_reference(scene, "deep").depth is None
    plain = client.get_reference(scene, "r0", include_image=True)
    assert (plain.depth, plain.depth_sha256) == (None, "")


@pytest.mark.parametrize(
    ("depth", "field"),
    [
        (replace(DEPTH, data=png(np.zeros_like(STEPS))), "depth"),
        (replace(DEPTH, data=png(STEPS[:-1])), "depth.intrinsics"),
        (replace(DEPTH, data=DEPTH.data[:-20]), "depth.png"),
        (replace(DEPTH, unit_m=0.0), "depth.unit_m"),
    ],
    ids=["all zero", "another size", "cut", "no unit"],
)
def test_a_wrong_depth_stores_nothing(client: Client, scene: str, depth: DepthImage, field: str) -> None:
    with pytest.raises(InvalidArgument) as raised:
        client.add_references(scene, [new(None, "good"), new(depth)])
    assert raised.value.field == f"requests[1].reference.{field}"
    assert "good" not in {it.reference_id for it in client.list_references(scene)}


def test_millimetres_taken_for_metres_are_warned_of(client: Client, scene: str) -> None:
    warnings = client.add_reference(scene, new(replace(DEPTH, unit_m=1.0))).warnings
    assert any("median depth of reference 'deep' is 1500 m, outside 0.05 to 200 m" in it for it in warnings)


def test_no_depth_is_implausible_in_an_arbitrary_unit(client: Client, scene: str) -> None:
    client.update_scene(scene, arbitrary_unit=True)
    warnings = client.add_reference(scene, new(replace(DEPTH, unit_m=1.0))).warnings
    assert not any("median depth" in it for it in warnings)


def test_answers_of_photographs_with_depth_have_a_depth_check(client: Client, scene: str) -> None:
    assert client.localize(PHOTO, CAMERA, scene, depth=DEPTH).diagnostics.depth_check is not None
    assert client.localize(PHOTO, CAMERA, scene).diagnostics.depth_check is None
    images = [RigImage(PHOTO, CAMERA, pose(0.0), depth=depth) for depth in (DEPTH, None)]
    reports = client.localize_rig(images, scene).images
    assert [it.diagnostics.depth_check is None for it in reports] == [False, True]


@pytest.mark.parametrize(
    ("change", "field", "reason"),
    [
        ({"data": png(STEPS[:-1])}, "intrinsics", "DEPTH_SIZE"),
        ({"data": png(STEPS.astype(np.uint8))}, "png", "DEPTH_UNSUPPORTED"),
        ({"confidence": png(np.full((9, 9), 2, np.uint8))}, "confidence", "DEPTH_SIZE"),
        ({"unit_m": 0.0}, "unit_m", "INVALID_ARGUMENT"),
    ],
    ids=["another size", "8 bits", "confidence of another size", "no unit"],
)
def test_a_wrong_depth_of_a_photograph_is_refused(
    client: Client, scene: str, change: dict[str, object], field: str, reason: str
) -> None:
    depth = replace(DEPTH, **change)  # type: ignore[arg-type]
    with pytest.raises(InvalidArgument) as raised:
        client.localize(PHOTO, CAMERA, scene, depth=depth)
    assert (raised.value.field, raised.value.reason) == (f"depth.{field}", reason)
    frames = [SequenceFrame(PHOTO, CAMERA, pose(0.0), depth=it) for it in (None, depth)]
    with pytest.raises(InvalidArgument) as raised:
        client.localize_sequence(frames, scene)
    assert raised.value.field == f"frames[1].depth.{field}"
