"""The demo's room renovated over ten steps: `python -m research.renovation FOLDER`.

Renders into FOLDER what it lacks (15 minutes of processor time), stores the survey, 40 references, in a server of its
own with the settings of the environment, and localizes 40 photographs at each step, which is renovated further each
time (`rendered_room/renovation.py`). A step is a week. After the ten steps the surfaces of the building are exchanged
too, and then the room is surveyed again. All of it twice: without adoption, and with a scene that adopts, where each
photograph is considered before the next one. Prints Markdown, or writes it to `docs/results/renovation.md`.

What is left of the survey where a photograph was taken is known from the room's geometry: the share of the surveyed
points in its view whose surface was neither exchanged nor hidden.
"""

import argparse
import hashlib
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from mapless import AdoptionPolicy, Client, LocalizationResult, NewReference, Rejected
from mapless_tools.child import CONNECT
from mapless_tools.dataset import Frame
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.run import await_features
from mapless_tools.ingest.formats.cameras import read_folder

from .adopting_server import Calendar, MetricsPage, adopting_server
from .evidence.page import measured_commit
from .rendered_room.folders import entry_of, write_cameras, write_photograph
from .rendered_room.photographs import Station
from .rendered_room.renovation import STEPS, RenovatedRoom, Renovation, survey, visit
from .rendered_room.survey_left import SurveyedPoints
from .renovation_tables import Seen, StepResult, report, with_section

SCENE = "renovated"
PHOTOGRAPHS = 40
PAGE = Path(__file__).parents[2] / "docs" / "results" / "renovation.md"
RIGHT_PX = 4.0
"""Farthest projection of the point of a right match, by the true pose, pixels of the photograph."""
BUILDING, LAST_WEEK, SURVEYED_AGAIN = STEPS + 1, STEPS + 4, STEPS + 5
"""The steps after the ten: the building's surfaces are exchanged, the same room for three weeks more, and after a new
survey, when the photographs of the first of these weeks are asked for again."""
DAYS = 7.0
"""Length of a step."""


def render(folder: Path, seed: int, count: int) -> None:
    """Renders surveys and steps where they are missing."""
    renovation = Renovation(seed)
    for step in range(LAST_WEEK + 1):
        target = folder / f"step-{step:02d}"
        if (target / "share").is_file():
            continue
        room = renovation.at(min(step, BUILDING))
        write(target, room, visit(seed, step, count, room))
        if step in (0, BUILDING):
            write(folder / ("survey" if step == 0 else "survey-again"), room, survey(seed, room))
        (target / "share").write_text(str(1 - float(np.mean(room.exchanged))))
        print(f"step {step} rendered", file=sys.stderr, flush=True)


def write(folder: Path, room: RenovatedRoom, stations: Sequence[Station]) -> None:
    """Writes photographs and their cameras."""
    for station in stations:
        write_photograph(folder / "images", room, station)
    write_cameras(folder, [entry_of(it) for it in stations])


def frames_of(folder: Path, step: int, count: int) -> list[Frame]:
    """The first photographs of a step."""
    return list(read_folder(folder / f"step-{step:02d}").frames[:count])


