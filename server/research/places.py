"""The scenes of a folder: photographs with known poses, of which some, evenly spread, are references.

Everything that is measured on photographs reads them here; `described` finds their features.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np

from mapless import NewReference, RigidTransform
from mapless.geometry import Array, Camera
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.evaluate.metrics import trajectory_radius
from mapless_tools.ingest.formats.cameras import read_folder

Row = TypeVar("Row", bound=tuple[object, ...])
RIGHT_SHARE, RIGHT_M, RIGHT_DEG = 0.05, 0.25, 5.0
"""An answer is wrong that is off by a larger share of the distance to what the photograph shows, by more degrees or,
in a scene in metres, by more metres."""
KITCHEN, OFFICE, DRIVE = "7scenes-redkitchen-seq01-first600", "tum-fr3-office", "kitti-drive-a"
LOCKERS, CAN, STATUE = "office-lockers", "can-on-tiles", "statue-of-liberty-internet"
MEETING, FOUNTAIN, CHESS, BOX = "meeting-room", "fountain-P11", "chess-king", "box-in-lounge"
SHORT = {
    KITCHEN: "kitchen",
    LOCKERS: "lockers",
    CAN: "can",
    STATUE: "statue",
    MEETING: "meeting",
    FOUNTAIN: "fountain",
    CHESS: "chess",
    BOX: "box",
}
ONE_PLACE: tuple[tuple[str, ...], ...] = (
    (KITCHEN, "depth/kinect-kitchen"),
    (OFFICE, "depth/tum-teddy"),
)
"""Folders that show one place; those of the second were recorded in one hall."""
APART = 30.0
"""Distance of the two places that look alike, in the unit of their scene."""


def is_right(off: float, off_deg: float, distance: float, metric: bool) -> bool:
    """Whether errors are small enough for a right answer to what is so far away."""
    largest = RIGHT_SHARE * distance
    return off <= (min(RIGHT_M, largest) if metric else largest) and off_deg <= RIGHT_DEG


def distance_seen(camera: Camera, true_pose: RigidTransform, x_in_world: Array) -> float:
    """Median depth of the points (N, 3) that are inside a photograph at its true pose; 0 without any."""
    x_in_camera = true_pose.inverse().apply(x_in_world)
    projected = camera.project(x_in_camera)
    inside = ((projected >= 0) & (projected < [camera.width_px, camera.height_px])).all(axis=1)
    return float(np.median(x_in_camera[inside, 2])) if inside.any() else 0.0


@dataclass(frozen=True, eq=False)
class Place:
    """A folder with so many of its frames as references, the others as photographs to localize.

    `radius` is the root mean square distance of all cameras from their centre, in the scene's unit. If `copy_stride` is
    not 0, every so many-th reference is stored again, under another id and displaced by `APART` along x.
    """

    scene: str
    dataset: Dataset
    reference_frames: tuple[Frame, ...]
    copy_stride: int = 0

    @property
    def radius(self) -> float:
        """See the class."""
        return trajectory_radius(np.array([it.world_from_camera.translation for it in self.dataset.frames]))

    def references(self) -> list[NewReference]:
        """The data that the scene stores."""
        copied = self.reference_frames[:: self.copy_stride] if self.copy_stride else ()
        return [
            NewReference(f"{name}{it.name}", it.image_path, it.camera, it.world_from_camera.shifted([x, 0.0, 0.0]))
            for name, x, frames in (("", 0.0, self.reference_frames), ("copy-", APART, copied))
            for it in frames
        ]

    def queries(self, count: int) -> list[Frame]:
        """Photographs that are no references, evenly spread; neither the first nor the last of the walk."""
        others = [it for it in self.dataset.frames[1:-1] if it not in self.reference_frames]
        return spread(others, count)

    def far_from(self, frame: Frame) -> RigidTransform:
        """The pose of the scene's photograph that is farthest away."""
        return max(
            (it.world_from_camera for it in self.dataset.frames),
            key=lambda pose: float(np.linalg.norm(pose.translation - frame.world_from_camera.translation)),
        )

    def down(self) -> np.ndarray:
        """(3,) the mean direction of the images' columns: gravity, as far as cameras are held upright."""
        mean = np.mean([it.world_from_camera.rotation[:, 1] for it in self.dataset.frames], axis=0)
        return np.asarray(mean / np.linalg.norm(mean))


class Scenes:
    """The scenes of a folder: those of its folders, or of these, with `images/` and `cameras.json`.

    Attributes:
        names: their paths from the folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        found = (*folder.glob("*/cameras.json"), *folder.glob("*/*/cameras.json"))
        self.names = sorted(it.parent.relative_to(folder).as_posix() for it in found if (it.parent / "images").is_dir())
        self.dataset = cache(lambda name: read_folder(folder / name))
        self.place = cache(self._place)

    def present(self, rows: Sequence[Row]) -> list[Row]:
        """Those of some rows whose scene, in their first column, is in the folder."""
        return [it for it in rows if it[0] in self.names]

    def others(self, name: str) -> list[str]:
        """The scenes of other places than that of a scene."""
        return [it for it in self.names if it != name and not any({it, name} <= set(one) for one in ONE_PLACE)]

    def _place(self, name: str, count: int, copy_stride: int = 0) -> Place:
        dataset = self.dataset(name)
        copies = {0: "", 1: "-twice"}.get(copy_stride, f"-and-every-{copy_stride}")
        scene = SHORT.get(name, name.replace("/", "-"))
        return Place(f"{scene}-{count}{copies}", dataset, tuple(spread(dataset.frames, count)), copy_stride)


def spread(frames: Sequence[Frame], count: int) -> list[Frame]:
    """So many frames, evenly spread from the first to the last."""
    indices = np.unique(np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int))
    return [frames[i] for i in indices]


COUNTS, FEW = {KITCHEN: 3, LOCKERS: 12, STATUE: 20}, 5
"""References of a place, evenly spread: so few that photographs are in doubt."""


def own_and_other(scenes: Scenes, own: int, other: int = 1) -> Iterator[tuple[str, Place, list[Frame], list[Frame]]]:
    """Each scene with few references: its name, photographs of it, and photographs of other places.

    ValueError if none has enough photographs.
    """
    names = [it for it in scenes.names if len(scenes.dataset(it).frames) >= FEW + 3]
    if not names:
        raise ValueError(f"{scenes.folder} has no scene of {FEW + 3} photographs and more")
    for number, name in enumerate(names):
        place = scenes.place(name, COUNTS.get(name, FEW))
        others = scenes.others(name)
        frames = [scenes.dataset(others[(5 * number + 3 * i) % len(others)]).frames for i in range(other) if others]
        yield name, place, place.queries(own), [it[number % min(3, len(it))] for it in frames]
