"""Renders an attack into a folder once, and reads it again."""

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2

from mapless.cameras import camera_of_frame
from mapless.geometry import Camera, RigidTransform

from ..rendered_room.folders import entry_of
from .kinds import KINDS, Rooms

QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 92]


@dataclass(frozen=True)
class Sent:
    """A photograph that the attacker sends: file, stated camera, true pose, and day."""

    path: Path
    camera: Camera
    world_from_camera: RigidTransform
    day: int


class Renderer:
    """Renders the room that a seed makes, the first time that it is needed."""

    def __init__(self, folder: Path, seed: int) -> None:
        self._folder, self._seed = folder, seed
        self._rooms: Rooms | None = None

    def photographs(self, kind: str, count: int) -> list[Sent]:
        """The photographs of a kind, at least one; those of an earlier run if there were as many."""
        folder = self._folder / f"{kind}-{count}"
        if not (folder / "attack.json").is_file():
            self._render(kind, count, folder)
        return list(_read(folder))

    def _render(self, kind: str, count: int, folder: Path) -> None:
        rooms = self._rooms = self._rooms or Rooms(self._seed)
        (folder / "images").mkdir(parents=True, exist_ok=True)
        frames = []
        for i, fake in enumerate(KINDS[kind](rooms, count)):
            name = f"{kind}-{i:04d}"
            if not (path := folder / "images" / f"{name}.jpg").is_file():  # an earlier run may have been ended
                _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(fake.render(), cv2.COLOR_RGB2BGR), QUALITY)
                path.write_bytes(jpeg.tobytes())
            frames.append(entry_of(fake.station._replace(name=name, camera=fake.stated)) | {"day": fake.day})
            if i % 100 == 99:
                print(f"{kind}: {i + 1} rendered", file=sys.stderr, flush=True)
        (folder / "attack.json").write_text(json.dumps(frames))


def _read(folder: Path) -> Iterator[Sent]:
    for it in json.loads((folder / "attack.json").read_text()):
        pose = RigidTransform.from_matrix(it["world_from_camera"])
        yield Sent(folder / it["image"], camera_of_frame(it), pose, it["day"])
