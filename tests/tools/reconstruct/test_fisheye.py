"""Photographs of fisheyes of which nothing else is known."""

from pathlib import Path

import numpy as np
import pycolmap

from mapless.geometry import Camera
from mapless.lenses import Fisheye
from mapless_tools.reconstruct.cameras import LensOptions, starting_cameras
from mapless_tools.reconstruct.matching import verify
from mapless_tools.reconstruct.pictures import Picture


def test_two_photographs_of_an_unknown_fisheye_are_verified(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    pictures = [Picture(f"{i}", tmp_path, 640, 480, tmp_path) for i in range(2)]
    (camera,) = starting_cameras(pictures, LensOptions(fisheye=True))
    true = Camera(640, 480, 260.0, 260.0, 319.5, 239.5, Fisheye())
    x_in_world = random.uniform([-4, -3, 1], [4, 3, 4], (300, 3))
    matches = np.repeat(np.arange(300, dtype=np.uint32)[:, None], 2, axis=1)
    with pycolmap.Database.open(tmp_path / "database") as content:
        content.write_camera(camera.to_colmap(1), use_camera_id=True)
        for i in range(2):
            pixels = true.project(x_in_world - [0.4 * i, 0, 0]) + random.normal(0, 0.3, (300, 2))
            number = content.write_image(pycolmap.Image(name=str(i), camera_id=1))
            content.write_keypoints(number, (pixels + 0.5).astype(np.float32))
        content.write_matches(1, 2, matches)
    verify(tmp_path / "database", 1)
    with pycolmap.Database.open(tmp_path / "database") as content:
        assert len(content.read_two_view_geometry(1, 2).inlier_matches) > 100
