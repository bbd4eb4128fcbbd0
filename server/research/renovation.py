"""The demo's room renovated over ten steps: `python -m research.renovation FOLDER`.

Renders into FOLDER what it lacks (ten minutes of processor time), stores the survey, 40 references, in a server of its
own with the settings of the environment, and localizes 40 photographs at each step, which is renovated further each
time (`rendered_room/renovation.py`). Prints Markdown: how many are localized, how far off, how many radii hold, and how
many right matches with the survey are left: those whose point projects to its keypoint by the true pose. With `--adopt`
the scene adopts, and after each photograph the server has time to consider it.
"""

import argparse
import re
import socket
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.request import urlopen

import numpy as np

from mapless import AdoptionPolicy, Client, LocalizationResult, NewReference, Rejected
from mapless_tools.child import CONNECT, child_server
from mapless_tools.dataset import Frame
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.run import await_features
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.output_files import markdown_table

from .rendered_room.folders import entry_of, write_cameras, write_photograph
from .rendered_room.photographs import Station
from .rendered_room.renovation import STEPS, RenovatedRoom, Renovation, survey, visit

SCENE = "renovated"
PHOTOGRAPHS = 40
RIGHT_PX = 4.0
"""Farthest projection of the point of a right match, pixels of the photograph."""
CONSIDERING_S = 300.0
"""Longest time for considering a photograph; the machine may be busy."""
HEAD = (
    "step | pieces left | localized | median | largest | within 68 % | within 95 % | right matches | of the survey left"
)


@dataclass(frozen=True)
class StepResult:
    """Results of a step's photographs.

    Attributes:
        step, piece_share: number of the step, and the share of the pieces that are as they were surveyed.
        errors_m: of the localized ones.
        held_68, held_95: localized ones within the radii of their positions.
        count: all of them.
        surveyed_matches, matches: right matches a photograph, with surveyed references and with all.
    """

    step: int
    piece_share: float
    errors_m: tuple[float, ...]
    held_68: int
    held_95: int
    count: int
    surveyed_matches: float
    matches: float

    def row(self, first: "StepResult") -> list[str]:
        """A row of the table; the first step has no renovation."""
        found = len(self.errors_m)
        errors = [f"{100 * it:.2f} cm" for it in (np.median(self.errors_m), max(self.errors_m))] if found else ["", ""]
        held = [f"{it} of {found}" for it in (self.held_68, self.held_95)]
        left = f"{100 * self.surveyed_matches / first.surveyed_matches:.0f} %"
        shares = [f"{self.matches:.0f}", left]
        return [str(self.step), f"{100 * self.piece_share:.0f} %", f"{found} of {self.count}", *errors, *held, *shares]


def render(folder: Path, seed: int, count: int) -> list[float]:
    """Renders survey and steps where they are missing; returns the share of pieces that each step has left."""
    shares, renovation = [], Renovation(seed)
    for step in range(STEPS + 1):
        target, share = folder / f"step-{step:02d}", folder / f"step-{step:02d}" / "share"
        if not share.is_file():
            room = renovation.at(step)
            write(target, room, visit(seed, step, count, room))
            if step == 0:
                write(folder / "survey", room, survey(seed, room))
            share.write_text(str(1 - float(np.mean(room.exchanged))))
            print(f"step {step} rendered", file=sys.stderr, flush=True)
        shares.append(float(share.read_text()))
    return shares


def write(folder: Path, room: RenovatedRoom, stations: Sequence[Station]) -> None:
    """Writes photographs and their cameras."""
    for station in stations:
        write_photograph(folder / "images", room, station)
    write_cameras(folder, [entry_of(it) for it in stations])


@dataclass(frozen=True)
class MetricsPage:
    """The metrics of a server, at a port of this machine."""

    port: int

    @property
    def outcomes(self) -> dict[str, int]:
        """Photographs that were considered, by what became of them."""
        with urlopen(f"http://127.0.0.1:{self.port}/metrics", timeout=60) as page:
            found = re.findall(r'mapless_adoptions_total\{result="(\w+)"\} (\S+)', page.read().decode())
        return {result: round(float(count)) for result, count in found}

    @property
    def considered(self) -> int:
        """Photographs that were considered."""
        return sum(self.outcomes.values())

    def wait_for(self, count: int) -> None:
        """Returns when so many were considered; TimeoutError after `CONSIDERING_S`."""
        end_s = time.monotonic() + CONSIDERING_S
        while self.considered < count:
            if time.monotonic() > end_s:
                raise TimeoutError(f"the server has considered {self.considered} photographs, not {count}")
            time.sleep(0.1)


