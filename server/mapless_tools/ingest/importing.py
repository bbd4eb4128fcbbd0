"""An import: reads, selects, checks, compares with the scene, stores, and reports."""

import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from rich.console import Console

from mapless import Client, DeadlineExceeded, MaplessError, Reference, Unavailable
from mapless.labels import check_labels
from mapless.names import check_id
from mapless.provenance import ADOPTED
from mapless_server.errors import InvalidArgument
from mapless_server.images import ImageLimits, decode_depth
from mapless_server.method.pairs.readings.depth import implausible_depth
from mapless_server.method.pairs.readings.verdict import Verdict
from mapless_server.scenes.plausibility import another_unit, contradictions
from mapless_server.serve.signals import terminable
from mapless_server.services.messages.references import nearly_ignored
from mapless_server.settings import Settings
from mapless_server.store import ContradictingDown, DatumWithoutMetres, SceneAttributes
from mapless_tools.child import ServerFailed
from mapless_tools.connection import Connection, connected
from mapless_tools.dataset import MAX_NAME_LENGTH, Dataset, Frame, Refusal
from mapless_tools.output_files import check_writable, write_json
from mapless_tools.progress import Progress, progress_bars

from .check import check_frames, check_with_scene
from .depth_notes import implausible_unit, unknown_sensor
from .existing import NO_METRES, KnownReferences, WrongUnit, open_scene
from .formats import ReadOptions, read_dataset
from .metres import MetreOptions, in_metres, read_positions
from .report import (
    SAME_POSE,
    WRONG_POSES,
    WRONG_WORLD,
    ImportReport,
    not_aligned,
    print_report,
    to_json,
    verdict_lines,
)
from .upload import Uploader, read_item


@dataclass(frozen=True)
class ImportOptions:
    """Options of an import.

    Attributes:
        format: name of the folder's layout, or "auto".
        metres: how lengths become metres, if the folder's unit is another.
        split: the split whose frames are used, "train" or "test"; empty for all.
        stride: every n-th frame is used.
        max_count: largest number of frames, evenly spread; None for all.
        id_prefix: prefix of every reference's id, for several folders in one scene.
        check: whether to compare photographs with the poses, and with the scene's references, first.
        align_to_scene: whether to bring the frames into the world of the scene's references, by matches with them.
        parallel: number of messages in flight, 1 to 64; the server describes their photographs concurrently.
        labels: labels that the scene gets, beside those that it has.
    """

    format: str = "auto"
    read: ReadOptions = field(default_factory=ReadOptions)
    metres: MetreOptions = field(default_factory=MetreOptions)
    split: str = ""
    stride: int = 1
    max_count: int | None = None
    id_prefix: str = ""
    check: bool = True
    align_to_scene: bool = False
    parallel: int = 3
    labels: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_labels(self.labels)
        if self.split not in ("", "train", "test"):
            raise ValueError(f"split must be train or test, not {self.split!r}")
        if self.stride < 1 or (self.max_count is not None and self.max_count < 1):
            raise ValueError(f"stride and max must be at least 1, not {self.stride} and {self.max_count}")
        if not 1 <= self.parallel <= 64:
            raise ValueError(f"--parallel is the number of messages in flight, 1 to 64, not {self.parallel}")
        if self.id_prefix:
            check_id(f"{self.id_prefix}0")


def run_import(
    folder: Path,
    scene: str,
    options: ImportOptions,
    settings: Settings,
    connection: Connection | None,
    report_file: Path | None,
) -> bool:
    """Runs an import, a dry one without a connection; prints what it does and finds.

    Returns whether everything was imported, or could be. ValueError if the folder, the scene's id or the connection
    cannot be used.
    """
    _check_names(scene, report_file)
    dataset, frames = read_frames(folder, options)
    _print(f"{folder}: {len(dataset.frames)} frames in layout {dataset.format}, {len(frames)} of them chosen")
    for note in dataset.notes:
        _print(f"note: {note}")
    if not dataset.metric:
        _print(f"note: {NO_METRES}")
    if note := unknown_sensor(frames):
        _print(f"note: {note}")
    report = ImportReport(scene, dataset, frames, is_dry=connection is None)
    with terminable(), _reported(report, report_file):
        if dataset.metric:
            _warn(report, [implausible_unit(frames)])
        if options.check:
            with progress_bars() as progress:
                _warn(report, much_ignored(frames))
                report.verdict = check_frames(frames, progress)
            for line in verdict_lines(report.verdict, frames):
                _print(line)
            leave_same_poses(report, report.verdict)
            if dataset.metric:
                _warn(report, [implausible_depth(report.verdict.median_depth)])
        if connection is None:
            _warn(report, contradictions([frame.world_from_camera for frame in frames], _attributes(dataset)))
            refuse_wrong_images(report)
        elif report.verdict is not None and report.verdict.is_wrong:
            report.stopped = WRONG_POSES
        else:
            _store(report, options, settings, connection)
    return report.went_well


