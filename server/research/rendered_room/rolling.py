"""Writes photographs of the demo's room by a rolling shutter: row after row while the camera moves.

`PYTHONPATH=client:server python -m research.rendered_room.rolling FOLDER [--places 4] [--first 0] [--readout 0.033]`,
some minutes. Each place is photographed with each motion of `MOTIONS`, 480x360 pixels; `cameras.json` has the pose in
the middle of the read-out, and the speed.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, rotation_from_vector

from .folders import entry_of, write_cameras
from .furniture import Room, lit_room
from .photographs import QUERY_CAMERA, Floats, Station, exposed, phone_settings, scatter, shade

CAMERA = QUERY_CAMERA.resized(480, 360)
BAND_PX = 8
"""Rows of the double raster that have one pose: four rows of the photograph, off by 0.06 pixels at 90 degrees/s."""

Motion = Callable[[float], tuple[Array, Array]]
"""From seconds since the middle of the read-out to the shift (3,), metres, and the rotation vector (3,), radians, in
the axes of the camera in the middle."""


def steady(speed_m_s: tuple[float, float, float], rate_deg_s: tuple[float, float, float]) -> Motion:
    """A motion of constant speeds."""
    return lambda t_s: (t_s * np.array(speed_m_s), np.radians(t_s * np.array(rate_deg_s)))


def shaken(hertz: float, shift_m: float, angle_deg: float) -> Motion:
    """A vibration across and about the viewing direction, fastest in the middle of the read-out but for a quarter."""

    def motion(t_s: float) -> tuple[Array, Array]:
        phase = np.sin(2 * np.pi * hertz * t_s + 0.7) - np.sin(0.7)
        return shift_m * phase * np.array([1.0, 0.5, 0]), np.radians(angle_deg) * phase * np.array([0.7, 0.5, 1.0])

    return motion


STILL = steady((0, 0, 0), (0, 0, 0))
MOTIONS: dict[str, Motion] = {
    "still": STILL,
    "pan-45": steady((0, 0, 0), (0, 45, 0)),
    "pan-90": steady((0, 0, 0), (0, 90, 0)),
    "walk": steady((0, 0, 1.4), (0, 0, 0)),
    "walk-pan-30": steady((0, 0, 1.4), (0, 30, 0)),
    "sideways-pan-60": steady((1.4, 0, 0), (0, -60, 0)),
    "tilt-45": steady((0, 0, 0), (45, 0, 0)),
    "roll-60": steady((0, 0, 0), (0, 0, 60)),
    "hand": steady((0.15, 0.1, 0.05), (6, -8, 4)),
    "vehicle-3": steady((0.3, 0, 3.0), (0, 10, 0)),
    "shaken-15-hertz": shaken(15, 0.002, 0.4),
    "stairs": steady((0.2, 1.0, 0.5), (-30, 15, 10)),
}
"""The first six are those of the case, the others its complement: still ones are made twice as often."""


def rolled(room: Room, station: Station, motion: Motion, readout_s: float) -> NDArray[np.uint8]:
    """(H, W, 3) sRGB, read from the top row to the bottom one, with random settings of a phone."""
    camera = station.camera.resized(2 * station.camera.width_px, 2 * station.camera.height_px)
    bands = list[Floats]()
    for row in range(0, camera.height_px, BAND_PX):
        shift, turn = motion(readout_s * ((row + BAND_PX / 2) / camera.height_px - 0.5))
        moved = RigidTransform(rotation_from_vector(turn), shift)
        its = replace(camera, height_px=BAND_PX, principal_y_px=camera.principal_y_px - row)
        bands.append(shade(room, its, station.world_from_camera.compose(moved)))
    random = np.random.default_rng([6, *station.name.encode()])
    return exposed(np.concatenate(bands), phone_settings(random), random)


def main() -> None:
    """Writes the photographs and their cameras."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--places", type=int, default=4)
    parser.add_argument("--first", type=int, default=0, help="the first of the places to use")
    parser.add_argument("--readout", type=float, default=0.033, help="seconds")
    parser.add_argument("--motions", nargs="+", default=list(MOTIONS), choices=MOTIONS)
    arguments = parser.parse_args()
    room, entries = lit_room(0), list[dict[str, object]]()
    (arguments.folder / "images").mkdir(parents=True, exist_ok=True)
    for place in scatter(0, arguments.first + arguments.places, room)[arguments.first :]:
        for name in arguments.motions:
            station = Station(f"{place.name}-{name}", CAMERA, place.world_from_camera)
            pixels = rolled(room, station, MOTIONS[name], arguments.readout)
            file = arguments.folder / "images" / f"{station.name}.jpg"
            cv2.imwrite(str(file), pixels[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])
            entries.append(entry_of(station))
    write_cameras(arguments.folder, entries)


if __name__ == "__main__":
    main()
