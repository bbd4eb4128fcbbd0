"""An attacker's photographs of a faked place: `python -m research.adoption_attack FOLDER --photographs 1000`.

A picture of the demo's room is moved by 2 m along its wall, or hung in a room that nobody has surveyed, and
photographed from near, again and again, with permission to adopt. FOLDER is that of `research.renovation`. Photographs
of the surveyed room are localized before and after; prints what became of the attacker's, and by how much the answers
have moved.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from mapless import AdoptionPolicy, Client, LocalizationResult, NewReference, Rejected
from mapless.geometry import Array
from mapless_tools.child import CONNECT, child_server
from mapless_tools.dataset import Frame
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.run import await_features
from mapless_tools.ingest.formats.cameras import read_folder

from .adopting_server import MetricsPage, free_port
from .rendered_room.furniture import Quad, Room
from .rendered_room.photographs import QUERY_CAMERA, Station, look_at, photograph
from .rendered_room.renovation import SIZE_PX, Renovation
from .renovation import SCENE

MOVE_M = np.array([2.0, 0.0, 0.0])
PICTURE_M = np.array([2.0, 3.975, 1.35]), np.array([2.9, 4.0, 2.0])
"""Corners of the picture, on the wall y = 4."""


def picture_of(room: Room) -> list[int]:
    """Indices of the rectangles of the picture."""
    low, high = PICTURE_M
    return [
        i
        for i, it in enumerate(room.quads)
        if all(
            ((low - 1e-6 <= corner) & (corner <= high + 1e-6)).all()
            for corner in (it.corner, it.corner + it.across, it.corner + it.down)
        )
    ]


def moved(quads: Sequence[Quad]) -> list[Quad]:
    """The rectangles 2 m further along the wall."""
    return [replace(it, corner=it.corner + MOVE_M) for it in quads]


def faked_rooms() -> list[Room]:
    """The room with its picture moved, and another room with it."""
    same, other = Renovation(0).at(0), Renovation(5).at(0)
    own, foreign = picture_of(same), picture_of(other)
    picture = moved([same.quads[i] for i in own])
    for room, hidden in ((same, own), (other, foreign)):
        room.quads[:] = [it for i, it in enumerate(room.quads) if i not in hidden] + picture
    return [same, other]


def stations(count: int) -> Iterator[Station]:
    """Where the attacker stands: the picture fills a third to most of each photograph."""
    random = np.random.default_rng([0, 11])
    middle: Array = (PICTURE_M[0] + PICTURE_M[1]) / 2 + MOVE_M
    camera = QUERY_CAMERA.resized(*SIZE_PX)
    for i in range(count):
        centre = middle + random.uniform([-0.5, -1.7, -0.3], [0.3, -0.8, 0.3])
        target = middle + random.normal(0, 0.1, 3)
        yield Station(f"attack-{i:04d}", camera, look_at(centre, target, random.normal(0, 3)))


def answers(client: Client, frames: Sequence[Frame]) -> list[LocalizationResult | Rejected]:
    """Answers to photographs of the survey's room, which are not adopted."""
    return [client.localize(it.image_path, it.camera, SCENE, timeout_s=300) for it in frames]


def shifts(
    before: Sequence[LocalizationResult | Rejected], after: Sequence[LocalizationResult | Rejected]
) -> list[float]:
    """By how much answers have moved, in their 68 % radii; infinite where one is there no more."""
    found = []
    for first, last in zip(before, after, strict=True):
        if isinstance(first, Rejected) or first.accuracy is None:
            continue
        if isinstance(last, Rejected):
            found.append(float("inf"))
            continue
        found.append(pose_error(first.world_from_camera, last.world_from_camera)[0] / first.accuracy.position_68_m)
    return found


def main() -> None:
    """Prints what became of the attack."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--photographs", type=int, default=1000)
    parser.add_argument("--views", type=int, default=40, help="photographs that are localized before and after")
    arguments = parser.parse_args()
    metrics, rooms = MetricsPage(free_port()), faked_rooms()
    views = read_folder(arguments.folder / "step-00").frames[: arguments.views]
    with (
        tempfile.TemporaryDirectory(prefix="mapless-") as data_dir,
        child_server(Path(data_dir), {"--metrics-port": str(metrics.port)}) as server,
        Client(server.address, CONNECT) as client,
    ):
        client.create_scene(SCENE, adoption=AdoptionPolicy())
        references = read_folder(arguments.folder / "survey").frames
        client.add_references(
            SCENE, [NewReference(it.name, it.image_path, it.camera, it.world_from_camera) for it in references]
        )
        await_features(client, SCENE)
        before, localized, off_m = answers(client, views), 0, list[float]()
        for i, station in enumerate(stations(arguments.photographs)):
            pixels = cv2.cvtColor(photograph(rooms[i % 2], station, 0), cv2.COLOR_RGB2BGR)
            _, jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 92])
            seen = metrics.considered
            answer = client.localize(jpeg.tobytes(), station.camera, SCENE, allow_adoption=True, timeout_s=300)
            if not isinstance(answer, Rejected):
                localized += 1
                off_m.append(pose_error(station.world_from_camera, answer.world_from_camera)[0])
                metrics.wait_for(seen + 1)
            if i % 20 == 19:
                print(i + 1, localized, metrics.outcomes, file=sys.stderr, flush=True)
        adopted = list(client.list_references(SCENE, only_adopted=True))
        moved_by = shifts(before, answers(client, views))
    fooled = sum(it > 1.0 for it in off_m)
    print(f"{arguments.photographs} photographs: {localized} localized, {fooled} of them 1 m off or more")
    print(f"{len(adopted)} references are adopted at the end")
    median, most = float(np.median(moved_by)), max(moved_by)
    print(f"{len(moved_by)} views: moved by {median:.3f} radii (68 %) in the median, {most:.3f} at most")


if __name__ == "__main__":
    main()
