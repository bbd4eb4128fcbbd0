"""The adapter of PoseLib's generalized solvers: conventions and determinism, by planted poses."""

import ctypes

import numpy as np
import pytest
from support.compare import assert_pose_close
from support.scenes import CAMERA, random_for

from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.method.groups.generalized import CameraMatches, inlier_count, rig_ransac, scaled_ransac
from mapless_server.method.pnp import PnpOptions

OPTIONS = PnpOptions()
WORLD_FROM_RIG = RigidTransform(rotation_from_vector([0.3, -0.2, 0.5]), np.array([1.0, -2.0, 3.0]))


def planted(
    random: np.random.Generator, counts: tuple[int, ...], wrong_share: float = 0.0, unit: float = 1.0
) -> list[CameraMatches]:
    """Cameras that look all ways, with so many matches each; `unit` of the rig's frame in metres."""
    cameras = []
    for count in counts:
        rig_from_camera = RigidTransform(rotation_from_vector(random.normal(0, 1, 3)), random.normal(0, 0.3, 3))
        pixels = random.uniform([0, 0], [CAMERA.width_px, CAMERA.height_px], (count, 2))
        x_in_camera = CAMERA.rays(pixels) * random.uniform(3, 8, (count, 1))
        x_in_world = WORLD_FROM_RIG.compose(rig_from_camera).apply(x_in_camera)
        pixels = pixels + random.normal(0, 0.3, pixels.shape)
        wrong = random.permutation(count)[: round(wrong_share * count)]
        pixels[wrong] = random.uniform([0, 0], [CAMERA.width_px, CAMERA.height_px], (len(wrong), 2))
        fixed = RigidTransform(rig_from_camera.rotation, rig_from_camera.translation / unit)
        cameras.append(CameraMatches(CAMERA, fixed, pixels, x_in_world))
    return cameras


@pytest.mark.parametrize("wrong_share", [0.0, 0.5])
def test_rig_ransac_finds_the_planted_pose(wrong_share: float) -> None:
    cameras = planted(random_for("rig", wrong_share), (60, 40, 80), wrong_share)
    found = rig_ransac(cameras, OPTIONS)
    assert found is not None
    assert_pose_close(found, WORLD_FROM_RIG, metres=0.005, degrees=0.05)
    assert inlier_count(cameras, found, OPTIONS.inlier_px) >= round(180 * (1 - wrong_share))


@pytest.mark.parametrize("unit", [0.37, 1.0, 25.0])
def test_scaled_ransac_finds_the_planted_pose_and_scale(unit: float) -> None:
    """Metres per unit, not units per metre."""
    cameras = planted(random_for("scaled", unit), (60, 60, 60), 0.5, unit)
    found = scaled_ransac(cameras, OPTIONS, 2000, 600)
    assert found is not None
    assert found.scale == pytest.approx(unit, rel=0.03)
    assert_pose_close(RigidTransform(found.rotation, found.translation), WORLD_FROM_RIG, metres=0.05, degrees=0.5)


@pytest.mark.parametrize("counts", [(), (2,), (1, 1)])
def test_too_few_matches_have_no_pose(counts: tuple[int, ...]) -> None:
    cameras = planted(random_for("few"), counts)
    assert rig_ransac(cameras, OPTIONS) is None
    assert not cameras or scaled_ransac(cameras, OPTIONS, 100, 600) is None


def test_one_camera_alone_has_no_scale() -> None:
    assert scaled_ransac(planted(random_for("one"), (50,)), OPTIONS, 100, 600) is None


def test_the_same_matches_give_the_same_bits_for_any_rng_state() -> None:
    """PoseLib draws from the C library, as any other library may."""
    libc = ctypes.CDLL(None)
    cameras = planted(random_for("bits"), (60, 40, 80), 0.3)

    def poses(drawn: int) -> list[bytes]:
        for _ in range(drawn):
            libc.rand()
        rigid, scaled = rig_ransac(cameras, OPTIONS), scaled_ransac(cameras, OPTIONS, 50, 600)
        assert rigid is not None
        assert scaled is not None
        return [it.tobytes() for it in (rigid.matrix(), scaled.rotation, scaled.translation, np.float64(scaled.scale))]

    assert poses(0) == poses(1) == poses(7)
