"""The epipolar check of imports on real photographs: good poses pass, and planted mistakes are named."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from hashlib import sha256
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.bags import BASE_FROM_CAMERA, at, image, info, odometry, transforms, write_bag

from mapless.geometry import Camera, RigidTransform
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.features.views import Ignored, View
from mapless_server.method.pairs.readings.depth import implausible_depth
from mapless_server.method.pairs.readings.verdict import Verdict
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.ingest.check import check_frames
from mapless_tools.ingest.formats import KeyframeOptions, ReadOptions, read_dataset

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

    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
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
    frames = photographs(folder).frames[:7]
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


DRONE = Path(__file__).parents[3] / "shared" / "data" / "euroc-v101-drone"
COUNT = 12


@pytest.mark.realdata
@pytest.mark.skipif(not DRONE.is_dir(), reason="no ../shared/data/euroc-v101-drone")
def test_a_recording_is_imported_as_its_folder(tmp_path: Path) -> None:
    """The same cameras and pixels, and poses to 1e-12: so what is computed from them is the same, too."""
    frames = read_dataset(DRONE).frames[:COUNT]
    messages = [("/tf_static", at(0), transforms(at(0), ("body", "camera", BASE_FROM_CAMERA)))]
    for number, frame in enumerate(frames):
        stamp_ns = at(0.1 * number)
        body = frame.world_from_camera.compose(BASE_FROM_CAMERA.inverse())
        grey = np.asarray(cv2.imread(str(frame.image_path), cv2.IMREAD_GRAYSCALE), np.uint8)
        messages += [
            ("/vicon", stamp_ns, odometry(stamp_ns, body, "vicon", "body")),
            ("/cam0/camera_info", stamp_ns, info(frame.camera, stamp_ns)),
            ("/cam0/image_raw", stamp_ns, image(stamp_ns, grey, "mono8")),
        ]
    bag = write_bag(tmp_path / "drone", messages)
    found = read_dataset(bag, options=ReadOptions(keyframes=KeyframeOptions(0, 0))).frames
    assert len(found) == COUNT
    for got, want in zip(found, frames, strict=True):
        assert got.camera == want.camera
        np.testing.assert_allclose(got.world_from_camera.matrix(), want.world_from_camera.matrix(), atol=1e-12)
        pixels = [cv2.imread(str(it.image_path), cv2.IMREAD_GRAYSCALE) for it in (got, want)]
        np.testing.assert_array_equal(pixels[0], pixels[1])
