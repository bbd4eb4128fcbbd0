"""The epipolar check of imports on real photographs: good poses pass, and planted mistakes are named."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from hashlib import sha256

import numpy as np
import pytest
from numpy.typing import NDArray

from mapless.geometry import Camera, RigidTransform
from mapless_server.method.features import SiftExtractor
from mapless_server.method.views import View
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.ingest.check import check_frames, implausible_depth
from mapless_tools.ingest.check.verdict import Verdict

pytestmark = pytest.mark.realdata

Photographs = Callable[[str], Dataset]
FOUNTAIN = "fountain-P11"
KITCHEN = "7scenes-redkitchen-seq01-first600"
OFFICE = "tum-fr3-office"
nightly = partial(pytest.param, marks=pytest.mark.nightly)


class ExtractedOnce:
    """SIFT of each photograph once for all tests, which differ in the poses."""

    name = SiftExtractor().name

    def __init__(self) -> None:
        self._views: dict[tuple[bytes, str], View] = {}

    def extract(self, image: NDArray[np.uint8], camera: Camera) -> View:
        key = sha256(image.tobytes()).digest(), repr(camera)
        if key not in self._views:
            self._views[key] = SiftExtractor().extract(image, camera)
        return self._views[key]


EXTRACTOR = ExtractedOnce()


def check(frames: tuple[Frame, ...]) -> Verdict:
    return check_frames(frames, lambda *_: None, EXTRACTOR)


@pytest.mark.parametrize(
    ("folder", "median_px"),
    [
        nightly(FOUNTAIN, 0.2),
        nightly(KITCHEN, 0.5),
        nightly(OFFICE, 1.2),
        nightly("kitti-drive-a", 0.5),
        ("reichstag-internet", 0.5),
    ],
)
def test_real_poses_pass_without_a_warning(photographs: Photographs, folder: str, median_px: float) -> None:
    verdict = check(photographs(folder).frames)
    assert verdict.median_px < median_px
    assert (verdict.is_wrong, verdict.suspects) == (False, ())
    assert len(verdict.pairs) > 10
    assert verdict.median_depth is not None
    assert implausible_depth(verdict.median_depth) == ""
    assert "millimetres" in implausible_depth(1000 * verdict.median_depth)


@pytest.mark.parametrize("folder", [FOUNTAIN, nightly(OFFICE)])
def test_opengl_axes_and_inverse_poses_are_named(photographs: Photographs, folder: str) -> None:
    frames = photographs(folder).frames
    flip = np.diag([1.0, -1.0, -1.0])
    for name, fault in (
        ("OpenGL", lambda pose: RigidTransform(pose.rotation @ flip, pose.translation)),
        ("camera_from_world, not", RigidTransform.inverse),
    ):
        verdict = check(tuple(replace(f, world_from_camera=fault(f.world_from_camera)) for f in frames))
        assert verdict.is_wrong
        assert name in verdict.explanation


def test_two_swapped_images_are_both_named(photographs: Photographs) -> None:
    frames = list(photographs(FOUNTAIN).frames)
    second, ninth = frames[1], frames[8]
    frames[1] = replace(second, image_path=ninth.image_path)
    frames[8] = replace(ninth, image_path=second.image_path)
    verdict = check(tuple(frames))
    assert not verdict.is_wrong or not verdict.explanation
    assert {1, 8} <= set(verdict.suspects)
