"""Photographs and `cameras.json` of the rendered room."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2

from .furniture import Room
from .photographs import Station, photograph


def write_photograph(images: Path, room: Room, station: Station) -> None:
    """Writes what a station shows, as JPEG."""
    images.mkdir(parents=True, exist_ok=True)
    image = cv2.cvtColor(photograph(room, station, 0), cv2.COLOR_RGB2BGR)
    cv2.imwrite(str(images / f"{station.name}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 92])


def entry_of(station: Station) -> dict[str, object]:
    """The entry of `frames` for a station."""
    camera, pose = station.camera, station.world_from_camera
    size = {"width": camera.width_px, "height": camera.height_px, "K": camera.matrix().tolist()}
    matrix = pose.matrix().tolist()
    return {"image": f"images/{station.name}.jpg", **size, "dist": None, "world_from_camera": matrix}


def write_cameras(
    folder: Path, frames: Sequence[Mapping[str, object]], about: Mapping[str, object] | None = None
) -> None:
    """Writes `cameras.json`, a frame on each line; `about` is said of all frames."""
    said = {"source": "rendered by server/research/rendered_room", "license": "Apache-2.0", "metric": True}
    one_a_line = ",\n".join(f"  {json.dumps(it)}" for it in frames)
    head = json.dumps({**said, **(about or {}), "frames": []}, indent=1)
    (folder / "cameras.json").write_text(head.replace('"frames": []', f'"frames": [\n{one_a_line}\n ]') + "\n")
