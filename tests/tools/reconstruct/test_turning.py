"""A camera that only turned is distinguished from one that moved, whatever its focal length and lens are taken for."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from mapless.geometry import Camera, rotation_from_vector
from mapless.lenses import RadialTangential
from mapless_tools.reconstruct.turning import only_turned

IMAGES = 6


@pytest.fixture
def database(tmp_path: Path, step: float, of_object: int) -> Path:
    """Photographs of random points, taken while the camera turns and moves by a step, with a focal length 1.4 wrong.

    The first points are those of an object that moves before the camera.
    """
    random = np.random.default_rng(0)
    true = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, RadialTangential(k1=-0.1))
    taken_for = pycolmap.Camera(
        camera_id=1, model="SIMPLE_RADIAL", width=640, height=480, params=[700.0, 320.0, 240.0, 0.0]
    )
    x_in_world = random.uniform([-1, -1, 3], [1, 1, 6], (150, 3))
    with pycolmap.Database.open(tmp_path / "database") as content:
        content.write_camera(taken_for, use_camera_id=True)
        for i in range(IMAGES):
            rotation = rotation_from_vector([0.02 * i, 0.05 * (i - IMAGES / 2), 0.03 * i])
            x_in_world[:of_object] += [0.2, 0, 0]
            pixels = true.project((x_in_world - [step * i, 0, 0]) @ rotation.T) + random.normal(0, 0.4, (150, 2))
            number = content.write_image(pycolmap.Image(name=str(i), camera_id=1))
            content.write_keypoints(number, (pixels + 0.5).astype(np.float32))
        for first, second in combinations(range(1, IMAGES + 1), 2):
            matches = np.repeat(np.arange(150, dtype=np.uint32)[:, None], 2, axis=1)
            geometry = pycolmap.TwoViewGeometry(inlier_matches=matches)
            content.write_two_view_geometry(first, second, geometry)
    return tmp_path / "database"


@pytest.mark.parametrize(("step", "of_object", "turned"), [(0.0, 0, True), (0.0, 50, True), (0.1, 0, False)])
def test_turns_are_told_from_movements(database: Path, turned: bool) -> None:
    assert only_turned(database, range(1, IMAGES + 1)) == turned


@pytest.mark.parametrize(("step", "of_object"), [(0.0, 0)])
def test_images_without_pairs_have_not_turned(database: Path) -> None:
    assert not only_turned(database, [1])
