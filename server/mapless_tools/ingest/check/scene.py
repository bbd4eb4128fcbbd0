"""Checks whether photographs fit the references that are in a scene already, and aligns them if they do not.

Poses of two sessions may each agree among themselves and be in worlds of their own. So new photographs are compared
with references of the scene that look similar, and with the nearest ones by their poses. A photograph fits if any of
its pairs is good: a wrong pose hardly ever gives one, and repeated structure gives bad ones to right poses, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mapless import Client, DataLoss, InvalidArgument, NotFound, Reference
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.pairs.readings.alignment import Alignment, align
from mapless_server.method.pairs.readings.errors import Pair, PairError, errors_of
from mapless_tools.dataset import Frame
from mapless_tools.progress import Progress

from .comparison import Comparison
from .pairs import MAX_TURN_DEG

COMPARED = 12
"""New photographs that are compared, spread evenly: enough for a share, and they take seconds."""
SIMILAR, NEAREST = 3, 2
"""References of the scene that each is compared with: similar ones, and near ones that look the same way."""
LEAST_MISFITS = 2
"""Photographs that do not fit, before the session as a whole does not: one may be wrong alone."""


@dataclass(frozen=True, eq=False)
class SceneVerdict:
    """How new photographs fit the references of a scene.

    Attributes:
        fitting: names of the new photographs that fit at least one reference.
        misfits: names of those that fit none of the references that they share matches with.
        pairs: the errors of all compared pairs that have matches.
        alignment: the similarity from the new photographs' world to the scene's; None if none was found.
    """

    fitting: tuple[str, ...]
    misfits: tuple[str, ...]
    pairs: tuple[PairError, ...]
    alignment: Alignment | None

    @property
    def is_known(self) -> bool:
        """Whether any photographs could be compared."""
        return bool(self.pairs)

    @property
    def is_wrong(self) -> bool:
        """Whether the session as a whole does not fit the scene."""
        return len(self.misfits) >= LEAST_MISFITS and len(self.misfits) > len(self.fitting)

    def lines(self) -> list[str]:
        """The result, a sentence per line; empty if nothing could be compared."""
        if not self.is_known:
            return []
        compared = len(self.fitting) + len(self.misfits)
        median_px = float(np.median([it.error_px for it in self.pairs]))
        lines = [
            f"compared with the scene: {len(self.fitting)} of {compared} photographs fit references that show the "
            f"same, median {median_px:.2f} px over {len(self.pairs)} pairs"
        ]
        if not self.is_wrong:
            lines += [f"warning: {name} does not fit the references that show the same" for name in self.misfits]
            return lines
        lines.append(
            "warning: the photographs do not fit those of the scene that show the same, although they may fit one "
            "another: another session's world, or one that drifted?"
        )
        if self.alignment is not None and self.alignment.is_unique:
            lines.append(
                f"warning: they would fit ({self.alignment.median_px:.2f} px) with {self.alignment.text}: "
                "--align-to-scene stores them so"
            )
        return lines


def check_with_scene(
    client: Client, scene: str, frames: Sequence[Frame], existing: Sequence[Reference], progress: Progress
) -> SceneVerdict:
    """Compares new frames with references of a scene; those that are there already are left out.

    So are photographs that the server cannot read and references that it cannot give: damaged ones, or deleted since.
    """
    there = {reference.reference_id: reference for reference in existing}
    new = [frame for frame in frames if frame.name not in there]
    new = [new[int(i)] for i in np.linspace(0, len(new) - 1, min(len(new), COMPARED)).round()] if new else []
    wanted = [_partners(client, scene, frame, there, progress, i, len(new)) for i, frame in enumerate(new)]
    used = sorted({name for names in wanted for name in names})
    with TemporaryDirectory(prefix="mapless-") as folder:
        stored = {
            name: it
            for i, name in enumerate(used)
            if (it := _frame(client, scene, there[name], Path(folder) / str(i))) is not None
        }
        position = {name: i for i, name in enumerate(stored)}
        comparison = Comparison([*stored.values(), *new], SiftExtractor(), progress)
        pairs: list[Pair] = [
            (position[name], len(stored) + i) for i, names in enumerate(wanted) for name in names if name in position
        ]
        comparison.compare(pairs)
        views, matched = comparison.readable(), comparison.matched
    errors = errors_of(views, matched)
    fitting = {error.pair[1] for error in errors if not error.is_bad}
    compared = {error.pair[1] for error in errors}
    alignment = align(views, matched)
    names = [[new[i - len(stored)].name for i in sorted(its)] for its in (fitting, compared - fitting)]
    return SceneVerdict(tuple(names[0]), tuple(names[1]), tuple(errors), alignment)


def _partners(
    client: Client,
    scene: str,
    frame: Frame,
    there: dict[str, Reference],
    progress: Progress,
    number: int,
    count: int,
) -> list[str]:
    """Ids of the references that a frame is compared with."""
    progress("comparing with the scene", number + 1, count)
    names: list[str] = []
    try:
        similar = client.retrieve_references(frame.image_path, frame.camera, scene, SIMILAR, mask=frame.mask_path)
    except (OSError, InvalidArgument):  # refused where it is stored
        return names
    for found in similar:
        name = found.name.rpartition("/")[2]
        if name in there:
            names.append(name)
    pose = frame.world_from_camera
    ahead = np.cos(np.radians(MAX_TURN_DEG))
    facing = [it for it in there.values() if it.world_from_camera.rotation[:, 2] @ pose.rotation[:, 2] > ahead]
    near = sorted(facing, key=lambda it: float(np.linalg.norm(it.world_from_camera.translation - pose.translation)))
    return list(dict.fromkeys([*names, *(it.reference_id for it in near[:NEAREST])]))


def _frame(client: Client, scene: str, reference: Reference, file: Path) -> Frame | None:
    try:
        found = client.get_reference(scene, reference.reference_id, include_image=True)
    except (DataLoss, NotFound):
        return None
    file.write_bytes(found.image or b"")
    mask_path = None
    if found.mask is not None:
        mask_path = file.with_suffix(".mask.png")
        mask_path.write_bytes(found.mask)
    return Frame(reference.reference_id, file, reference.camera, reference.world_from_camera, mask_path=mask_path)
