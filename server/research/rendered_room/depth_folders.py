"""Writes the room as sensors with depth would record it: a folder for each kind, for `research.depth_places`.

    PYTHONPATH=client:server python -m research.rendered_room.depth_folders FOLDER [--seed 0]

Poses, intrinsics and extrinsics are exact; the photographs are the same for all kinds. Two minutes of processor time.
"""

import argparse
import shutil
from pathlib import Path

import cv2
import numpy as np

from mapless.depth import DepthSensor
from mapless.geometry import Camera, RigidTransform

from .folders import entry_of, write_cameras, write_photograph
from .furniture import Room, lit_room
from .photographs import Station, scatter, walk
from .sensors import MODELS, Scan, measured

WALK, SCATTERED = 24, 16
"""Photographs around the table, and anywhere."""
SIZES_PX = {
    DepthSensor.RENDERED: (480, 360),
    DepthSensor.TIME_OF_FLIGHT: (320, 240),
    DepthSensor.STEREO: (640, 480),
    DepthSensor.PHONE_LIDAR: (256, 192),
}
"""Sizes of depth images of the photograph's own camera."""
KINECT = Camera(640, 480, 585.0, 585.0, 319.5, 239.5)
CAMERA_FROM_KINECT = RigidTransform(np.eye(3), np.array([-0.0225, -0.005, 0.0]))
"""Structured light has a camera of its own, beside the photograph's, and its images are not registered."""


def main() -> None:
    """Renders the photographs, and writes a folder with them for each kind of sensor."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0, help="of the sensors' errors")
    arguments = parser.parse_args()
    room = lit_room(0)
    stations = walk(0, WALK) + scatter(0, SCATTERED, room)
    for sensor in MODELS:
        write(arguments.folder / sensor.value, sensor, room, stations, arguments.seed)
    first, *others = (arguments.folder / it.value / "images" for it in MODELS)
    for station in stations:
        write_photograph(first, room, station)
    for folder in others:
        shutil.copytree(first, folder, dirs_exist_ok=True)


def write(folder: Path, sensor: DepthSensor, room: Room, stations: list[Station], seed: int) -> None:
    """Writes depth images and cameras of a folder."""
    (folder / "depth").mkdir(parents=True, exist_ok=True)
    is_kinect = sensor is DepthSensor.STRUCTURED_LIGHT
    frames = []
    for station in stations:
        random = np.random.default_rng([seed, *sensor.value.encode(), *station.name.encode()])
        camera = KINECT if is_kinect else station.camera.resized(*SIZES_PX[sensor])
        pose = station.world_from_camera
        scan = Scan.of(room, camera, pose.compose(CAMERA_FROM_KINECT) if is_kinect else pose)
        cv2.imwrite(str(folder / "depth" / f"{station.name}.png"), measured(sensor, scan, random))
        frames.append(entry_of(station) | {"depth": f"depth/{station.name}.png"})
    about: dict[str, object] = {"depth_unit_m": 0.001, "depth_sensor": sensor.value}
    if is_kinect:
        about |= {"depth_K": KINECT.matrix().tolist(), "depth_width": KINECT.width_px, "depth_height": KINECT.height_px}
        about["camera_from_depth_camera"] = CAMERA_FROM_KINECT.matrix().tolist()
    write_cameras(folder, frames, about)


if __name__ == "__main__":
    main()
