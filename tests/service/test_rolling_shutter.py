"""Photographs of moving cameras with a rolling shutter, through a server that computes with compiled code."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.corner import CAMERA, make_corner, picture, pose
from support.images import encode
from support.servers import serving_really

from mapless import Client, IntrinsicsUncertainty, LocalizationResult, RigidTransform
from mapless.geometry import rotation_from_vector
from mapless_server.kernels import adjustment

THERE = pose(2.0)
PAN_RAD = 0.05
"""Rotation during the read-out: 90 degrees/s in 33 ms."""
SHUTTER = IntrinsicsUncertainty(readout_s=0.033)
BAND_PX = 4


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    settings: dict[str, Any] = {"features": "sift", "backend": "geometric", "background_matching": False}
    with serving_really(tmp_path_factory.mktemp("corner"), **settings) as server, Client(server.address) as client:
        make_corner(client, [pose(angle) for angle in (-25, -15, -5, 5, 15, 25)])
        yield client


def panned(world_from_camera: RigidTransform, pan_rad: float) -> bytes:
    """A PNG whose bands of rows are read one after the other, from the top, while the camera turns about its y axis."""
    bands = []
    for row in range(0, CAMERA.height_px, BAND_PX):
        share = (row + BAND_PX / 2) / CAMERA.height_px - 0.5
        turned = RigidTransform(rotation_from_vector([0.0, share * pan_rad, 0.0]), np.zeros(3))
        camera = replace(CAMERA, height_px=BAND_PX, principal_y_px=CAMERA.principal_y_px - row)
        bands.append(picture(world_from_camera.compose(turned), camera))
    return encode(".png", np.concatenate(bands))


def localized(client: Client, image: bytes, uncertainty: IntrinsicsUncertainty | None) -> tuple[float, float]:
    """The error of the position and its radius of 95 %, metres."""
    answer = client.localize(image, CAMERA, "corner", intrinsics_uncertainty=uncertainty)
    assert isinstance(answer, LocalizationResult), answer
    assert answer.accuracy is not None
    return math.dist(answer.world_from_camera.translation, THERE.translation), answer.accuracy.position_95_m


def test_a_server_removes_a_pan_by_the_read_out_time(client: Client) -> None:
    moving = panned(THERE, PAN_RAD)
    without_m, _ = localized(client, moving, None)
    found_m, radius_m = localized(client, moving, SHUTTER)
    assert found_m < 0.2 * without_m
    assert found_m < radius_m


@pytest.mark.skipif(not adjustment.IS_COMPILED, reason="not compiled")
def test_compiled_and_plain_code_answer_a_pan_alike(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    """The motion is six unknowns beside the pose, more than errors of the intrinsics are."""
    moving = panned(THERE, PAN_RAD)
    compiled = localized(client, moving, SHUTTER)
    monkeypatch.setattr(adjustment, "IS_COMPILED", False)
    assert localized(client, moving, SHUTTER) == pytest.approx(compiled, rel=0.02)
