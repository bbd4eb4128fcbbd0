"""`make demo-video`: from nothing but a video to localized photographs, judged against the rendered truth.

The video is rendered by `video`, and has a printed tag of known size in it. Its frames get poses and metres by
`mapless-server reconstruct`, and become a scene by `mapless-server import`; then the eight queries of the demo's room,
which are of another camera and not of the video, are localized in it.
"""

import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from mapless import Client
from mapless.geometry import RigidTransform
from mapless_tools.child import child_server
from mapless_tools.demo.photographs import Outline, Place, room, split_folder
from mapless_tools.demo.run import judge, summarize, table_of, write_pictures
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.ingest.metres import umeyama

VIDEO = Path(__file__).with_name("walk.mp4")
TAG = "36h11:0=0.16"
FRAMES = 50
"""Enough for a room, in a third of the time of the default."""
SCENE = "demo-video"
MAX_SCALE_ERROR = 0.01
"""Largest error of lengths for the demo to succeed."""


def main(output: Path) -> bool:
    """Runs it and writes pictures; whether all photographs are localized, and metres are right to 1 %."""
    console = Console()
    folder = output / "reconstruction"
    command("reconstruct", VIDEO, folder, "--tag", TAG, "--frames", FRAMES)
    truth = room()
    with tempfile.TemporaryDirectory(prefix="mapless-demo-") as data_dir, child_server(Path(data_dir)) as server:
        command("import", folder, SCENE, "--address", server.address)
        with Client(server.address) as client:
            answers = [client.localize(it.data, it.camera, SCENE, include_debug=True) for it in truth.queries]
    rigid, scale = world_from_room(folder)
    place = moved(truth, rigid, split_folder(folder))
    outcomes = [judge(query, answer) for query, answer in zip(place.queries, answers, strict=True)]
    console.print(table_of(outcomes, metric=True))
    good = summarize(console, place, outcomes)
    console.print(f"lengths are {100 * (scale - 1):+.2f} % off, by one tag of 16 cm")
    paths = write_pictures(place, outcomes, output)
    console.print(f"pictures: {paths[0]}, {len(paths) - 1} beside it, and {folder / 'report.html'}")
    return good and abs(scale - 1) <= MAX_SCALE_ERROR


def command(*arguments: object) -> None:
    """Runs a command of mapless-server; CalledProcessError if it fails."""
    print("$ mapless-server", *arguments, flush=True)
    subprocess.run([sys.executable, "-m", "mapless_tools", *map(str, arguments)], check=True)


def world_from_room(folder: Path) -> tuple[RigidTransform, float]:
    """The motion from the rendered room to the reconstruction's world, and metres of that for one true metre.

    Nothing says where the reconstruction's origin is in the room: the motion is fitted to the frames' true positions,
    without the scale, which is the tag's.
    """
    truth = json.loads(VIDEO.with_suffix(".json").read_text("utf-8"))["world_from_camera"]
    frames = read_folder(folder).frames
    found = np.array([it.world_from_camera.translation for it in frames])
    # Frames are named by their numbers: walk_000012.
    true = np.array([truth[int(it.name.rpartition("_")[2])] for it in frames])[:, :, 3]
    fitted = umeyama(true, found)
    return RigidTransform(fitted.rotation, found.mean(axis=0) - fitted.rotation @ true.mean(axis=0)), fitted.scale


def moved(truth: Place, world_from_room: RigidTransform, video: Place) -> Place:
    """The room's queries and outline in the reconstruction's world, with the video's frames as references."""
    queries = [replace(it, world_from_camera=world_from_room.compose(it.world_from_camera)) for it in truth.queries]
    assert truth.outline is not None
    visible = {name: world_from_room.apply(edges) for name, edges in truth.outline.visible_edges.items()}
    outline = Outline(world_from_room.apply(truth.outline.edges), visible)
    references = [*video.references, *video.queries]
    return Place("a room rendered from nothing but code, by a video", references, queries, True, outline)


if __name__ == "__main__":
    sys.exit(0 if main(Path(sys.argv[1])) else 1)
