"""Jumps of the tracking, planted in walks of real photographs: `python -m research.walks FOLDER_OF_SCENES`.

A walk is 2 to 16 photographs that follow one another in their scene, forwards or backwards; its session is that of a
device whose tracking drifts by 1 % of the distance, in a quarter of the walks in an unknown unit. At one step it
jumps: by 5 cm to 100 m, in three of five cases with a rotation of up to 180 degrees, in one of ten by a rotation alone.
Prints, for each scene, walks with and without a jump: how many are answered, errors of the newest pose, the share
within its radii, the jumps that are found, and the cuts where there is none.
"""

import argparse
import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.answer import Answer
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.correspond import make_matcher
from mapless_server.method.groups.checks import check_unit
from mapless_server.method.groups.drift import DriftOptions
from mapless_server.method.groups.images import GroupImage, tracked_support
from mapless_server.method.groups.sequence import SequenceEstimate, solve_sequence
from mapless_server.method.groups.start import SequenceOptions
from mapless_server.method.localize import prepare, refine
from mapless_server.method.options import LocalizeOptions, StageContext, Variant
from mapless_server.method.pipeline import Pipeline, reconstruct
from mapless_server.method.rejection import Rejection
from mapless_server.method.uncertainty.radii import accuracy_from_covariance
from mapless_server.method.views import PosedView, View
from mapless_tools.evaluate.metrics import pose_error

from .places import KITCHEN, Place, read_place, spread

DRIFT = 0.5
"""Of the tracking, as a share of the standard deviations of `DriftOptions`: 1 % of the distance."""
REPORTED_M = 0.3
"""Jumps of so much and more have to be reported."""


@dataclass(frozen=True)
class Setting:
    """A scene and the photographs of it that are walked along, in stretches of a length.

    So many frames, evenly spread, are references; None: all others are, of each photograph. The first frames of
    stretches are between the references; without them all frames are one stretch. Unless frames follow one another, a
    walk goes to the nearest one left.
    """

    title: str
    folder: str
    reference_count: int | None = None
    stretches: tuple[int, ...] = (0,)
    length: int = 1000
    is_ordered: bool = True


