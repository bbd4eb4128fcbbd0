"""Writes the video of `make demo-video`, and the true poses of its frames beside it, in some minutes.

`PYTHONPATH=client:server python -m research.rendered_room.video FILE.mp4`. A person goes around the table of the demo's
room, then films the printed tag on the brick wall from near: 640x480 pixels, 8 frames a second, with the unsteadiness
of a hand, exposure by the brightness, and little noise, as phones have in videos.
"""

import json
import sys
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from scipy.interpolate import CubicSpline

from mapless.geometry import Array, Camera, RigidTransform

from .furniture import Room, lit_room
from .photographs import Settings, Station, developed, look_at
from .textures import Image, Random, Shape

FRAME_RATE = 8
DURATION_S = 16.0
CAMERA = Camera(640, 480, 548.0, 548.0, 319.5, 239.5)
TAG_EDGE_M, SHEET_M = 0.16, 0.20
SHEET_CORNER = np.array([2.95, 3.994, 1.66])
"""Top left of the sheet, on the brick wall y = 4, as seen from the room; its edges are x and -z."""
ENCODER = {"crf": "24", "preset": "veryslow"}


def printed_tag(room: Room) -> None:
    """A sheet with tag 0 of AprilTag's 36h11 on the wall."""

    def sheet(random: Random, shape: Shape) -> Image:
        black = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), 0, 8)
        modules = cv2.copyMakeBorder(black, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(255,))
        grey = cv2.resize(modules, shape[::-1], interpolation=cv2.INTER_NEAREST) / np.float32(255)
        return np.asarray(np.repeat(0.06 + 0.84 * grey[..., None], 3, axis=2), np.float32)

    room.panel(SHEET_CORNER, [SHEET_M, 0, 0], [0, 0, -SHEET_M], sheet, 1600)


def world_from_tag() -> RigidTransform:
    """The tag in the room: x along its top, y down its side, z into the wall."""
    axes = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    return RigidTransform(axes, SHEET_CORNER + [SHEET_M / 2, 0, -SHEET_M / 2])


def walk() -> list[RigidTransform]:
    """Poses of the frames: once around the table, looking across it, then along the tag at 1.2 m."""
    stations = []
    for angle in np.radians(np.arange(280, 280 + 13 * 30, 30)):
        ahead = angle + np.radians(25)
        centre = (2.45 + 1.6 * np.cos(angle), 2.0 + 1.2 * np.sin(angle), 1.5)
        stations.append((centre, (2.45 - 1.5 * np.cos(ahead), 2.0 - 1.2 * np.sin(ahead), 1.05)))
    stations += [
        ((3.5, 1.2, 1.5), (2.9, 4.0, 1.3)),
        ((3.75, 2.1, 1.5), (3.05, 4.0, 1.45)),
        ((3.45, 2.7, 1.55), (3.05, 4.0, 1.5)),
        ((3.0, 2.75, 1.45), (3.05, 4.0, 1.5)),
        ((2.5, 2.85, 1.5), (3.0, 4.0, 1.5)),
    ]
    times = np.linspace(0, DURATION_S, len(stations))
    way, aim = (CubicSpline(times, np.array([it[i] for it in stations])) for i in (0, 1))
    sway = _unsteadiness()
    poses = []
    for i in range(round(DURATION_S * FRAME_RATE)):
        at = i / FRAME_RATE
        poses.append(look_at(way(at) + 0.015 * sway[i, :3], aim(at) + 0.04 * sway[i, 3:6], 2.0 * sway[i, 6]))
    return poses


def _unsteadiness() -> Array:
    """Smooth noise of unit deviation, (frames, 7), that changes within half a second."""
    count = round(DURATION_S * FRAME_RATE)
    noise = np.random.default_rng(4).standard_normal((count, 7))
    smooth = cv2.GaussianBlur(noise, (1, 0), sigmaX=0.1, sigmaY=FRAME_RATE / 4, borderType=cv2.BORDER_REFLECT)
    return np.asarray(smooth / smooth.std(axis=0))


def main(file: Path) -> None:
    """Render and encode the video, and write the poses."""
    cv2.setNumThreads(1)  # images are small
    room = lit_room(0, printed_tag)
    random = np.random.default_rng([0, 5])
    with av.open(str(file), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=FRAME_RATE, options=ENCODER)
        stream.width, stream.height, stream.pix_fmt = CAMERA.width_px, CAMERA.height_px, "yuv420p"
        stream.time_base = Fraction(1, FRAME_RATE)
        for i, pose in enumerate(walk()):
            pixels = developed(room, Station(f"{i}", CAMERA, pose), Settings(0.6, 0.0, 1.02, 0.97, 0.3), random)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, "rgb24")))
        container.mux(stream.encode())
    truth = {
        "source": "rendered by server/research/rendered_room",
        "license": "Apache-2.0",
        "K": CAMERA.matrix().tolist(),
        "tag": {"family": "36h11", "id": 0, "edge_m": TAG_EDGE_M, "world_from_tag": world_from_tag().matrix().tolist()},
        "world_from_camera": [np.round(pose.matrix()[:3], 7).tolist() for pose in walk()],
    }
    file.with_suffix(".json").write_text(json.dumps(truth, separators=(",", ":")) + "\n", "utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
