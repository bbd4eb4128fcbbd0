"""A robot's loop: reads a video and writes poses; it goes on after the server was unreachable.

    python robot_loop.py drive.mp4 --camera camera.json --scene hall --poses poses.jsonl --tum poses.tum

One call at a time, always with the newest frame: an old pose is of no use, so frames that arrive during a call are
skipped, not queued. The previous pose, with the uncertainty of the robot's motion since, is the next call's prior; the
server reports if the photograph contradicts it. Needs mapless and OpenCV (to decode the video and encode its frames).
"""

import argparse
import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np

import mapless

JPEG_QUALITY = 90  # a tenth of a PNG's bytes, with the same features
MAX_SPEED_M_S, MAX_TURN_RAD_S = 1.5, 1.5  # of this robot: bounds of its motion in a second
PRIOR_LIFE_S = 5.0  # after which the last pose is no prior any more
LONGEST_PAUSE_S = 5.0  # between two attempts to reach a lost server


@dataclass(frozen=True)
class Frame:
    """A frame, when it was taken, and how many frames came before it."""

    number: int
    capture_time: datetime
    pixels: np.ndarray


class LatestFrame:
    """Plays a video as a camera would deliver it, and keeps the newest frame only."""

    def __init__(self, video: Path, speed: float = 1.0) -> None:
        """Begins at once; `speed` is relative to the speed of the recording."""
        if not video.is_file():
            raise OSError(f"there is no video {video}")
        self._video = video
        self._capture = cv2.VideoCapture(str(video))
        if not self._capture.isOpened():
            raise OSError(f"{video} is no video that OpenCV can read")
        rate_hz = self._capture.get(cv2.CAP_PROP_FPS)
        self._period_s = 1 / (rate_hz if rate_hz > 0 else 30.0)
        self._speed = speed
        self._changed = threading.Condition()
        self._frame: Frame | None = None
        self._is_over = False
        threading.Thread(target=self._play, daemon=True).start()

    def __iter__(self) -> Iterator[Frame]:
        """Yields the newest frame at each step; ends with the video. ValueError if it has no frame."""
        seen = -1
        while (frame := self._newer_than(seen)) is not None:
            seen = frame.number
            yield frame
        if seen < 0:
            raise ValueError(f"{self._video} has no frame that can be decoded")

    def _newer_than(self, number: int) -> Frame | None:
        """The newest frame, once it has another number; None after the last."""

        def new() -> Frame | None:
            return self._frame if self._frame is not None and self._frame.number > number else None

        with self._changed:
            self._changed.wait_for(lambda: self._is_over or new() is not None)
            return new()

    def _play(self) -> None:
        begin, begin_s = datetime.now(timezone.utc), time.monotonic()
        number = 0
        while True:
            there, pixels = self._capture.read()
            if not there:
                break
            offset_s = number * self._period_s
            time.sleep(max(begin_s + offset_s / self._speed - time.monotonic(), 0.0))
            with self._changed:
                self._frame = Frame(number, begin + timedelta(seconds=offset_s), pixels)
                self._changed.notify_all()
            number += 1
        with self._changed:
            self._is_over = True
            self._changed.notify_all()
        self._capture.release()


@dataclass
class Outputs:
    """Poses as JSON lines, and in TUM's form: seconds, position, quaternion x y z w of world_from_camera."""

    poses: TextIO
    tum: TextIO | None = None

    def localized(self, frame: Frame, answer: mapless.LocalizationResult, took_s: float) -> None:
        """Writes a pose."""
        q, position = answer.world_from_camera.quaternion(), answer.world_from_camera.translation.tolist()
        self._write(
            frame,
            position_m=position,
            quaternion_xyzw=[q.x, q.y, q.z, q.w],
            covariance=None if answer.covariance is None else answer.covariance.ravel().tolist(),
            trust=answer.trust,
            inlier_count=answer.inlier_count,
            took_s=round(took_s, 3),
        )
        if self.tum is not None:
            numbers = [frame.capture_time.timestamp(), *position, q.x, q.y, q.z, q.w]
            print(*(f"{number:.9f}" for number in numbers), file=self.tum, flush=True)

    def lost(self, frame: Frame, reason: str, message: str) -> None:
        """Writes that there is no pose, and why."""
        self._write(frame, reason=reason, message=message)

    def _write(self, frame: Frame, **fields: Any) -> None:
        line = {"frame": frame.number, "capture_time": frame.capture_time.isoformat(), **fields}
        print(json.dumps(line), file=self.poses, flush=True)