def right_matches(frame: Frame, answer: LocalizationResult | Rejected) -> tuple[int, int]:
    """Number of matches that the true pose confirms, with surveyed references, and with all."""
    if answer.debug is None:
        return 0, 0
    camera_from_world = frame.world_from_camera.inverse()
    projected = frame.camera.project(camera_from_world.apply(answer.debug.x_in_world))
    is_right = np.linalg.norm(projected - answer.debug.query_px, axis=1) <= RIGHT_PX
    assert answer.diagnostics is not None
    names = [it.name for it in answer.diagnostics.references]
    is_surveyed = np.array(["/references/reference-" in it for it in names])[answer.debug.reference]
    return int((is_right & is_surveyed).sum()), int(is_right.sum())


def measure(
    client: Client, step: int, piece_share: float, frames: Sequence[Frame], metrics: MetricsPage | None
) -> StepResult:
    """Localizes the photographs of a step; with a page of metrics, each is considered before the next one."""
    errors, held_68, held_95, matches = [], 0, 0, []
    for frame in frames:
        before = 0 if metrics is None else metrics.considered
        answer = client.localize(
            frame.image_path, frame.camera, SCENE, include_debug=True, allow_adoption=True, timeout_s=300
        )
        if metrics is not None and not isinstance(answer, Rejected):
            metrics.wait_for(before + 1)
        matches.append(right_matches(frame, answer))
        if isinstance(answer, Rejected) or answer.accuracy is None:
            continue
        errors.append(pose_error(frame.world_from_camera, answer.world_from_camera)[0])
        held_68 += errors[-1] <= answer.accuracy.position_68_m
        held_95 += errors[-1] <= answer.accuracy.position_95_m
    of_survey, of_all = np.mean(matches, axis=0).tolist()
    return StepResult(step, piece_share, tuple(errors), held_68, held_95, len(frames), of_survey, of_all)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0, help="of the room and its renovation")
    parser.add_argument("--photographs", type=int, default=PHOTOGRAPHS, help="of each step, the same ones first")
    parser.add_argument("--adopt", action="store_true", help="the scene adopts what is localized")
    arguments = parser.parse_args()
    shares = render(arguments.folder, arguments.seed, arguments.photographs)
    results: list[StepResult] = []
    metrics = MetricsPage(free_port()) if arguments.adopt else None
    flags = {} if metrics is None else {"--metrics-port": str(metrics.port)}
    with (
        tempfile.TemporaryDirectory(prefix="mapless-") as data_dir,
        child_server(Path(data_dir), flags) as server,
        Client(server.address, CONNECT) as client,
    ):
        client.create_scene(SCENE, adoption=AdoptionPolicy() if arguments.adopt else None)
        references = read_folder(arguments.folder / "survey").frames
        client.add_references(
            SCENE, [NewReference(it.name, it.image_path, it.camera, it.world_from_camera) for it in references]
        )
        await_features(client, SCENE)
        for step, share in enumerate(shares):
            frames = read_folder(arguments.folder / f"step-{step:02d}").frames[: arguments.photographs]
            results.append(measure(client, step, share, frames, metrics))
            print(results[-1].row(results[0]), file=sys.stderr, flush=True)
            if metrics is not None:
                kept = {it.reference_id: it for it in client.list_references(SCENE, only_adopted=True)}
                retired = sum(it.retire_time is not None for it in kept.values())
                print(f"{len(kept)} adopted, {retired} retired, {metrics.outcomes}", file=sys.stderr, flush=True)
                print("\n".join(client.get_scene(SCENE).warnings), file=sys.stderr, flush=True)
    print("\n".join(markdown_table(HEAD, [it.row(results[0]) for it in results])))


def free_port() -> int:
    """A port that no program listens on."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


if __name__ == "__main__":
    main()
