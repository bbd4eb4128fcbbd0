"""`mapless-server replay`: computes captured answers again; `replay-bag`: localizes a robot's recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapless_server.serve.command import fail
from mapless_tools.bags.options import BagOptions
from mapless_tools.connection import Connection, with_flags

if TYPE_CHECKING:
    from .report import Replayed, Report

SHOWN_CHANGES = 12


def replay_command(
    folder: Annotated[Path, typer.Argument(help="A server's capture_dir, or a copy of it.")],
    request_id: Annotated[
        list[str] | None, typer.Option("--id", help="Only the call of this id; again for more.")
    ] = None,
    last: Annotated[int | None, typer.Option(min=1, help="Only so many, the latest.")] = None,
    tenant: Annotated[str, typer.Option(help="Only this tenant's.")] = "",
    scene: Annotated[str, typer.Option(help="Only those in the scene of this id.")] = "",
    json_output: Annotated[bool, typer.Option("--json", help="Everything, as JSON.")] = False,
    backup: Annotated[
        Path | None, typer.Option(help="A backup of the store, to read references from; default: the settings' store.")
    ] = None,
    data_dir: Annotated[Path | None, typer.Option(help="Folder of the store; default: the server's setting.")] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file of settings; also MAPLESS_CONFIG.")] = None,
    backend: Annotated[str | None, typer.Option(help="As the server's setting.")] = None,
    features: Annotated[str | None, typer.Option(help="As the server's setting.")] = None,
    device: Annotated[str | None, typer.Option(help="As the server's setting.")] = None,
    weights_dir: Annotated[Path | None, typer.Option(help="As the server's setting.")] = None,
) -> None:
    """Compute captured answers again, by this program and its settings; exit code 1 unless all are identical.

    Identical is to the last bit. References are read from the store that answered, which may be served meanwhile, or a
    backup of it. The choice among them is that of the captured answer; a call whose references have changed since is
    not computed, and names them.
    """
    from mapless_server.serve.libraries import configure_libraries
    from mapless_server.settings import ConfigError, load_settings

    flags = {
        "data_dir": data_dir,
        "backend": backend,
        "features": features,
        "device": device,
        "weights_dir": weights_dir,
    }
    try:
        settings = load_settings(flags, config).settings
    except ConfigError as error:
        fail(str(error))
    configure_libraries(settings)

    from mapless_server.services.capture.calls import CaptureError

    from .report import Selection, replay

    try:
        selection = Selection(frozenset(request_id or ()), last, tenant, scene)
        report = replay(folder, selection, settings, backup)
    except CaptureError as error:
        fail(str(error))
    if json_output:
        import json
        from dataclasses import asdict

        print(json.dumps(asdict(report) | {"is_identical": report.is_identical}, indent=2))
    else:
        _print(report)
    raise typer.Exit(0 if report.is_identical else 1)


def _print(report: Report) -> None:
    for change in report.circumstances:
        print(f"{change.field}: then {change.then}, now {change.now}")
    if report.circumstances:
        print()
    for call in report.calls:
        _print_call(call)
    for fault in report.unreadable:
        print(f"unreadable: {fault}")
    counts = {name: sum(it.verdict == name for it in report.calls) for name in ("identical", "changed", "not computed")}
    counts["unreadable"] = len(report.unreadable)
    print(", ".join(f"{count} {name}" for name, count in counts.items() if count) or "nothing to compare")


def _print_call(call: Replayed) -> None:
    head = f"{call.time} {call.request_id} {call.method} {call.tenant}/{call.scene_id}"
    if call.error:
        print(f"{head}: {call.verdict}, {call.outcome_then} then; now {call.error}")
        return
    print(f"{head}: {call.verdict}, {call.outcome_now}, {call.seconds_then:.2f} s then, {call.seconds_now:.2f} s now")
    for damaged in call.damaged:
        print(f"    left out: {damaged}")
    if call.verdict == "identical":
        return
    if call.apart_cm is not None and call.apart_deg is not None:
        print(f"    the poses are {call.apart_cm:.4f} cm and {call.apart_deg:.5f} degrees apart")
    for change in call.changes[:SHOWN_CHANGES]:
        print(f"    {change.field}: {change.then} → {change.now}")
    if len(call.changes) > SHOWN_CHANGES:
        print(f"    and {len(call.changes) - SHOWN_CHANGES} more, see --json")


@with_flags
def replay_bag_command(
    recording: Annotated[Path, typer.Argument(help="Folder of rosbag2, or an .mcap or .db3 file.")],
    scene: Annotated[str, typer.Argument(help="Id of the scene to localize in.")],
    out: Annotated[Path, typer.Argument(help="Folder to write: a rosbag2 with an MCAP file. Must not exist.")],
    rate: Annotated[float, typer.Option(help="Images localized a second of the recording; 0: all.")] = 1.0,
    coverage: Annotated[float, typer.Option(help="Share of right answers to accept; 0: the server's default.")] = 0.0,
    use_last_pose: Annotated[
        bool, typer.Option("--use-last-pose", help="The last answer, moved by the odometry, is a prior of the next.")
    ] = False,
    sequence_length: Annotated[
        int, typer.Option(help="Localize an image that is rejected alone with so many, 2 to 16, by the odometry.")
    ] = 0,
    allow_adoption: Annotated[
        bool, typer.Option("--allow-adoption", help="Images may be kept as references, if the scene adopts.")
    ] = False,
    map_frame: Annotated[str, typer.Option(help="Name of the scene's world in what is written.")] = "map",
    odom_frame: Annotated[str, typer.Option(help="Frame of the odometry; default: that of the poses.")] = "",
    base_frame: Annotated[str, typer.Option(help="Frame whose pose is written; default: that of the poses.")] = "",
    camera: Annotated[str, typer.Option(help="Intrinsics, JSON or a file, for a recording without CameraInfo.")] = "",
    data_dir: Annotated[
        Path | None, typer.Option(help="Folder of the store, where no --address is given; default: the settings'.")
    ] = None,
    *,
    bag: BagOptions,
    connection: Connection,
) -> None:
    """Localize the images of a robot's recording, and write poses, map > odom and diagnostics as a recording.

    As the ROS 2 package does on a robot. Exit code 1 if it ended early; what was computed until then is written.
    """
    from mapless.cameras import read_camera
    from mapless.ros import LocalizerOptions
    from mapless_server.serve.signals import terminable
    from mapless_server.settings import load_settings
    from mapless_tools.connection import connected
    from mapless_tools.progress import progress_bars
    from mapless_tools.usage import failures_end_command

    from .bags import replay_bag

    with failures_end_command(ValueError):
        if data_dir is not None and connection.address:
            raise ValueError("--data-dir is a store, --address a server: give one of them")
        options = LocalizerOptions(
            scene=scene,
            map_frame=map_frame,
            odom_frame=odom_frame,
            base_frame=base_frame,
            rate_hz=rate,
            use_last_pose=use_last_pose,
            coverage=coverage,
            timeout_s=60.0,
            allow_adoption=allow_adoption,
        )
        settings = load_settings({"data_dir": data_dir}).settings
        given = read_camera(camera) if camera else None
        with terminable(), connected(connection, settings) as client, progress_bars() as progress:
            report = replay_bag(recording, out, client, bag, options, given, progress, sequence_length)
    print(*report.lines(), f"written to {out}", sep="\n")
    raise typer.Exit(1 if report.stopped else 0)
