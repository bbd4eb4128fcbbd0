"""Photographs of a drone as a recording: the import is that of the folder."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from support.bags import BASE_FROM_CAMERA, at, image, info, odometry, transforms, write_bag

from mapless_tools.ingest.formats import KeyframeOptions, ReadOptions, read_dataset

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
