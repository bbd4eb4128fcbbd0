"""What gravity is worth, measured: `python -m mapless_tools.bench.priors FOLDER_OF_SCENES` prints Markdown.

Every query is localized without and with a gravity prior, made of its known pose: right but for a degree of noise; with
three degrees of noise that claim to be one; and upside down. On references that surround the query, of which nothing is
lost, and on references so few or so far away that many are.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.images.decode import ImageLimits, decode_image
from mapless_server.method.answer import Localization, LocalizeOptions
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.correspond import OPTIONS, make_matcher
from mapless_server.method.features import make_extractor
from mapless_server.method.localize import localize
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.priors.known import NO_PRIORS, GravityPrior, Priors
from mapless_server.method.retrieve import choose_references
from mapless_server.method.views import PosedView, View
from mapless_tools.dataset import Dataset, read_folder
from mapless_tools.evaluate.metrics import pose_error

from .scenes import KITCHEN

RIGHT_M, RIGHT_DEG = 0.1, 5.0
"""A query that is rejected, or further off than this, has failed."""

KITCHEN_STEP = 4
"""Of the kitchen's 600 frames every so manieth is looked at."""


@dataclass(frozen=True)
class Setting:
    """Which references a query is given.

    Attributes:
        folder: of the scene.
        given: at most so many, those with the most matches.
        stored: so many of the frames are references, evenly spread, and queries are taken between them; None leaves
            one out.
        gap: frames so near in the sequence are no references.
        metric: whether 10 cm mean anything.
    """

    folder: str
    given: int
    stored: int | None = None
    gap: int = 0
    metric: bool = True

    def __str__(self) -> str:
        stored = "" if self.stored is None else f", {self.stored} references in all"
        gap = f", none within {self.gap} frames" if self.gap else ""
        return f"{self.folder}, {self.given} given{stored}{gap}"


ALL = ("fountain-P11", "herz-jesus-P8", "tum-fr3-office", "kitti-drive-a")
SETTINGS = (
    *(Setting(folder, given) for folder in ALL for given in (10, 5, 3)),
    *(Setting(KITCHEN, given, 30) for given in (10, 5, 3)),
    *(Setting(folder, 5, metric=False) for folder in ("fox-portrait", "reichstag-internet")),
    *(Setting(folder, 5, 5) for folder in (*ALL, KITCHEN)),
    Setting(KITCHEN, 5, 8),
    Setting("fountain-P11", 5, gap=4),
    Setting("herz-jesus-P8", 5, gap=3),
    Setting("tum-fr3-office", 5, gap=2),
    Setting("tum-fr3-office", 5, gap=3),
    Setting("kitti-drive-a", 5, gap=4),
)

Sensor = Callable[[int, RigidTransform, Array], Priors]
"""What is known of query i, from its pose and the scene's down."""


def sensor(noise_deg: float, claimed_deg: float, sign: float = 1.0) -> Sensor:
    """An accelerometer that is off by so much about each of two axes, and what it says of that."""

    def measure(query: int, world_from_camera: RigidTransform, down_in_world: Array) -> Priors:
        right = world_from_camera.rotation.T @ down_in_world
        noise = np.random.default_rng(query).normal(0, math.radians(noise_deg), 3)
        down = sign * rotation_from_vector(noise - right * (right @ noise)) @ right
        return Priors(gravity=GravityPrior(down / np.linalg.norm(down), down_in_world, claimed_deg))

    return measure


SENSORS: dict[str, Sensor] = {
    "none": lambda *_: NO_PRIORS,
    "1°": sensor(1.0, 1.0),
    "3° told as 1°": sensor(3.0, 1.0),
    "upside down": sensor(1.0, 1.0, -1.0),
}


@dataclass(frozen=True, eq=False)
class Outcome:
    """One query's answer; infinite errors for a rejection."""

    error_m: float
    error_deg: float
    conflict: bool
    used: bool

    def is_right(self, metric: bool) -> bool:
        """Whether it has not failed; without metres any answer in the right direction is right."""
        return self.error_deg < RIGHT_DEG and (self.error_m < RIGHT_M or not metric)


