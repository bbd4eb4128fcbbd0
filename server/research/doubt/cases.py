"""The photographs that are asked: of other places, doubtful ones of their own place, and turned ones."""

import io
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path

from PIL import ExifTags, Image, ImageOps

from mapless_tools.dataset import Frame
from mapless_tools.output_files import write_json
from research.contradictions.asking import Row
from research.contradictions.cases import Case, Expected
from research.evidence.turning import turned, turned_image
from research.other_places import crossed
from research.places import BOX, KITCHEN, MEETING, Place, Scenes, spread

LIST = Path(__file__).with_name("doubtful.json")
EXPENSIVE_S = 2.0
"""Processor time from which a photograph of its own place is on the list."""
CROSSED, CROSSED_REFERENCES = 200, 10
COUNTS = {3: 1, 5: 1, 10: 3}
"""Numbers of references, and of how many folders one is asked with so many: with ten, most succeed at once."""
CANDIDATES = 4
"""Photographs of a folder with each number of references, among which the list is made."""
TURNED_PLACES = (KITCHEN, MEETING, BOX, "studio-flat", "fox-portrait")
TURNED_REFERENCES, TURNED_EACH = 5, 20
HELD_EACH = 4
ORIENTATIONS = {
    1: (False, 0),
    2: (True, 0),
    3: (False, 180),
    4: (True, 180),
    5: (True, 270),
    6: (False, 90),
    7: (True, 90),
    8: (False, 270),
}
"""EXIF's, and how the upright raster is stored: whether mirrored, after it was turned counterclockwise."""
ANGLES_DEG = (0, 30, 45, 60, 90, 135, 180)


@dataclass(frozen=True, eq=False)
class Asked:
    """A case, and the fields by which its row can be found and summed up."""

    case: Case
    fields: Mapping[str, str | int] = field(default_factory=dict)


def other_places(scenes: Scenes, references: int = CROSSED_REFERENCES) -> Iterator[Asked]:
    """Photographs of each folder, evenly spread, asked in folders of other places with so many references."""
    pairs = crossed(scenes, CROSSED)
    photographs = {}
    for folder, times in Counter(folder for folder, _ in pairs).items():
        frames = spread(scenes.place(folder, references).dataset.frames, times)
        photographs[folder] = islice(_endlessly(frames), times)
    for folder, at in pairs:
        place, frame = scenes.place(at, references), next(photographs[folder])
        case = _case("other-place", place, frame, f"{folder}: {frame.name} in {place.scene}", Expected.REJECTED)
        yield Asked(replace(case, true_pose=None), {"photographed": folder, "folder": at})


def candidates(scenes: Scenes) -> Iterator[Asked]:
    """Photographs of each folder, evenly spread, with each number of references that leaves some beside them."""
    for count, step in COUNTS.items():
        for folder in scenes.names[::step]:
            place = scenes.place(folder, count)
            if len(place.dataset.frames) >= count + 3:
                yield from (_own(folder, count, place, frame) for frame in place.queries(CANDIDATES))


def doubtful(scenes: Scenes, file: Path = LIST) -> Iterator[Asked]:
    """The photographs of the list; ValueError if a folder has none of that name."""
    for group in json.loads(file.read_text()):
        place = scenes.place(group["folder"], group["references"])
        frames = {it.name: it for it in place.dataset.frames}
        missing = [it for it in group["photographs"] if it not in frames]
        if missing:
            raise ValueError(f"{group['folder']} has no photograph {', '.join(missing)}")
        for name in group["photographs"]:
            yield _own(group["folder"], group["references"], place, frames[name])


def write_list(rows: Iterable[Row], file: Path = LIST) -> None:
    """Writes the list of those that were expensive, from the rows of all candidates."""
    groups: dict[tuple[str, int], list[str]] = {}
    for row in rows:
        if row["processor_s"] > EXPENSIVE_S:
            groups.setdefault((row["folder"], row["references_stored"]), []).append(row["photograph"])
    write_json(file, [{"folder": at, "references": n, "photographs": names} for (at, n), names in groups.items()])


def turned_photographs(scenes: Scenes) -> Iterator[Asked]:
    """Photographs of five places, each turned by every angle; their true poses are rolled with them."""
    for (folder,) in scenes.present([(it,) for it in TURNED_PLACES]):
        place = scenes.place(folder, TURNED_REFERENCES)
        for frame in place.queries(TURNED_EACH):
            for angle_deg in ANGLES_DEG:
                yield _turned(folder, place, frame, angle_deg)


def _turned(folder: str, place: Place, frame: Frame, angle_deg: int) -> Asked:
    name = f"{frame.name} in {place.scene} turned by {angle_deg}"
    camera, pose = turned(frame.camera, frame.world_from_camera, angle_deg)
    case = _case("turned", place, frame, name)
    image = partial(turned_image, frame.image_path, frame.camera, angle_deg)
    case = replace(case, image=image, camera=camera, true_pose=pose)
    return Asked(case, {"folder": folder, "photograph": frame.name, "angle_deg": angle_deg})


def held_photographs(scenes: Scenes) -> Iterator[Asked]:
    """Photographs of five places as cameras store them that are held in every way, upright by their EXIF."""
    for (folder,) in scenes.present([(it,) for it in TURNED_PLACES]):
        place = scenes.place(folder, TURNED_REFERENCES)
        for frame in place.queries(HELD_EACH):
            for orientation in ORIENTATIONS:
                yield _held(folder, place, frame, orientation)


def _held(folder: str, place: Place, frame: Frame, orientation: int) -> Asked:
    _, angle_deg = ORIENTATIONS[orientation]
    camera, pose = turned(frame.camera, frame.world_from_camera, angle_deg)
    case = _case("held", place, frame, f"{frame.name} in {place.scene} with orientation {orientation}")
    case = replace(case, image=partial(_held_image, frame, orientation), camera=camera, true_pose=pose)
    return Asked(case, {"folder": folder, "photograph": frame.name, "orientation": orientation})


def _held_image(frame: Frame, orientation: int) -> bytes:
    is_mirrored, angle_deg = ORIENTATIONS[orientation]
    exif, file = Image.Exif(), io.BytesIO()
    exif[ExifTags.Base.Orientation] = orientation
    with Image.open(io.BytesIO(turned_image(frame.image_path, frame.camera, angle_deg))) as upright:
        stored = ImageOps.mirror(upright) if is_mirrored else upright
        stored.save(file, "PNG", exif=exif)
    return file.getvalue()


def _own(folder: str, count: int, place: Place, frame: Frame) -> Asked:
    case = _case("doubtful", place, frame, f"{frame.name} in {place.scene}")
    return Asked(case, {"folder": folder, "references_stored": count, "photograph": frame.name})


def _case(kind: str, place: Place, frame: Frame, name: str, expected: Expected = Expected.RIGHT_OR_REJECTED) -> Case:
    pose = frame.world_from_camera
    return Case(kind, name, place, frame.image_path.read_bytes, frame.camera, pose, expected)


def _endlessly(frames: Sequence[Frame]) -> Iterator[Frame]:
    while True:
        yield from frames
