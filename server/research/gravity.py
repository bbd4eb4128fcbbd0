"""What a gravity prior improves, measured: `python -m research.gravity FOLDER_OF_SCENES` prints Markdown.

Every query is localized without and with a gravity prior, made of its known pose: right but for a degree of noise; with
three degrees of noise that claim to be one; and upside down. On references that surround the query, of which nothing is
lost, and on references so few or so far away that many are.
"""

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.answer import Localization
from mapless_server.method.priors.known import NO_PRIORS, GravityPrior, Priors

from .places import KITCHEN, RIGHT_DEG, Measured, Pair, Place, answered, read_places, right_pairs


@dataclass(frozen=True)
class Setting:
    """Which references of a scene a query is given: at most so many, those with the most matches.

    So many `stored` frames are references, evenly spread, and queries are taken between them; None leaves one out,
    without frames within so many of the query. In a scene that is not metric, 10 cm mean nothing.
    """

    folder: str
    given: int
    stored: int | None = None
    frames_apart: int = 0
    metric: bool = True

    def __str__(self) -> str:
        stored = "" if self.stored is None else f", {self.stored} references in all"
        apart = f", none within {self.frames_apart} frames" if self.frames_apart else ""
        return f"{self.folder}, {self.given} given{stored}{apart}"


ALL = ("fountain-P11", "herz-jesus-P8", "tum-fr3-office", "kitti-drive-a")
SETTINGS = (
    *(Setting(folder, given) for folder in ALL for given in (10, 5, 3)),
    *(Setting(KITCHEN, given, 30) for given in (10, 5, 3)),
    *(Setting(folder, 5, metric=False) for folder in ("fox-portrait", "reichstag-internet")),
    *(Setting(folder, 5, 5) for folder in (*ALL, KITCHEN)),
    Setting(KITCHEN, 5, 8),
    Setting("fountain-P11", 5, frames_apart=4),
    Setting("herz-jesus-P8", 5, frames_apart=3),
    Setting("tum-fr3-office", 5, frames_apart=2),
    Setting("tum-fr3-office", 5, frames_apart=3),
    Setting("kitti-drive-a", 5, frames_apart=4),
)

Sensor = Callable[[int, RigidTransform, Array], Priors]
"""What is known of query i, from its pose and the scene's down."""


def sensor(noise_deg: float, claimed_deg: float, sign: float = 1.0) -> Sensor:
    """An accelerometer with this noise about each of two axes, and the deviation that it claims."""

    def measure(query: int, world_from_camera: RigidTransform, down_in_world: Array) -> Priors:
        right = world_from_camera.rotation.T @ down_in_world
        noise = np.random.default_rng(query).normal(0, math.radians(noise_deg), 3)
        down = sign * rotation_from_vector(noise - right * (right @ noise)) @ right
        return Priors(gravity=GravityPrior(down / np.linalg.norm(down), down_in_world, claimed_deg))

    return measure


SENSORS: dict[str, Sensor] = {
    "none": lambda *_: NO_PRIORS,
    "1°": sensor(1.0, 1.0),
    "3° claimed as 1°": sensor(3.0, 1.0),
    "upside down": sensor(1.0, 1.0, -1.0),
}


def sensed(pairs: Sequence[Pair], place: Place, measure: Sensor) -> Iterator[Pair]:
    """The pairs with what a sensor says; down is what most photographs of the place call down."""
    down = np.mean([pose.rotation[:, 1] for pose in place.poses.values()], axis=0)
    down = down / np.linalg.norm(down)
    for i, pair in enumerate(pairs):
        assert pair.true_pose is not None
        yield replace(pair, priors=measure(i, pair.true_pose, down))


def is_right(it: Measured, metric: bool = True) -> bool:
    """Whether a pose was answered that is right; without metres any answer in the right direction is."""
    if not isinstance(it.answer.outcome, Localization) or it.off is None:
        return False
    return it.right if metric else it.off[1] < RIGHT_DEG


def error_of(it: Measured) -> tuple[float, float]:
    """Metres and degrees; infinite for a rejection."""
    return it.off if isinstance(it.answer.outcome, Localization) and it.off else (math.inf, math.inf)


def rows(setting: Setting, place: Place) -> Iterator[str]:
    """Lines of the table."""
    pairs = list(right_pairs(place, setting.stored, (setting.given,), setting.frames_apart))
    outcomes = {name: list(answered(sensed(pairs, place, measure))) for name, measure in SENSORS.items()}
    failed = {i for i, it in enumerate(outcomes["none"]) if not is_right(it, setting.metric)}
    for name, results in outcomes.items():
        median_m, median_deg = np.median([error_of(it) for it in results], axis=0)
        lost = {i for i, it in enumerate(results) if not is_right(it, setting.metric)}
        length = f"{100 * median_m:.3f} cm" if setting.metric else f"{median_m:.5f}"
        answers = [it.answer.outcome for it in results if isinstance(it.answer.outcome, Localization)]
        wrong = sum(isinstance(results[i].answer.outcome, Localization) for i in lost)
        conflicts = sum(any(check.conflict for check in it.prior_checks) for it in answers)
        used = sum(any(check.used for check in it.prior_checks) for it in answers)
        counts = [len(lost), wrong, len(failed - lost), len(lost - failed), conflicts, used]
        cells = [str(setting), name, str(len(pairs)), f"{length} / {median_deg:.4f}°", *map(str, counts)]
        yield "| " + " | ".join(cells) + " |"


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes' folders")
    parser.add_argument("--only", default="", help="settings whose name contains this")
    arguments = parser.parse_args()
    head = "references | gravity | queries | median | failed | of these answered | rescued | harmed | conflicts | used"
    print(f"| {head} |\n{10 * '|---'}|")
    places: dict[str, Place] = {}
    for setting in SETTINGS:
        if arguments.only in str(setting):
            if setting.folder not in places:
                places |= read_places(arguments.data, [setting.folder])
            for row in rows(setting, places[setting.folder]):
                print(row, flush=True)


if __name__ == "__main__":
    main()
