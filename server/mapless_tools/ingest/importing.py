"""An import from end to end: read, check, compare with what is there, store, report."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from mapless import AlreadyExists, Client, Reference
from mapless.names import check_id
from mapless_server.errors import InvalidArgument
from mapless_server.images.decode import ImageLimits, image_size
from mapless_tools.dataset import MAX_NAME_LENGTH, Dataset, Frame, Refusal
from mapless_tools.progress import Progress

from .existing import KnownReferences
from .formats import ReadOptions, read_dataset
from .report import ImportReport
from .upload import Uploader
from .waiting import UploadOptions


@dataclass(frozen=True)
class ImportOptions:
    """Options of an import.

    Attributes:
        format: name of the folder's layout, or "auto".
        read: what its reader is told.
        split: take only frames of this split, "train" or "test"; empty for all.
        stride: take every so-manieth frame.
        max_count: take so many at most, spread evenly; None for all.
        id_prefix: before every reference's id, for several folders in one scene.
        check: whether to compare photographs with the poses first.
        upload: how references are sent.
    """

    format: str = "auto"
    read: ReadOptions = field(default_factory=ReadOptions)
    split: str = ""
    stride: int = 1
    max_count: int | None = None
    id_prefix: str = ""
    check: bool = True
    upload: UploadOptions = field(default_factory=UploadOptions)

    def __post_init__(self) -> None:
        if self.split not in ("", "train", "test"):
            raise ValueError(f"split must be train or test, not {self.split!r}")
        if self.stride < 1 or (self.max_count is not None and self.max_count < 1):
            raise ValueError("stride and max must be at least 1")
        if self.id_prefix:
            check_id(f"{self.id_prefix}0")


def read_frames(folder: Path, options: ImportOptions) -> tuple[Dataset, tuple[Frame, ...]]:
    """The dataset, and those of its frames that are to be imported.

    Raises:
        ValueError: the folder cannot be read, or nothing is left to import.
    """
    dataset = read_dataset(folder, options.format, options.read)
    frames = [frame for frame in dataset.frames if not options.split or frame.split == options.split]
    if not frames:
        known = sorted({frame.split for frame in dataset.frames} - {""})
        raise ValueError(
            f"{folder} has no frames of split {options.split}; it has {' and '.join(known) or 'no splits'}"
        )
    frames = frames[:: options.stride]
    if options.max_count is not None and len(frames) > options.max_count:
        step = len(frames) / options.max_count
        frames = [frames[int(i * step)] for i in range(options.max_count)]
    return dataset, tuple(_prefixed(frame, options.id_prefix) for frame in frames)


def refuse_wrong_images(report: ImportReport) -> None:
    """Refuses the report's chosen frames whose image a server would refuse by its header; for a dry run."""
    for frame in report.chosen:
        try:
            size = image_size(frame.image_path.read_bytes(), ImageLimits())
        except (OSError, InvalidArgument) as error:
            report.refused.append(Refusal(frame.name, str(error)))
            continue
        camera = frame.camera
        if size != (camera.width_px, camera.height_px):
            reason = f"has {size[0]}x{size[1]} pixels, its camera {camera.width_px}x{camera.height_px}"
            report.refused.append(Refusal(frame.name, f"{frame.image_path.name} {reason}"))


def store_frames(client: Client, report: ImportReport, options: UploadOptions, progress: Progress) -> None:
    """Stores the report's chosen frames in its scene, which is made if there is none.

    A scene that is made takes the dataset's datum and down; one that is there keeps its own.

    Raises:
        MaplessError: the scene could not be listed or made.
    """
    known = KnownReferences(_existing(client, report.scene, report.dataset))
    Uploader(client, known, report, options, progress).run()


def _existing(client: Client, scene: str, dataset: Dataset) -> list[Reference]:
    try:
        client.create_scene(scene, datum=dataset.datum, down_in_world=dataset.down_in_world)
    except AlreadyExists:
        return list(client.list_references(scene, page_size=1000))
    return []


def _prefixed(frame: Frame, prefix: str) -> Frame:
    if not prefix:
        return frame
    name = f"{prefix}{frame.name}"
    if len(name) > MAX_NAME_LENGTH:
        raise ValueError(f"{name} is longer than the {MAX_NAME_LENGTH} characters that an id may have")
    return replace(frame, name=name)
