"""The example of a robot's loop, on a real video and with a server that stops and returns."""

import importlib
import json
import threading
import time
from datetime import datetime, timedelta, timezone
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from google.protobuf import json_format
from support.images import textured
from support.servers import CAMERA, make_scene, pose, serving
from support.waiting import wait_until

from mapless import Client, wire

RATE_HZ = 20.0


@pytest.fixture
def loop() -> Any:
    return importlib.import_module("robot_loop")


def write_video(path: Path, count: int) -> Path:
    """Frames of which each is as bright as its number."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), RATE_HZ, (96, 64))
    assert writer.isOpened()
    texture = textured() // 4
    for number in range(count):
        writer.write(np.asarray(texture + number, np.uint8))
    writer.release()
    return path


@pytest.fixture
def camera_json(tmp_path: Path) -> str:
    path = tmp_path / "camera.json"
    path.write_text(json_format.MessageToJson(wire.camera_to_message(CAMERA)))
    return str(path)


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def test_poses_go_on_after_the_server_was_away(loop: Any, tmp_path: Path, camera_json: str) -> None:
    video = write_video(tmp_path / "drive.avi", 120)
    poses, tum, data = tmp_path / "poses.jsonl", tmp_path / "poses.tum", tmp_path / "data"
    with serving(data) as server, Client(server.address) as client:
        make_scene(client, "hall", 2)
        port = int(server.address.rpartition(":")[2])
        flags = ["--camera", camera_json, "--scene", "hall", "--address", server.address]
        given = [str(video), *flags, "--poses", str(poses), "--tum", str(tum), "--speed", "2"]
        robot = threading.Thread(target=loop.main, args=(given,))
        robot.start()
        wait_until(lambda: len(lines(poses)) >= 5)
    wait_until(lambda: any("reason" in line for line in lines(poses)))
    away = len(lines(poses))
    with serving(data, port=port):
        wait_until(lambda: any("position_m" in line for line in lines(poses)[away:]))
        robot.join(60)
    seen = lines(poses)
    numbers = [line["frame"] for line in seen]
    assert numbers == sorted({*numbers})
    assert numbers[-1] == 119
    found = [line for line in seen if "position_m" in line]
    assert {line["reason"] for line in seen if "reason" in line} <= {"UNAVAILABLE", "DRAINING", "STARTING", "CANCELLED"}
    assert all(line["position_m"] == [0.0, 2.0, -1.0] and len(line["covariance"]) == 36 for line in found)
    written = np.loadtxt(tum, ndmin=2)
    assert written.shape == (len(found), 8)
    times = [datetime.fromisoformat(line["capture_time"]).timestamp() for line in found]
    np.testing.assert_allclose(written[:, 0], times, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(written[:, 4:], axis=1), 1.0, atol=1e-6)


def test_a_slow_consumer_gets_the_newest_frame(loop: Any, tmp_path: Path) -> None:
    """Every frame that is given is the newest one then, so those between are skipped and never queued."""
    frames = loop.LatestFrame(write_video(tmp_path / "drive.avi", 40), speed=2.0)
    seen = []
    for frame in frames:
        seen.append(frame.number)
        assert abs(frame.pixels.mean() - (textured() // 4).mean() - frame.number) < 3
        time.sleep(0.1)  # four frames
    assert len(seen) < 25
    assert seen == sorted(seen)
    assert seen[-1] == 39


def test_the_last_pose_fades_as_a_prior(loop: Any) -> None:
    """Its variance grows by the square of how far the robot may have moved, until it says nothing."""
    begin = datetime(2026, 1, 1, tzinfo=timezone.utc)
    robot = loop.Robot(None, CAMERA, "hall", None)
    assert robot._prior(loop.Frame(0, begin, None)) is None
    robot.last = (begin, SimpleNamespace(world_from_camera=pose(0), covariance=np.eye(6)))
    later = robot._prior(loop.Frame(1, begin + timedelta(seconds=2), None))
    np.testing.assert_allclose(later.covariance, np.eye(6) * (1 + (1.5 * 2) ** 2))
    assert robot._prior(loop.Frame(2, begin + timedelta(seconds=6), None)) is None


@pytest.mark.parametrize(("video", "camera"), [("absent.mp4", "camera.json"), ("drive.avi", "cameras.json")])
def test_what_is_wrong_is_one_line(loop: Any, tmp_path: Path, camera_json: str, video: str, camera: str) -> None:
    write_video(tmp_path / "drive.avi", 2)
    (tmp_path / "cameras.json").write_text('{"frames": []}')
    with pytest.raises(SystemExit) as caught:
        loop.main([str(tmp_path / video), "--camera", str(tmp_path / camera), "--scene", "hall"])
    message = str(caught.value.code)
    assert message.startswith("robot_loop: ")
    assert "\n" not in message


def test_what_is_no_video_is_said(loop: Any, tmp_path: Path) -> None:
    with pytest.raises(OSError, match="is no video"):
        loop.LatestFrame(tmp_path / "absent.mp4")


def test_a_file_without_frames_is_named(loop: Any, tmp_path: Path) -> None:
    (tmp_path / "text.jpg").write_text("no photograph")
    with pytest.raises(ValueError, match=r"text\.jpg has no frame"):
        list(loop.LatestFrame(tmp_path / "text.jpg"))