class Run:
    """A scene in which the photographs are localized step after step."""

    def __init__(self, folder: Path, seed: int, count: int) -> None:
        """Prepares the photographs in a folder, so many of each step."""
        self._folder = folder
        self._frames = [frames_of(folder, step, count) for step in range(LAST_WEEK + 1)]
        self._frames.append(self._frames[BUILDING])
        self._surveyed = SurveyedPoints(seed, read_folder(folder / "survey").frames)

    def steps(self, client: Client, metrics: MetricsPage, calendar: Calendar, adopts: bool) -> list[StepResult]:
        """Results of all steps, of a new scene."""
        client.create_scene(SCENE, adoption=AdoptionPolicy() if adopts else None)
        self._add(client, "survey", "")
        results = []
        for step in range(len(self._frames)):
            if step == SURVEYED_AGAIN:
                self._add(client, "survey-again", "again-")
            page = metrics if adopts else None
            seen = [self._seen(client, page, calendar, step, i) for i in range(len(self._frames[step]))]
            results.append(self._result(client, metrics, step, seen))
        return results

    def _add(self, client: Client, survey: str, prefix: str) -> None:
        frames = read_folder(self._folder / survey).frames
        client.add_references(
            SCENE, [NewReference(prefix + it.name, it.image_path, it.camera, it.world_from_camera) for it in frames]
        )
        await_features(client, SCENE)

    def _seen(self, client: Client, metrics: MetricsPage | None, calendar: Calendar, step: int, index: int) -> Seen:
        """Localizes a photograph; with metrics, returns when it has been considered."""
        frame = self._frames[step][index]
        calendar.day = DAYS * (step + index / len(self._frames[step]))
        before = 0 if metrics is None else metrics.considered
        answer = client.localize(
            frame.image_path, frame.camera, SCENE, include_debug=True, allow_adoption=True, timeout_s=300
        )
        if metrics is not None and not isinstance(answer, Rejected):
            metrics.wait_for(before + 1)
        left = 1.0 if step == SURVEYED_AGAIN else self._surveyed.left(min(step, BUILDING), frame)
        return seen_of(frame, answer, left)

    def _result(self, client: Client, metrics: MetricsPage, step: int, seen: Sequence[Seen]) -> StepResult:
        truth = {image_hash(it): it.world_from_camera for frames in self._frames[: step + 1] for it in frames}
        errors, held = [], 0
        for kept in client.list_references(SCENE, only_adopted=True):
            if kept.retire_time is None and kept.provenance.accuracy is not None:
                errors.append(pose_error(truth[kept.image_sha256], kept.world_from_camera)[0])
                held += errors[-1] <= kept.provenance.accuracy.position_95_m
        result = StepResult(
            step,
            float((self._folder / f"step-{min(step, LAST_WEEK):02d}" / "share").read_text()),
            tuple(seen),
            tuple(errors),
            held,
            metrics.counts("mapless_retirements_total", "reason"),
            metrics.outcomes,
            tuple(client.get_scene(SCENE).warnings),
        )
        print(json.dumps(asdict(result)), file=sys.stderr, flush=True)
        return result


def image_hash(frame: Frame) -> str:
    """SHA-256 of a photograph's file, hexadecimal."""
    return hashlib.sha256(Path(frame.image_path).read_bytes()).hexdigest()


def seen_of(frame: Frame, answer: LocalizationResult | Rejected, survey_left: float) -> Seen:
    """How a photograph was answered."""
    surveyed, right = right_matches(frame, answer)
    if isinstance(answer, Rejected):
        said, place = f"{answer.reason}: {answer.message}", answer.outdated_place.rpartition("/")[2]
        return Seen(frame.name, survey_left, surveyed, right, rejection=said, outdated_place=place)
    error_m = pose_error(frame.world_from_camera, answer.world_from_camera)[0]
    accuracy = answer.accuracy
    radii = (0.0, 0.0) if accuracy is None else (accuracy.position_68_m, accuracy.position_95_m)
    return Seen(frame.name, survey_left, surveyed, right, error_m, *radii)


def right_matches(frame: Frame, answer: LocalizationResult | Rejected) -> tuple[int, int]:
    """Number of matches that the true pose confirms, with surveyed references, and with all."""
    if answer.debug is None:
        return 0, 0
    camera_from_world = frame.world_from_camera.inverse()
    projected = frame.camera.project(camera_from_world.apply(answer.debug.x_in_world))
    is_right = np.linalg.norm(projected - answer.debug.query_px, axis=1) <= RIGHT_PX
    names = [it.name for it in answer.diagnostics.references]
    is_surveyed = np.array(["/references/adopted-" not in it for it in names])[answer.debug.reference]
    return int((is_right & is_surveyed).sum()), int(is_right.sum())


def measure(folder: Path, seed: int, count: int, adopts: bool) -> list[StepResult]:
    """Results of all steps, with a server of its own."""
    calendar, run = Calendar(), Run(folder, seed, count)
    with (
        tempfile.TemporaryDirectory(prefix="mapless-") as data_dir,
        adopting_server(Path(data_dir), calendar) as server,
        Client(server.address, CONNECT) as client,
    ):
        return run.steps(client, MetricsPage(int(server.metrics_address.rpartition(":")[2])), calendar, adopts)


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0, help="of the room and its renovation")
    parser.add_argument("--photographs", type=int, default=PHOTOGRAPHS, help="of each step, the same ones first")
    parser.add_argument("--page", action="store_true", help=f"write the tables to {PAGE.name} instead")
    parser.add_argument("--only", choices=("without", "with"), help="measure without adoption alone, or with it")
    arguments = parser.parse_args()
    folder, seed, count = arguments.folder, arguments.seed, arguments.photographs
    render(folder, seed, count)
    runs = [it for it in (False, True) if arguments.only in (None, "with" if it else "without")]
    reports = [report(measure(folder, seed, count, adopts), adopts=adopts) for adopts in runs]
    if arguments.page:
        PAGE.write_text(with_section(PAGE.read_text(), seed, measured_commit(), reports))
    else:
        print("\n\n".join(reports))


if __name__ == "__main__":
    main()
