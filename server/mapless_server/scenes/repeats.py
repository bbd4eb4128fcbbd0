"""References that repeat a pose or a photograph, by what is stored of them, without a look at the photographs.

The same photograph with two poses has a wrong one. Different photographs with exactly the same pose are those of a
camera that stood still, or of a tracker that had not begun and gave its start, often the identity, to all.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

from mapless.geometry import RigidTransform
from mapless_server.method.pairs.readings.repeats import is_start, pose_difference, same_poses
from mapless_server.store import ReferenceRecord
from mapless_server.store.reader import ALIKE_MOST

SAME_POSITION_M, SAME_ROTATION_DEG = 1e-3, 0.01
"""Poses of one photograph that differ by less are the same: they are stored, and travel, rounded."""
NAMED = 5
"""References that a sentence names, and sentences about photographs."""


@dataclass(frozen=True, eq=False)
class PosedImage:
    """The parts of a reference that may be repeated: its image, by the hash of its bytes, and its pose."""

    reference_id: str
    image_sha256: str
    world_from_camera: RigidTransform

    @staticmethod
    def of(reference_id: str, image: bytes, world_from_camera: RigidTransform) -> "PosedImage":
        """Describes a reference to be added."""
        return PosedImage(reference_id, hashlib.sha256(image).hexdigest(), world_from_camera)


def repeats(added: Sequence[PosedImage], stored: Sequence[ReferenceRecord]) -> list[str]:
    """Sentences about added references that have the image, or exactly the pose, of stored or other added ones."""
    known = [PosedImage(it.reference_id, it.image_sha256, it.world_from_camera) for it in stored]
    return [*_same_photographs(added, known), *_same_poses(known, added)]


def _same_photographs(added: Sequence[PosedImage], known: Sequence[PosedImage]) -> list[str]:
    first_of: dict[str, PosedImage] = {}
    for it in [*known, *added]:
        first_of.setdefault(it.image_sha256, it)
    texts = []
    for it in added:
        other = first_of[it.image_sha256]
        apart_m, turn_deg = pose_difference(it.world_from_camera, other.world_from_camera)
        if apart_m > SAME_POSITION_M or turn_deg > SAME_ROTATION_DEG:
            texts.append(
                f"{it.reference_id} is the same photograph as {other.reference_id}, but its pose is {apart_m:.3g} m "
                f"and {turn_deg:.3g} degrees away: one of them is wrong"
            )
    more = [f"so are {len(texts) - NAMED} more"] if len(texts) > NAMED else []
    return texts[:NAMED] + more


def _same_poses(known: Sequence[PosedImage], added: Sequence[PosedImage]) -> list[str]:
    every = [*known, *added]
    texts = []
    for indices in same_poses({i: it.world_from_camera for i, it in enumerate(every)}):
        group = [every[i] for i in indices]
        if indices[-1] < len(known) or len({it.image_sha256 for it in group}) < 2:
            continue
        # Of many, the store gives only some.
        is_cut = sum(i < len(known) for i in indices) >= ALIKE_MOST
        ids = [it.reference_id for it in group]
        texts.append(same_pose_text("with different photographs", ids, group[0].world_from_camera, is_cut))
    return texts


def same_pose_text(
    what: str, reference_ids: Sequence[str], world_from_camera: RigidTransform, is_cut: bool = False
) -> str:
    """One sentence about references with exactly this pose; `what` they are else, in words; if it `is_cut`, of more."""
    count = f"{'at least ' if is_cut else ''}{len(reference_ids)}"
    names = ", ".join(reference_ids[:NAMED])
    more = f" and {len(reference_ids) - NAMED} more" if len(reference_ids) > NAMED else ""
    why = (
        "the identity: had tracking not begun?"
        if is_start(world_from_camera)
        else "unless the camera stood still, all but one are wrong"
    )
    return f"{count} references {what} have exactly the same pose ({names}{more}): {why}"