SETTINGS = (
    Setting("kitchen, 30 references", KITCHEN, 30, (0, 25, 50, 75, 100), 16),
    Setting("kitchen, 5 references", KITCHEN, 5, (5, 45, 85, 120), 14),
    Setting("euroc", "euroc-v101-drone", None, (0,), 32),
    Setting("drive", "kitti-drive-a"),
    Setting("office", "tum-fr3-office"),
    Setting("lockers", "office-lockers", is_ordered=False),
)


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph with its true pose and what it gives by itself."""

    world_from_camera: RigidTransform
    image: GroupImage


@dataclass(frozen=True, eq=False)
class Walk:
    """A walk and its session as tracked, perhaps in a unit that is not known.

    The tracking jumps before the photograph `at`, by `jump_m` and `jump_deg`; 0 without a jump.
    """

    photographs: tuple[Photograph, ...]
    session_from_camera: tuple[RigidTransform, ...]
    unit_is_free: bool
    at: int = 0
    jump_m: float = 0.0
    jump_deg: float = 0.0


@dataclass(frozen=True, eq=False)
class Outcome:
    """The answer to a walk; errors and radii of the newest pose, metres and degrees."""

    walk: Walk
    found: SequenceEstimate | Rejection
    seconds: float

    @property
    def error(self) -> tuple[float, float]:
        """Of the newest pose; infinite for a rejection."""
        if isinstance(self.found, Rejection):
            return np.inf, np.inf
        return pose_error(self.walk.photographs[-1].world_from_camera, self.found.world_from_camera[-1])

    @property
    def radii(self) -> tuple[float, float, float, float]:
        """Radii of 68 and 95 % of the position, and of the rotation."""
        assert isinstance(self.found, SequenceEstimate)
        it = accuracy_from_covariance(self.found.covariances[-1])
        return it.position_68_m, it.position_95_m, it.rotation_68_deg, it.rotation_95_deg

    @property
    def reported(self) -> int:
        """Jumps that are reported where it is."""
        return sum(jump.before < self.walk.at <= jump.after for jump in getattr(self.found, "jumps", ()))

    @property
    def false_cuts(self) -> int:
        """Jumps that are reported elsewhere."""
        return len(getattr(self.found, "jumps", ())) - self.reported


def photographs_of(setting: Setting, place: Place, features: str = "sift") -> list[Photograph]:
    """The photographs to walk along, each localized alone as the server does it, stretch after stretch."""
    indices = sorted(place.views)
    stored = spread(indices, setting.reference_count) if setting.reference_count else []
    between = [i for i in indices if i not in stored]
    walked = [i for start in setting.stretches for i in between[start : start + setting.length]]
    pipeline = Pipeline(make_reconstructor("geometric", Path()), make_matcher(features, 2))
    match = pipeline.options.match(Variant.BEST, pipeline.matcher.options.guided_similarity)
    found = []
    try:
        for i in walked:
            others = stored or [j for j in indices if j != i]
            references = place.posed(place.most_matching(place.views[i], others, 10, features))
            found.append(Photograph(place.poses[i], GroupImage(_alone(place.views[i], references, pipeline), match)))
    finally:
        pipeline.matcher.close()
    return found


def _alone(query: View, references: Sequence[PosedView], pipeline: Pipeline) -> Answer:
    prepared = prepare(query, references, pipeline, LocalizeOptions(), StageContext())
    if isinstance(prepared, Answer):
        return prepared
    (coarse,) = reconstruct([prepared])
    if isinstance(coarse, Exception):
        raise coarse
    answer = coarse if isinstance(coarse, Answer) else refine(coarse)
    return answer if answer.support is not None else replace(answer, support=tracked_support(prepared))


def walk_of(setting: Setting, photographs: Sequence[Photograph], seed: int, jumps: bool) -> Walk:
    """A random walk; the same seed gives the same walk with and without its jump."""
    random = np.random.default_rng(seed)
    chosen = [photographs[i] for i in _path(setting, photographs, random)]
    session = _tracked([it.world_from_camera for it in chosen], random)
    jump_m, jump_deg = 10 ** random.uniform(np.log10(0.05), 2), 10 ** random.uniform(np.log10(0.5), np.log10(180))
    kind, at = random.random(), int(random.integers(1, len(chosen)))
    if kind < 0.1:
        jump_m, jump_deg = 0.0, max(2.0, jump_deg)
    elif kind < 0.5:
        jump_deg = 0.0
    shift, axis = _direction(random), _direction(random)
    unit_is_free, unit = bool(random.random() < 0.25), 10 ** random.uniform(-1, 1)
    if jumps:
        centre, turn = session[at].translation, rotation_from_vector(np.radians(jump_deg) * axis)
        session[at:] = [
            RigidTransform(turn @ it.rotation, turn @ (it.translation - centre) + centre + jump_m * shift)
            for it in session[at:]
        ]
    if unit_is_free:
        session = [RigidTransform(it.rotation, it.translation / unit) for it in session]
    about = (at, jump_m, jump_deg) if jumps else ()
    return Walk(tuple(chosen), tuple(session), unit_is_free, *about)


def _path(setting: Setting, photographs: Sequence[Photograph], random: np.random.Generator) -> list[int]:
    count = int(random.integers(2, 17))
    if not setting.is_ordered:
        centres = np.array([it.world_from_camera.translation for it in photographs])
        path = [int(random.integers(len(centres)))]
        while len(path) < count:
            away_m = np.linalg.norm(centres - centres[path[-1]], axis=1)
            away_m[path] = np.inf
            path.append(int(np.argmin(away_m)))
        return path
    length = min(setting.length, len(photographs))
    count = min(count, length)
    first = length * int(random.integers(len(setting.stretches)))
    step = int(random.integers(1, min(3, (length - 1) // (count - 1)) + 1))
    first += int(random.integers(0, length - step * (count - 1)))
    path = [first + step * k for k in range(count)]
    return path if random.random() < 0.5 else path[::-1]


def _tracked(truth: Sequence[RigidTransform], random: np.random.Generator) -> list[RigidTransform]:
    """`session_from_camera` of a device whose steps have independent errors."""
    session = [RigidTransform(rotation_from_vector(random.normal(0, 1, 3)), random.normal(0, 2, 3))]
    for first, second in itertools.pairwise(truth):
        step = first.inverse().compose(second)
        error = random.normal(0, DRIFT * DriftOptions().sigma(step))
        turned = rotation_from_vector(error[3:]) @ step.rotation
        session.append(session[-1].compose(RigidTransform(turned, step.translation + error[:3])))
    return session


def _direction(random: np.random.Generator) -> Array:
    vector = random.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def answered(walk: Walk) -> Outcome:
    """The walk's answer, as the server computes it."""
    start_s = time.process_time()
    session, images = walk.session_from_camera, [it.image for it in walk.photographs]
    found = solve_sequence(images, session, walk.unit_is_free, SequenceOptions())
    if isinstance(found, SequenceEstimate) and not walk.unit_is_free:
        found = check_unit(found, session)
    return Outcome(walk, found, time.process_time() - start_s)