class ImportFailed(Exception):
    """The server of an import cannot be used; the message is for a person."""


def check_before_poses(
    scene: str, options: ImportOptions, settings: Settings, connection: Connection | None, report_file: Path | None
) -> None:
    """Checks all that an import needs besides the folder, before the poses of a video are computed.

    ValueError for an option, ImportFailed for the server.
    """
    _check_names(scene, report_file)
    if options.format not in ("auto", "cameras"):
        raise ValueError(f"--format is the layout of a folder of posed photographs, a video has none: {options.format}")
    if options.split:
        raise ValueError("--split is of folders that have splits; the frames of a video have none")
    read = options.read
    if read.intrinsics is not None:
        raise ValueError("--intrinsics is of layouts without: mapless-server reconstruct --lens gives a video's")
    for flag, path in (("--images", read.images), ("--masks", read.masks), ("--ground-truth", read.ground_truth)):
        if path is not None:
            raise ValueError(f"{flag} is of folders of posed photographs: import the folder that reconstruct writes")
    if options.metres.positions is not None:
        read_positions(options.metres.positions)
    if connection is not None:
        try:
            with connected(connection, settings) as client:
                next(client.list_scenes(), None)
        except (MaplessError, ServerFailed) as error:
            raise ImportFailed(str(error)) from error


def _check_names(scene: str, report_file: Path | None) -> None:
    check_id(scene)
    if report_file is not None:
        check_writable(report_file)


def read_frames(folder: Path, options: ImportOptions) -> tuple[Dataset, tuple[Frame, ...]]:
    """Reads the dataset and selects the frames to import; ValueError if it contradicts itself, or none is left."""
    dataset = in_metres(read_dataset(folder, options.format, options.read), options.metres, options.id_prefix)
    _attributes(dataset)
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
    names = {frame.name for frame in dataset.frames}
    return dataset, tuple(_prefixed(frame, options.id_prefix, names) for frame in frames)


def much_ignored(frames: Sequence[Frame]) -> list[str]:
    """A warning if the first mask ignores most of its photograph, as an inverted one does; else empty."""
    masked = next((frame for frame in frames if frame.mask_path is not None), None)
    try:
        ignored = None if masked is None else masked.read_ignored()
    except (OSError, InvalidArgument):  # refused by name, where it is read
        return []
    return [] if masked is None or ignored is None else nearly_ignored({masked.name: float(ignored.mean())})


def leave_same_poses(report: ImportReport, verdict: Verdict) -> None:
    """Refuses the frames whose pose several others have that show different things."""
    for group in verdict.same_pose:
        reason = SAME_POSE.format(count=len(group) - 1)
        report.refused += [Refusal(report.chosen[i].name, reason) for i in group]


MOST_LOST_SHARE = 0.5
"""A server retires adopted references of which a larger share of the vouching matches is with missing references."""


def leave_unvouched(report: ImportReport, existing: Sequence[Reference]) -> None:
    """Refuses the adopted frames that the server would retire, as what vouches for them is not in the scene."""
    there = {it.reference_id for it in existing if it.provenance.source != ADOPTED and it.retire_time is None}
    there |= {it.name for it in report.chosen if it.provenance.source != ADOPTED} - {it.frame for it in report.refused}
    for frame in report.chosen:
        vouchers = frame.provenance.vouchers
        missing = [it for it in vouchers if it.reference_id not in there]
        if sum(it.match_count for it in missing) > MOST_LOST_SHARE * sum(it.match_count for it in vouchers):
            named = ", ".join(it.reference_id for it in missing[:3]) + (", ..." if len(missing) > 3 else "")
            reason = f"adopted, and the surveyed references that its pose rests on are not in the scene: {named}"
            report.refused.append(Refusal(frame.name, reason))


def refuse_wrong_images(report: ImportReport) -> None:
    """Refuses the chosen frames whose image, by its header, mask or depth a server would reject; for a dry run."""
    faults = [(frame.name, _fault_of_files(frame)) for frame in report.chosen]
    report.refused += [Refusal(name, fault) for name, fault in faults if fault]