class Place:
    """The photographs of one scene, described."""

    def __init__(self, dataset: Dataset) -> None:
        self.frames = dataset.frames[:: KITCHEN_STEP if dataset.name == KITCHEN else 1]
        extractor, limits = make_extractor("sift"), ImageLimits()
        self.views: list[View] = [
            extractor.extract(decode_image(f.image_path.read_bytes(), limits), f.camera) for f in self.frames
        ]
        self.poses = [frame.world_from_camera for frame in self.frames]
        down = np.mean([pose.rotation[:, 1] for pose in self.poses], axis=0)
        self.down: Array = down / np.linalg.norm(down)
        self.pipeline = Pipeline(make_reconstructor("geometric", Path()), make_matcher("sift", 2))

    def posed(self, indices: Sequence[int]) -> list[PosedView]:
        """As the method wants them."""
        return [PosedView(str(i), f"scenes/a/references/{i}", self.views[i], self.poses[i]) for i in indices]

    def queries(self, setting: Setting, most: int) -> Iterator[tuple[int, list[int]]]:
        """Queries and the references that each is given."""
        references = queries = list(range(len(self.views)))
        if setting.stored is not None:
            references = spread(references, setting.stored)
            queries = spread([i for i in queries[1:-1] if i not in references], most)
        for query in queries:
            others = [i for i in references if i != query and abs(i - query) > setting.gap]
            if len(others) >= 2:
                ratio = OPTIONS["sift"].query_ratio
                chosen = choose_references(self.views[query], self.posed(others), setting.given, ratio=ratio)
                yield query, [others[i] for i in chosen]

    def answer(self, query: int, references: Sequence[int], priors: Priors) -> Outcome:
        """Localizes one query."""
        found = localize(
            self.views[query], self.posed(references), self.pipeline, LocalizeOptions(), priors=priors
        ).outcome
        if not isinstance(found, Localization):
            return Outcome(math.inf, math.inf, conflict=False, used=False)
        error_m, error_deg = pose_error(self.poses[query], found.world_from_camera)
        checks = found.prior_checks
        return Outcome(error_m, error_deg, any(c.conflict for c in checks), any(c.used for c in checks))


def spread(indices: Sequence[int], count: int) -> list[int]:
    """At most so many of them, evenly spread, the first and the last included."""
    rows = np.unique(np.linspace(0, len(indices) - 1, min(count, len(indices))).round().astype(int))
    return [indices[row] for row in rows]


def rows(setting: Setting, place: Place, most: int) -> Iterator[str]:
    """Lines of the table."""
    cases = list(place.queries(setting, most))
    outcomes = {
        name: [place.answer(query, given, measure(query, place.poses[query], place.down)) for query, given in cases]
        for name, measure in SENSORS.items()
    }
    failed = [i for i, it in enumerate(outcomes["none"]) if not it.is_right(setting.metric)]
    for name, results in outcomes.items():
        median_m, median_deg = np.median([(it.error_m, it.error_deg) for it in results], axis=0)
        lost = [i for i, it in enumerate(results) if not it.is_right(setting.metric)]
        rescued, harmed = len(set(failed) - set(lost)), len(set(lost) - set(failed))
        length = f"{100 * median_m:.3f} cm" if setting.metric else f"{median_m:.5f}"
        wrong = sum(math.isfinite(results[i].error_m) for i in lost)
        counts = [len(lost), wrong, rescued, harmed, sum(it.conflict for it in results), sum(it.used for it in results)]
        cells = [str(setting), name, str(len(cases)), f"{length} / {median_deg:.4f}°", *map(str, counts)]
        yield "| " + " | ".join(cells) + " |"


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes' folders")
    parser.add_argument("--queries", type=int, default=40, help="of a setting with stored references, at most")
    parser.add_argument("--only", help="settings whose name contains this")
    arguments = parser.parse_args()
    print(
        "| references | gravity | queries | median | failed | of these answered | rescued | harmed | conflicts | used |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    places: dict[str, Place] = {}
    for setting in SETTINGS:
        folder = arguments.data / setting.folder
        if (arguments.only or "") not in str(setting) or not (folder / "cameras.json").is_file():
            continue
        if setting.folder not in places:
            places = {setting.folder: Place(read_folder(folder))}
        for row in rows(setting, places[setting.folder], arguments.queries):
            print(row, flush=True)


if __name__ == "__main__":
    main()