COLUMNS = (
    "scene", "walks", "answered", "error, cm / deg", "68 % radius holds, position / angle", "95 % radius holds",
    "jumps reported", "of those from 0.3 m, metres", "unknown unit", "false cuts", "CPU, s",
)  # fmt: skip


def row_of(title: str, outcomes: Sequence[Outcome]) -> list[str]:
    """A row of the table."""
    given = [it for it in outcomes if isinstance(it.found, SequenceEstimate)]
    errors, radii = np.array([it.error for it in given]), np.array([it.radii for it in given])
    hold = 100 * np.mean(errors[:, [0, 0, 1, 1]] <= radii, axis=0)
    planted = [it for it in outcomes if it.walk.at]
    large = [it for it in planted if it.walk.jump_m >= REPORTED_M]

    def reported(some: Sequence[Outcome]) -> str:
        return f"{sum(it.reported > 0 for it in some)} of {len(some)}"

    return [
        title,
        str(len(outcomes)),
        str(len(given)),
        f"{100 * np.median(errors[:, 0]):.2f} / {np.median(errors[:, 1]):.3f}",
        f"{hold[0]:.0f} / {hold[2]:.0f}",
        f"{hold[1]:.0f} / {hold[3]:.0f}",
        reported(planted),
        reported([it for it in large if not it.walk.unit_is_free]),
        reported([it for it in large if it.walk.unit_is_free]),
        str(sum(it.false_cuts > 0 for it in outcomes)),
        f"{np.median([it.seconds for it in outcomes]):.2f}",
    ]


def describe(outcome: Outcome) -> str:
    """One line about an outcome that is not as it should be; empty if it is."""
    walk, found = outcome.walk, outcome.found
    title = f"{len(walk.photographs)} photographs, jump at {walk.at} by {walk.jump_m:.2f} m, {walk.jump_deg:.1f} deg"
    if isinstance(found, Rejection):
        return f"{title}: rejected, {found.message}"
    radii = outcome.radii
    if outcome.error[0] > radii[1] or outcome.error[1] > radii[3]:
        return f"{title}: off by {outcome.error[0]:.3f} m, {outcome.error[1]:.2f} deg; {radii[1]:.3f}, {radii[3]:.2f}"
    if outcome.false_cuts or (walk.jump_m >= REPORTED_M and not outcome.reported):
        return f"{title}: reported {'; '.join(map(str, found.jumps)) or 'nothing'}"
    return ""


def main() -> None:
    """Prints two tables, and what is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, help="folder with the scenes' folders")
    parser.add_argument("--walks", type=int, default=504, help="with a jump each, and as many without (default 504)")
    arguments = parser.parse_args()
    along = {it: photographs_of(it, read_place(arguments.scenes / it.folder)) for it in SETTINGS}
    measure(along, arguments.walks)


def measure(along: dict[Setting, list[Photograph]], count: int) -> None:
    """Walks with a jump, then without, in turn along each scene's photographs."""
    settings = list(along)
    for jumps in (True, False):
        outcomes: dict[Setting, list[Outcome]] = {it: [] for it in settings}
        for seed in range(count):
            setting = settings[seed % len(settings)]
            outcome = answered(walk_of(setting, along[setting], seed, jumps))
            outcomes[setting].append(outcome)
            if line := describe(outcome):
                print(f"{setting.title} {seed}: {line}", flush=True)
        rows = [row_of(it.title, outcomes[it]) for it in settings]
        rows.append(row_of("all", [it for some in outcomes.values() for it in some]))
        print(f"\n{'With' if jumps else 'Without'} a jump\n\n| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
        print("\n".join(f"| {' | '.join(row)} |" for row in rows), flush=True)


if __name__ == "__main__":
    main()
