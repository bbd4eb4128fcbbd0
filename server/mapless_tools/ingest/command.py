"""The flags of `mapless-server import` and `export`. Imports modules when it runs, so that --help is quick."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from mapless_command.installation import how_to_install
from mapless_server.extras import missing_package
from mapless_server.serve.command import fail
from mapless_tools.bags.options import BagOptions
from mapless_tools.connection import Connection, Scene, with_flags

from . import FORMATS
from .depth_options import DepthOptions

if TYPE_CHECKING:
    from mapless_server.settings import Settings

    from .formats import Intrinsics
    from .metres import KnownDistance

FORMAT_NAMES = ", ".join(["auto", *FORMATS])

DataDir = Annotated[
    Path | None, typer.Option(help="Folder of the store, where no --address is given; default: that of the settings.")
]


DISTANCE_SEPARATOR = "\0"


class ImportCommand(TyperCommand):
    """Accepts three values for each --distance; typer accepts several values only once."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Reads arguments, and the three values of a distance as one."""
        joined: list[str] = []
        rest = iter(args)
        for argument in rest:
            joined.append(argument)
            if argument == "--distance":
                values = [*islice(rest, 3)]
                if len(values) < 3:
                    fail("--distance takes three values: two references and metres")
                joined.append(DISTANCE_SEPARATOR.join(values))
        return super().parse_args(ctx, joined)


@with_flags
def import_command(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder with photographs and their poses, or a recording of a robot; or a video, "
            "whose poses are computed first, into a folder beside it (by reconstruct, which has more flags)."
        ),
    ],
    scene: Scene,
    format: Annotated[str, typer.Option(help=f"Layout of the folder: {FORMAT_NAMES}.")] = "auto",
    images: Annotated[Path | None, typer.Option(help="Folder of a COLMAP model's images.")] = None,
    masks: Annotated[
        Path | None,
        typer.Option(help="Folder of masks, 0 = ignore: a/1.jpg.png for a/1.jpg, as COLMAP has them; or one for all."),
    ] = None,
    ground_truth: Annotated[
        Path | None, typer.Option(help="SfM pseudo ground truth of 7-Scenes or 12-Scenes, instead of their own poses.")
    ] = None,
    intrinsics: Annotated[
        str, typer.Option(help="fx,fy,cx,cy in pixels, for layouts without; (0, 0) is the first pixel's centre.")
    ] = "",
    keyframe_distance: Annotated[
        float, typer.Option(help="Of a recording or `stray`: metres from one keyframe to the next; 0: all images.")
    ] = 0.3,
    keyframe_angle: Annotated[
        float, typer.Option(help="Of a recording or `stray`: degrees from one keyframe to the next; 0: all images.")
    ] = 15.0,
    scale: Annotated[
        float | None, typer.Option(help="Metres per unit of the folder, where that is not the metre.")
    ] = None,
    distance: Annotated[
        list[str] | None,
        typer.Option(metavar="A B METRES", help="Measured distance of the cameras of two references; may be repeated."),
    ] = None,
    tag: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FAMILY:ID=METRES",
            help="In a video: a printed AprilTag or ArUco marker and the edge of its black square; may be repeated.",
        ),
    ] = None,
    align: Annotated[
        Path | None, typer.Option(help="CSV file of known camera positions: reference, x, y, z in metres.")
    ] = None,
    split: Annotated[str, typer.Option(help="Take only this split: train or test.")] = "",
    stride: Annotated[int, typer.Option(help="Take only the first of every so many photographs.")] = 1,
    max_count: Annotated[int | None, typer.Option("--max", help="Take so many at most, spread evenly.")] = None,
    id_prefix: Annotated[str, typer.Option(help="Put before every id: for several folders in one scene.")] = "",
    parallel: Annotated[int, typer.Option(help="Messages in flight.")] = 3,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Read and check the poses, store nothing.")] = False,
    skip_check: Annotated[
        bool, typer.Option("--skip-check", help="Do not compare photographs with poses, nor with the scene.")
    ] = False,
    align_to_scene: Annotated[
        bool,
        typer.Option(
            "--align-to-scene",
            help="Bring the photographs into the world of the scene's references, by a similarity that fits matches.",
        ),
    ] = False,
    label: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Label of the scene, by which groups find it; may be repeated."),
    ] = None,
    report: Annotated[Path | None, typer.Option(help="JSON file for the whole report.")] = None,
    data_dir: DataDir = None,
    *,
    bag: BagOptions,
    depths: DepthOptions,
    connection: Connection,
) -> None:
    """Store the posed photographs of a folder, or keyframes of a recording, as references of a scene.

    Run it again to go on where it was cut off.
    """
    from mapless.labels import parse_labels
    from mapless_server.settings import ConfigError

    from .formats import KeyframeOptions, ReadOptions
    from .importing import ImportFailed, ImportOptions, check_before_poses, run_import
    from .metres import MetreOptions

    try:
        read = ReadOptions(
            images=images,
            masks=masks,
            ground_truth=ground_truth,
            intrinsics=_intrinsics(intrinsics),
            bag=bag,
            keyframes=KeyframeOptions(keyframe_distance, keyframe_angle),
            depths=depths,
        )
        options = ImportOptions(
            format=format,
            read=read,
            metres=MetreOptions(scale, tuple(map(_known_distance, distance or ())), align),
            split=split,
            stride=stride,
            max_count=max_count,
            id_prefix=id_prefix,
            check=not skip_check,
            align_to_scene=align_to_scene,
            parallel=parallel,
            labels=parse_labels(label or ()),
        )
        settings = _settings(data_dir, connection)
        where = None if dry_run else connection
        if _is_video(folder):
            check_before_poses(scene, options, settings, where, report)
            folder = _posed(folder, tag or ())
        elif tag:
            raise ValueError(f"--tag gives the unit of a video, and {folder} is none")
        went_well = run_import(folder, scene, options, settings, where, report)
    except (ValueError, ConfigError) as error:
        fail(str(error))
    except ImportFailed as error:
        fail(str(error), code=1)
    raise typer.Exit(0 if went_well else 1)