@dataclass
class Robot:
    """State of the robot between frames."""

    client: mapless.Client
    camera: mapless.Camera
    scene: str
    outputs: Outputs
    last: tuple[datetime, mapless.LocalizationResult] | None = None
    pause_s: float = field(default=0.0, init=False)

    def look(self, frame: Frame) -> None:
        """Localizes one frame, writes the answer, and waits if the server requests it or is unreachable."""
        encoded, jpeg = cv2.imencode(".jpg", frame.pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        assert encoded
        start_s = time.monotonic()
        try:
            answer = self.client.localize(
                jpeg.tobytes(),
                self.camera,
                self.scene,
                priors=mapless.Priors(pose=self._prior(frame)),
                capture_time=frame.capture_time,
            )
        except (mapless.Unavailable, mapless.ResourceExhausted, mapless.DeadlineExceeded) as error:
            self.outputs.lost(frame, error.reason, error.message)
            self._wait(error)
            return
        self.pause_s = 0.0
        if isinstance(answer, mapless.Rejected):
            self.outputs.lost(frame, answer.reason, answer.message)
            if answer.reason == "PRIOR_CONFLICT":
                self.last = None
            return
        if any(check.conflict for check in answer.prior_checks):
            print(f"frame {frame.number}: the previous pose contradicts the photograph", file=sys.stderr)
        self.last = (frame.capture_time, answer)
        self.outputs.localized(frame, answer, time.monotonic() - start_s)

    def _prior(self, frame: Frame) -> mapless.PosePrior | None:
        """The last pose, with the uncertainty of motion since in an unknown direction."""
        if self.last is None:
            return None
        captured, pose = self.last
        since_s = (frame.capture_time - captured).total_seconds()
        if since_s > PRIOR_LIFE_S or pose.covariance is None:
            return None
        moved = np.repeat([MAX_SPEED_M_S * since_s, MAX_TURN_RAD_S * since_s], 3)
        return mapless.PosePrior(pose.world_from_camera, pose.covariance + np.diag(moved**2))

    def _wait(self, error: mapless.MaplessError) -> None:
        """Waits as long as the server requests; longer each time while it is unreachable."""
        if error.retry_after_s is None and self.pause_s == 0:
            print(f"no answer ({error}); retrying", file=sys.stderr)
        self.pause_s = min(max(2 * self.pause_s, 0.1), LONGEST_PAUSE_S)
        time.sleep(error.retry_after_s or self.pause_s)


def main(arguments: list[str] | None = None) -> None:
    """Run the loop until the video ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", type=Path)
    parser.add_argument("--camera", required=True, help="its intrinsics, a JSON file")
    parser.add_argument("--scene", required=True)
    parser.add_argument("--address", default="localhost:50051")
    parser.add_argument("--client-id", default="", help="which robot this is; the server is fair between them")
    parser.add_argument("--poses", type=Path, help="JSON lines; default: standard output")
    parser.add_argument("--tum", type=Path, help="the poses in TUM's form, too")
    parser.add_argument("--speed", type=float, default=1.0, help="play the video so many times faster")
    given = parser.parse_args(arguments)
    try:
        _follow(given)
    except (OSError, ValueError, mapless.MaplessError) as error:
        sys.exit(f"robot_loop: {error}")


def _follow(given: argparse.Namespace) -> None:
    camera = mapless.read_camera(given.camera)
    frames = LatestFrame(given.video, given.speed)
    # One attempt: for a frame that failed there is a newer one.
    options = mapless.ConnectOptions(timeout_s=5.0, max_attempts=1, max_reconnect_s=1.0, client_id=given.client_id)
    with (
        mapless.Client(given.address, options) as client,
        given.poses.open("w") if given.poses else nullcontext(sys.stdout) as poses,
        given.tum.open("w") if given.tum else nullcontext() as tum,
    ):
        robot = Robot(client, camera, given.scene, Outputs(poses, tum))
        for frame in frames:
            robot.look(frame)


if __name__ == "__main__":
    main()
