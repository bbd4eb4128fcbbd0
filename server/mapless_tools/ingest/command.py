"""`mapless-server import` and `export`: arguments in, a report out."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

if TYPE_CHECKING:
    from mapless_server.settings import Settings
    from mapless_tools.connection import Connection

    from .formats import Intrinsics
    from .importing import ImportOptions
    from .report import ImportReport

FORMAT_NAMES = "auto, cameras, colmap, 7scenes, 12scenes, cambridge, nerf, tum, arkit"

Scene = Annotated[str, typer.Argument(help="Id of the scene.")]
Address = Annotated[
    str, typer.Option(help="host:port of the server; default: one is started on the store of the settings.")
]
DataDir = Annotated[
    Path | None, typer.Option(help="Folder of the store, where no --address is given; default: that of the settings.")
]
Tls = Annotated[bool, typer.Option("--tls", help="Encrypt; --ca and --cert imply it.")]
Ca = Annotated[Path | None, typer.Option(help="Certificate that signed the server's, PEM.")]
Cert = Annotated[Path | None, typer.Option(help="Our own certificate, PEM, if the server asks.")]
Key = Annotated[Path | None, typer.Option(help="Its key, PEM.")]
TokenFile = Annotated[Path | None, typer.Option(help="Holds the token to show; default: that in MAPLESS_TOKEN.")]
ClientId = Annotated[str, typer.Option(help="Which of the token's users this is.")]


def import_command(
    folder: Annotated[Path, typer.Argument(help="Folder with photographs and their poses.")],
    scene: Scene,
    format: Annotated[str, typer.Option(help=f"Layout of the folder: {FORMAT_NAMES}.")] = "auto",
    images: Annotated[Path | None, typer.Option(help="Folder of a COLMAP model's images.")] = None,
    ground_truth: Annotated[
        Path | None, typer.Option(help="SfM pseudo ground truth of 7-Scenes or 12-Scenes, instead of their own poses.")
    ] = None,
    intrinsics: Annotated[
        str, typer.Option(help="fx,fy,cx,cy in pixels, for layouts without; (0, 0) is the first pixel's centre.")
    ] = "",
    split: Annotated[str, typer.Option(help="Take only this split: train or test.")] = "",
    stride: Annotated[int, typer.Option(help="Take every so-manieth photograph.")] = 1,
    max_count: Annotated[int | None, typer.Option("--max", help="Take so many at most, spread evenly.")] = None,
    id_prefix: Annotated[str, typer.Option(help="Put before every id: for several folders in one scene.")] = "",
    parallel: Annotated[int, typer.Option(help="Messages in flight.")] = 3,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Read and check the poses, store nothing.")] = False,
    skip_check: Annotated[bool, typer.Option("--skip-check", help="Do not compare photographs with poses.")] = False,
    report: Annotated[Path | None, typer.Option(help="JSON file for the whole report.")] = None,
    data_dir: DataDir = None,
    address: Address = "",
    tls: Tls = False,
    ca: Ca = None,
    cert: Cert = None,
    key: Key = None,
    token_file: TokenFile = None,
    client_id: ClientId = "",
) -> None:
    """Store the posed photographs of a folder as references of a scene; run it again to go on where it was cut off."""
    from mapless_server.settings import ConfigError
    from mapless_tools.connection import Connection

    from .formats import ReadOptions
    from .importing import ImportOptions
    from .waiting import UploadOptions

    try:
        options = ImportOptions(
            format=format,
            read=ReadOptions(images=images, ground_truth=ground_truth, intrinsics=_intrinsics(intrinsics)),
            split=split,
            stride=stride,
            max_count=max_count,
            id_prefix=id_prefix,
            check=not skip_check,
            upload=UploadOptions(parallel=parallel),
        )
        settings = _settings(data_dir, address)
        connection = Connection(address, tls, ca, cert, key, token_file, client_id)
    except (ValueError, ConfigError) as error:
        _fail(str(error))
    _run_import(folder, scene, options, settings, None if dry_run else connection, report)


def export_command(
    scene: Scene,
    folder: Annotated[Path, typer.Argument(help="Folder to write to; must be empty or not be there.")],
    format: Annotated[str, typer.Option(help="Layout: cameras or colmap.")] = "cameras",
    data_dir: DataDir = None,
    address: Address = "",
    tls: Tls = False,
    ca: Ca = None,
    cert: Cert = None,
    key: Key = None,
    token_file: TokenFile = None,
    client_id: ClientId = "",
) -> None:
    """Write the references of a scene to a folder, their images bit by bit as they are stored.

    One that is damaged in the store is named and left out; the exit code is then 1, and the folder whole without it.
    """
    from mapless import MaplessError
    from mapless_server.serve.signals import terminable
    from mapless_server.settings import ConfigError
    from mapless_tools.child import ServerFailed
    from mapless_tools.connection import Connection, connected
    from mapless_tools.progress import progress_bars

    from .exporting import check_target, export_scene

    try:
        check_target(folder, format)
        settings = _settings(data_dir, address)
        connection = Connection(address, tls, ca, cert, key, token_file, client_id)
        with terminable(), connected(connection, settings) as client, progress_bars() as progress:
            export = export_scene(client, scene, folder, format, progress)
    except (ValueError, ConfigError) as error:
        _fail(str(error))
    except (MaplessError, ServerFailed, OSError) as error:
        _fail(str(error), code=1)
    for reason in export.damaged.values():
        _say(f"skipped: {reason}")
    where = f"references of scene {scene} are in {folder}"
    if export.damaged:
        count = len(export.damaged)
        _fail(f"{export.written} of {export.total} written, {count} damaged; the {export.written} {where}", code=1)
    print(f"{export.written} {where}")


def _run_import(
    folder: Path,
    scene: str,
    options: ImportOptions,
    settings: Settings,
    connection: Connection | None,
    report_file: Path | None,
) -> None:
    """An import, without a connection a dry one; raises typer.Exit."""
    from mapless.names import check_id
    from mapless_server.serve.signals import terminable
    from mapless_tools.output_files import check_writable
    from mapless_tools.progress import progress_bars

    from .check import check_frames
    from .importing import read_frames, refuse_wrong_images
    from .report import ImportReport, verdict_lines

    try:
        check_id(scene)
        if report_file is not None:
            check_writable(report_file)
        dataset, frames = read_frames(folder, options)
    except ValueError as error:
        _fail(str(error))
    _say(f"{folder}: {len(dataset.frames)} frames in layout {dataset.format}, {len(frames)} of them chosen")
    for note in dataset.notes:
        _say(f"note: {note}")
    if not dataset.metric and not dataset.notes:
        _say(
            "note: its unit of length is not the metre; it is taken for metres, and all distances are then in that unit"
        )
    report = ImportReport(scene, dataset, frames, is_dry=connection is None)
    with terminable(), _reported(report, report_file):
        if options.check:
            with progress_bars() as progress:
                report.verdict = check_frames(frames, progress)
            for line in verdict_lines(report.verdict, frames):
                _say(line)
        if connection is None:
            refuse_wrong_images(report)
        elif report.verdict is not None and report.verdict.is_wrong:
            report.stopped = "nothing is stored while the poses do not fit the photographs; --skip-check does it anyhow"
        else:
            _store(report, options, settings, connection)
    raise typer.Exit(0 if report.went_well else 1)


def _store(report: ImportReport, options: ImportOptions, settings: Settings, connection: Connection) -> None:
    from mapless import MaplessError
    from mapless_tools.child import ServerFailed
    from mapless_tools.connection import connected
    from mapless_tools.progress import progress_bars

    from .importing import store_frames

    try:
        with connected(connection, settings) as client, progress_bars() as progress:
            store_frames(client, report, options.upload, progress)
    except ValueError as error:
        _fail(str(error))
    except (MaplessError, ServerFailed) as error:
        report.stopped = str(error)


@contextmanager
def _reported(report: ImportReport, file: Path | None) -> Iterator[None]:
    """Whatever way the block is left, the report is printed and written."""
    from rich.console import Console

    from mapless_tools.output_files import write_json

    from .report import print_report, to_json

    try:
        yield
    except (KeyboardInterrupt, SystemExit):
        report.stopped = report.stopped or "interrupted"
        raise
    finally:
        print_report(report, Console(soft_wrap=True))
        if file is not None:
            write_json(file, to_json(report))


def _settings(data_dir: Path | None, address: str) -> Settings:
    from mapless_server.settings import load_settings

    if data_dir is not None and address:
        raise ValueError("--data-dir is a store, --address a server: say one of them")
    return load_settings({"data_dir": data_dir}).settings


def _intrinsics(text: str) -> Intrinsics | None:
    from .formats import Intrinsics

    if not text:
        return None
    try:
        focal_x, focal_y, principal_x, principal_y = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"intrinsics must be fx,fy,cx,cy, not {text!r}") from None
    return Intrinsics(focal_x, focal_y, principal_x, principal_y)


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _fail(message: str, code: int = 2) -> NoReturn:
    print(f"mapless-server: {message}", file=sys.stderr)
    raise typer.Exit(code)