@with_flags
def export_command(
    scene: Scene,
    folder: Annotated[Path, typer.Argument(help="Folder to write to; must be empty or not be there.")],
    format: Annotated[str, typer.Option(help="Layout: cameras, colmap, kapture, or gltf to look at.")] = "cameras",
    adopted: Annotated[
        str, typer.Option(help="References that were adopted from localized photographs: with, without or only.")
    ] = "with",
    data_dir: DataDir = None,
    *,
    connection: Connection,
) -> None:
    """Write the references of a scene to a folder, their images bit by bit as they are stored.

    One that is damaged in the store is named and left out; the exit code is then 1, and the folder whole without it.
    """
    from mapless_server.serve.signals import terminable
    from mapless_tools.connection import connected
    from mapless_tools.progress import progress_bars
    from mapless_tools.usage import failures_end_command

    from .exporting import check_target, export_scene

    with failures_end_command(ValueError):
        check_target(folder, format)
        settings = _settings(data_dir, connection)
        with terminable(), connected(connection, settings) as client, progress_bars() as progress:
            export = export_scene(client, scene, folder, format, progress, adopted)
    for reason in export.damaged.values():
        print(f"skipped: {reason}", file=sys.stderr)
    if export.without_depth:
        count = export.without_depth
        print(f"note: {format} has no depth, that of {count} references is not written", file=sys.stderr)
    where = f"references of scene {scene} are in {folder}"
    if export.damaged:
        count = len(export.damaged)
        fail(f"{export.written} of {export.total} written, {count} damaged; the {export.written} {where}", code=1)
    print(f"{export.written} {where}")


def _is_video(source: Path) -> bool:
    from mapless_tools.reconstruct.sources.finding import VIDEOS

    return source.is_file() and source.suffix.lower() in VIDEOS


def _posed(source: Path, tags: Sequence[str]) -> Path:
    """The folder of a video's frames with poses, which are computed; here, for a video's own may not be written to."""
    from mapless_tools.usage import failures_end_command

    if package := missing_package("reconstruct"):
        raise ValueError(f"a video needs the Python package {package}: {how_to_install('reconstruct')}")
    from mapless_tools.reconstruct.folder import reconstruct_into
    from mapless_tools.reconstruct.run import ReconstructOptions
    from mapless_tools.reconstruct.sources import SourceOptions
    from mapless_tools.reconstruct.world.options import WorldOptions, parse_sized_tag

    out = Path(f"{source.stem}-posed")
    world = WorldOptions(tags=tuple(map(parse_sized_tag, tags)))
    with failures_end_command(ValueError, interrupted="interrupted; run it again to go on"):
        reconstruct_into([source], out, SourceOptions(excluded=(out,)), ReconstructOptions(world=world))
    return out


def _settings(data_dir: Path | None, connection: Connection) -> Settings:
    from mapless_server.settings import load_settings

    if data_dir is not None and connection.address:
        raise ValueError("--data-dir is a store, --address a server: give one of them")
    return load_settings({"data_dir": data_dir}).settings


def _known_distance(text: str) -> KnownDistance:
    from .metres import known_distance

    first, second, metres = text.split(DISTANCE_SEPARATOR)
    return known_distance(first, second, metres)


def _intrinsics(text: str) -> Intrinsics | None:
    from .formats import Intrinsics

    if not text:
        return None
    try:
        focal_x, focal_y, principal_x, principal_y = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"intrinsics must be fx,fy,cx,cy, not {text!r}") from None
    return Intrinsics(focal_x, focal_y, principal_x, principal_y)
