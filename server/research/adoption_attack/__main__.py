"""Attacks on a scene that adopts: `python -m research.adoption_attack ROOM FOLDER --kind poster --photographs 1000`.

ROOM is the folder of `research.renovation`: its survey, 40 references, becomes a scene that adopts by the default
policy, in this process. An attacker, who may localize and nothing else, sends photographs of one kind of `kinds.py`,
rendered into FOLDER once; each is considered at once. 40 photographs of the surveyed room are localized before and
after. Prints Markdown: what became of the attacker's, and by how much the answers have moved, in their 68 % radii.
`--first` has a folder of true photographs adopted before, such as ROOM/step-03.
"""

import argparse
import asyncio
import math
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapless.geometry import RigidTransform
from mapless_server.scenes.adoption.policy import Evidence
from mapless_server.security import Principal, SceneKey
from mapless_server.serve.adoption.adopter import adopted_id
from mapless_server.store import adoption
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.output_files import markdown_table

from .attacked import SCENE, Attacked, Posed, answers, attacked, surveyed
from .kinds import KINDS
from .rendering import Renderer, Sent

WRONG_RADII = 3.0
"""An answer is wrong where it is off by so many 95 % radii of its position, and by `WRONG_M`."""
WRONG_M = 0.02
HEAD = "kind | sent | localized | wrong | considered | refused | adopted | off at most | shift at most | lost, gained"


@dataclass(frozen=True)
class Outcome:
    """The outcome of an attack.

    Attributes:
        kind, sent, localized: the attack, photographs, and those with an answer.
        wrong: answers that are wrong by the true pose.
        reasons: photographs by what became of them.
        adopted_off_m: distances of adopted poses from the true ones, metres.
        left: adopted references at the end, and those adopted before the attack that are still there.
        shifts: moves of the answers of surveyed views in their 68 % radii.
        lost, gained: views that had an answer before only, and after only.
        off_m: errors of the views before and after, median, metres.
        notes: retired references and outdated places at the end.
    """

    kind: str
    sent: int
    localized: int
    wrong: int
    reasons: Counter[str]
    adopted_off_m: tuple[float, ...]
    left: tuple[int, int, int]
    shifts: tuple[float, ...]
    lost: int
    gained: int
    off_m: tuple[float, float]
    notes: tuple[int, int]

    def row(self) -> list[str]:
        """A row of the table."""
        refused = {name: it for name, it in self.reasons.most_common() if name not in ("rejected", "adopted")}
        considered = sum(self.reasons.values()) - self.reasons["rejected"] - self.reasons["uncertain"]
        reasons = ", ".join(f"{it} {name}" for name, it in refused.items())
        off = f"{100 * max(self.adopted_off_m):.2f} cm" if self.adopted_off_m else ""
        shift = f"{max(self.shifts):.3f}" if self.shifts else ""
        counts = [self.kind, self.sent, self.localized, self.wrong, considered]
        return [*map(str, counts), reasons, str(self.reasons["adopted"]), off, shift, f"{self.lost}, {self.gained}"]

    def note(self) -> str:
        """A line about what is left at the end."""
        adopted, before, kept = self.left
        of_first = f", {kept} of the {before} adopted before" if before else ""
        median = float(np.median(self.shifts)) if self.shifts else 0.0
        retired, outdated = self.notes
        return (
            f"{self.kind}: {adopted} adopted at the end{of_first}; {retired} retired, {outdated} places outdated; "
            f"views are off by {100 * self.off_m[0]:.3f} cm in the median before, {100 * self.off_m[1]:.3f} cm after, "
            f"and have moved by {median:.3f} radii"
        )


def is_wrong(true: RigidTransform, found: Evidence) -> bool:
    """Whether an answer is far outside its radius."""
    return _off_m(true, found) > max(WRONG_M, WRONG_RADII * found.position_95_m)


def _off_m(true: RigidTransform, found: Evidence) -> float:
    return pose_error(true, found.world_from_camera)[0]


async def attack(server: Attacked, photographs: Sequence[Sent], until_s: float) -> tuple[Counter[str], int, int]:
    """Sends an attack, until `until_s` of the monotonic clock; counts what became of it, those localized, and wrong."""
    reasons, localized, wrong = Counter[str](), 0, 0
    for i, it in enumerate(photographs):
        if time.monotonic() > until_s:
            break
        server.clock.day = it.day
        answered, reason = await server.send(it.path.read_bytes(), it.camera)
        reasons[reason] += 1
        if answered is not None:
            localized += 1
            wrong += is_wrong(it.world_from_camera, answered)
        if i % 10 == 9:
            print(i + 1, localized, wrong, dict(reasons), file=sys.stderr, flush=True)
    return reasons, localized, wrong


