"""Cameras of images by CameraInfo: the nearest in time, rectified by the topic's name."""

import numpy as np
import pytest
from support.bags import at, info

from mapless.geometry import Camera
from mapless.ros import CameraInfos, camera_from_info, rectified_differs, says_rectified

CAMERA = Camera(96, 64, 80.0, 81.0, 47.0, 31.0)


@pytest.mark.parametrize(
    "topic",
    [
        "/camera/image_rect",
        "/camera/image_rect_color/compressed",
        "/camera/infra1/image_rect_raw",
        "/camera/image_undistorted",
        "/rect/image",
        "/left/rectified/image",
        "/leftImageRect",
        "/camera/undistort/image_color",
    ],
)
def test_names_of_rectified_topics(topic: str) -> None:
    assert says_rectified(topic)


@pytest.mark.parametrize(
    "topic",
    [
        "/camera/image_raw",
        "/rectified/image_raw",
        "/camera/image_unrectified",
        "/camera/not_rectified/image",
        "/camera/rectangle/image",
        "/direct/image",
        "/camera/image_color/compressed",
    ],
)
def test_names_of_other_topics(topic: str) -> None:
    assert not says_rectified(topic)


def test_the_nearest_message_counts_in_any_order() -> None:
    infos = CameraInfos()
    assert infos.at(at(0)) is None
    for number in (0, 2, 1, 3):
        infos.add(info(Camera(96, 64, 80.0 + number, 81.0, 47.0, 31.0), at(number)))
    found = [infos.at(at(time_s)) for time_s in (-5, 0.4, 0.6, 1, 2.4, 9)]
    assert [it.camera.focal_x_px for it in found if it is not None] == [80, 80, 81, 81, 82, 83]


def test_only_the_latest_messages_are_kept() -> None:
    infos = CameraInfos(kept=2)
    for number in range(5):
        infos.add(info(Camera(96, 64, 80.0 + number, 81.0, 47.0, 31.0), at(number)))
    oldest = infos.at(at(0))
    assert oldest is not None
    assert oldest.camera.focal_x_px == 83.0


def test_a_message_without_a_camera_is_not_added() -> None:
    infos = CameraInfos()
    infos.add(info(CAMERA, at(0)))
    with pytest.raises(ValueError, match="not calibrated"):
        infos.add(info(CAMERA, at(1), k=np.zeros(9)))
    found = infos.at(at(1))
    assert found is not None
    assert found.camera == CAMERA


def test_an_empty_p_without_a_lens_is_k() -> None:
    empty = info(CAMERA, p=np.zeros(12))
    assert camera_from_info(empty, rectified=True).camera == CAMERA
    assert not rectified_differs(empty)
    with pytest.raises(ValueError, match=r"CameraInfo\.p has the focal lengths 0, 0"):
        camera_from_info(info(CAMERA, p=np.zeros(12), d=np.array([0.1, 0, 0, 0, 0])), rectified=True)
