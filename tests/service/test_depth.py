"""Measured depth through a server: stored and returned with its reference, or refused by its field."""

from dataclasses import replace

import numpy as np
import pytest
from support.depths import png
from support.servers import CAMERA, PHOTO, pose

from mapless import Client, DepthImage, DepthNoise, DepthSensor, InvalidArgument, NewReference, RigidTransform
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
    assert any("median depth of reference 'deep' is 1.5e+03" in it for it in warnings)


def test_no_depth_is_implausible_in_an_arbitrary_unit(client: Client, scene: str) -> None:
    client.update_scene(scene, arbitrary_unit=True)
    warnings = client.add_reference(scene, new(replace(DEPTH, unit_m=1.0))).warnings
    assert not any("median depth" in it for it in warnings)
