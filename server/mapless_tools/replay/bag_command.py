"""`mapless-server replay-bag`: localizes a robot's recording, and writes the answers as another."""

from pathlib import Path
from typing import Annotated

import typer

from mapless_tools.bags.flags import BagFlags
from mapless_tools.connection import Connection, with_flags


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
    map_frame: Annotated[str, typer.Option(help="Name of the scene's world in what is written.")] = "map",
    odom_frame: Annotated[str, typer.Option(help="Frame of the odometry; default: that of the poses.")] = "",
    base_frame: Annotated[str, typer.Option(help="Frame whose pose is written; default: that of the poses.")] = "",
    camera: Annotated[str, typer.Option(help="Intrinsics, JSON or a file, for a recording without CameraInfo.")] = "",
    data_dir: Annotated[
        Path | None, typer.Option(help="Folder of the store, where no --address is given; default: the settings'.")
    ] = None,
    *,
    bag: BagFlags,
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
        )
        settings = load_settings({"data_dir": data_dir}).settings
        given = read_camera(camera) if camera else None
        found = bag.options()
        with terminable(), connected(connection, settings) as client, progress_bars() as progress:
            report = replay_bag(recording, out, client, found, options, given, progress, sequence_length)
    print(*report.lines(), f"written to {out}", sep="\n")
    raise typer.Exit(1 if report.stopped else 0)