async def true_ones_first(server: Attacked, folder: Path) -> list[str]:
    """Has photographs of a folder adopted, sent by one who may change scenes; ids of those adopted."""
    for it in read_folder(folder).frames:
        await server.send(it.image_path.read_bytes(), it.camera, Principal())
    return [it.reference_id async for it in server.client.list_references(SCENE, only_adopted=True)]


def compared(before: Sequence[Posed], after: Sequence[Posed]) -> tuple[list[float], int, int, tuple[float, float]]:
    """Moves of answers in their 68 % radii, those lost and gained, and median errors before and after, metres."""
    shifts, lost, gained = list[float](), 0, 0
    for (_, first), (_, last) in zip(before, after, strict=True):
        if first is None or last is None:
            lost, gained = lost + (first is not None and last is None), gained + (first is None and last is not None)
            continue
        shifts.append(pose_error(first.world_from_camera, last.world_from_camera)[0] / first.position_68_m)
    medians = [float(np.median([_off_m(true, it) for true, it in some if it is not None])) for some in (before, after)]
    return shifts, lost, gained, (medians[0], medians[1])


async def measure(
    kind: str, photographs: Sequence[Sent], arguments: argparse.Namespace, before: list[Posed]
) -> Outcome:
    """An attack on a fresh server; the answers to the views before any attack are added to `before` if it is empty."""
    views = read_folder(arguments.room / "step-00").frames[: arguments.views]
    until_s = time.monotonic() + 60 * arguments.minutes
    with tempfile.TemporaryDirectory(prefix="mapless-") as data:
        shutil.copytree(arguments.folder / "surveyed", data, dirs_exist_ok=True)
        async with attacked(Path(data)) as server:
            first = [] if arguments.first is None else await true_ones_first(server, arguments.first)
            before.extend([] if before else await answers(server, views))
            reasons, localized, wrong = await attack(server, photographs, until_s)
            shifts, lost, gained, off_m = compared(before, await answers(server, views))
            adopted = [it async for it in server.client.list_references(SCENE, only_adopted=True)]
            retired = [it async for it in server.client.list_references(SCENE, only_retired=True)]
            with server.store.database.read() as connection:
                outdated = len(adoption.list_outdated(connection, SceneKey(SCENE)))
            true = {adopted_id(it.path.read_bytes()): it.world_from_camera for it in photographs}
            off = tuple(
                pose_error(true[it.reference_id], it.world_from_camera)[0] for it in adopted if it.reference_id in true
            )
            kept = len({it.reference_id for it in adopted} & set(first))
    return Outcome(
        kind, reasons.total(), localized, wrong, reasons, off, (len(adopted), len(first), kept),
        tuple(shifts), lost, gained, off_m, (len(retired), outdated),
    )  # fmt: skip


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("room", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=["poster"])
    parser.add_argument("--photographs", type=int, default=1000, help="of each kind")
    parser.add_argument("--minutes", type=float, default=math.inf, help="each attack ends after so many at the latest")
    parser.add_argument("--views", type=int, default=40, help="photographs that are localized before and after")
    parser.add_argument("--first", type=Path, help="folder of true photographs that are adopted before")
    parser.add_argument("--seed", type=int, default=0, help="of the room")
    arguments = parser.parse_args()
    asyncio.run(surveyed(arguments.room / "survey", arguments.folder / "surveyed"))
    renderer, outcomes = Renderer(arguments.folder, arguments.seed), list[Outcome]()
    before = list[Posed]()
    for kind in arguments.kind:
        photographs = renderer.photographs(kind, arguments.photographs)
        outcomes.append(asyncio.run(measure(kind, photographs, arguments, before)))
        print(*outcomes[-1].row(), outcomes[-1].note(), sep=" | ", file=sys.stderr, flush=True)
    print("\n".join(markdown_table(HEAD, [it.row() for it in outcomes])), "", sep="\n")
    print("\n".join(it.note() for it in outcomes))


if __name__ == "__main__":
    main()
