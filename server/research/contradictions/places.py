"""The scenes of the cases: photographs with known poses, of which some, evenly spread, are a scene's references."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from mapless import NewReference, RigidTransform
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.evaluate.metrics import trajectory_radius
from mapless_tools.ingest.formats.cameras import read_folder

KITCHEN = "7scenes-redkitchen-seq01-first600"
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
APART = 30.0
"""Distance of the two places that look alike, in the unit of their scene."""


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


PlaceOf = Callable[..., Place]


def place_reader(data: Path) -> PlaceOf:
    """A function that makes the place of a folder's name and a number of references; see `Place` for the copies."""
    dataset_of = cache(lambda folder: read_folder(data / folder))

    @cache
    def place_of(folder: str, count: int, copy_stride: int = 0) -> Place:
        dataset = dataset_of(folder)
        copies = {0: "", 1: "-twice"}.get(copy_stride, f"-and-every-{copy_stride}")
        name = SHORT.get(folder, folder.replace("/", "-"))
        return Place(f"{name}-{count}{copies}", dataset, tuple(spread(dataset.frames, count)), copy_stride)

    return place_of


def spread(frames: Sequence[Frame], count: int) -> list[Frame]:
    """So many frames, evenly spread from the first to the last."""
    indices = np.unique(np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int))
    return [frames[i] for i in indices]