def _fault_of_files(frame: Frame) -> str:
    """Why a frame's image, mask or depth is wrong; empty if all are right."""
    file = frame.mask_path
    try:
        new, _ = read_item(frame, ImageLimits())
        frame.read_ignored()
        if frame.depth is not None and new.depth is not None:
            file = frame.depth.path
            decode_depth(new.depth, (frame.camera.width_px, frame.camera.height_px), ImageLimits())
    except ValueError as error:
        return str(error)
    except (OSError, InvalidArgument) as error:
        return f"{file}: {error}"
    return ""


def _store(report: ImportReport, options: ImportOptions, settings: Settings, connection: Connection) -> None:
    """Stores the chosen frames in the scene, which is created with the dataset's datum and down if missing."""
    try:
        with connected(connection, settings) as client, progress_bars() as progress:
            existing = open_scene(
                client, report.scene, report.dataset, report.chosen, options.align_to_scene, options.labels
            )
            if (options.check or options.align_to_scene) and not _fits_scene(
                report, options.align_to_scene, client, existing, progress
            ):
                return
            scene = client.get_scene(report.scene)
            poses = [frame.world_from_camera for frame in report.chosen]
            attributes = SceneAttributes(scene.datum, scene.down_in_world, arbitrary_unit=scene.arbitrary_unit)
            _warn(report, contradictions(poses, attributes))
            _warn(report, [another_unit([it.world_from_camera for it in existing], poses)])
            leave_unvouched(report, existing)
            Uploader(client, KnownReferences(existing), report, options.parallel, progress).run()
            report.pending = client.get_scene(report.scene).pending_work
    except WrongUnit as error:
        report.stopped = str(error)
    except (MaplessError, ServerFailed) as error:
        report.stopped = str(error)
        report.is_server_gone = isinstance(error, (DeadlineExceeded, Unavailable, ServerFailed))


def _fits_scene(
    report: ImportReport, is_to_align: bool, client: Client, existing: Sequence[Reference], progress: Progress
) -> bool:
    """Compares the chosen frames with the scene's references, and aligns them if asked; False stops the import."""
    if not existing:
        if is_to_align:
            report.stopped = "--align-to-scene: the scene has no references yet"
        return not is_to_align
    verdict = report.scene_verdict = check_with_scene(client, report.scene, report.chosen, existing, progress)
    for line in verdict.lines():
        _print(line)
    if not is_to_align:
        if verdict.is_wrong:
            report.stopped = WRONG_WORLD
        return not verdict.is_wrong
    found = verdict.alignment
    if found is None or not found.is_unique:
        report.stopped = not_aligned(found)
        return False
    _print(f"aligned to the scene ({found.median_px:.2f} px over {found.pair_count} pairs): {found.text}")
    report.chosen = [
        replace(
            frame,
            world_from_camera=found.world_from_other.transform_pose(frame.world_from_camera),
            depth=frame.depth and frame.depth.scaled(found.world_from_other.scale),
        )
        for frame in report.chosen
    ]
    return True


def _attributes(dataset: Dataset) -> SceneAttributes:
    try:
        return SceneAttributes(dataset.datum, dataset.down_in_world, arbitrary_unit=not dataset.metric)
    except DatumWithoutMetres:
        raise ValueError(f"the folder has a datum, which needs metres, but {NO_METRES}") from None
    except ContradictingDown as error:
        raise ValueError(f"the folder's down_in_world {error}") from None


def _warn(report: ImportReport, texts: Sequence[str]) -> None:
    for text in filter(None, texts):
        report.warnings.append(text)
        _print(f"warning: {text}")


@contextmanager
def _reported(report: ImportReport, file: Path | None) -> Iterator[None]:
    """Prints and writes the report at the end of the block, also after an exception."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit):
        report.stopped = report.stopped or "interrupted"
        raise
    finally:
        print_report(report, Console(soft_wrap=True))
        if file is not None:
            write_json(file, to_json(report))


def _prefixed(frame: Frame, prefix: str, names: Collection[str]) -> Frame:
    """The frame with the prefix before its name, and before those of its vouchers that are among the folder's."""
    if not prefix:
        return frame
    name = f"{prefix}{frame.name}"
    if len(name) > MAX_NAME_LENGTH:
        raise ValueError(f"{name} is longer than the {MAX_NAME_LENGTH} characters that an id may have")
    vouchers = tuple(
        replace(it, reference_id=f"{prefix}{it.reference_id}") if it.reference_id in names else it
        for it in frame.provenance.vouchers
    )
    return replace(frame, name=name, provenance=replace(frame.provenance, vouchers=vouchers))


def _print(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
