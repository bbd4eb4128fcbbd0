"""Localizes a folder's photographs through a server, compares answers with the truth, and checks that the worlds agree.

If a folder's poses are in another world than the scene, every answer is wrong, and all are wrong in the same way.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapless import Client, InvalidArgument, LocalizationResult, Reference, Rejected, RigidTransform
from mapless_server.services.messages.radii import Conditions
from mapless_tools.child import CONNECT
from mapless_tools.dataset import Frame
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.references import PlannedQuery
from mapless_tools.progress import Progress, tracked
from mapless_tools.usage import UsageError

from .claims import Claim

MAX_RERANKED = 1000
"""References that one call may name to choose among."""
SAME_M, SAME_DEG = 1e-3, 0.01
"""A photograph that is a reference, too, must have the same pose in both; poses are written more exactly than that."""
MIN_ANSWERS = 3
"""Two could agree by chance."""
FAR = 3.0
"""Answers are suspected where half of them are off by more than so many of their claimed 95 % radii."""
EXPLAINED = 0.2
"""One rigid motion explains them if it leaves at most this share of half of the errors."""


@dataclass(frozen=True, eq=False)
class Query:
    """A photograph, and the references it is compared with or (`reranked`) chosen from; none for all."""

    frame: Frame
    references: tuple[str, ...] = ()
    reranked: bool = False


@dataclass(frozen=True, eq=False)
class Outcome:
    """The answer to a photograph, compared with the truth: metres and degrees, infinite without a pose.

    Claims are None without radii, conditions if the server refused the photograph.
    """

    name: str
    true_pose: RigidTransform
    pose: RigidTransform | None = None
    error_m: float = math.inf
    error_deg: float = math.inf
    position: Claim | None = None
    rotation: Claim | None = None
    trust: float | None = None
    inlier_count: int = 0
    match_count: int = 0
    rejection: str = ""
    message: str = ""
    conditions: Conditions | None = None


def planned_queries(queries: Sequence[PlannedQuery]) -> list[Query]:
    """Makes the queries of an evaluation's plan."""
    return [Query(query.frame, tuple(reference.name for reference in query.references)) for query in queries]


def scene_queries(client: Client, scene: str, frames: Sequence[Frame], progress: Progress) -> list[Query]:
    """Queries for a stored scene, none compared with a copy of itself; UsageError for few references or other poses."""
    known = list(client.list_references(scene, page_size=1000))
    if len(known) < 2:
        raise UsageError(
            f"scene {scene} has {len(known)} reference{'s' * (len(known) != 1)}; two are needed to localize anything"
        )
    by_digest: dict[str, list[Reference]] = {}
    for reference in known:
        by_digest.setdefault(reference.image_sha256, []).append(reference)
    queries = []
    for frame in tracked("choosing references", frames, len(frames), progress):
        own = by_digest.get(hashlib.sha256(frame.image_path.read_bytes()).hexdigest(), [])
        _refuse_another_pose(frame, own, scene)
        queries.append(_without(client, scene, frame, known, own))
    return queries


def localize(client: Client, scene: str, query: Query, *, count: int, variant: str) -> Outcome:
    """Localizes one photograph as if the scene had no calibration, with `count` references where the server chooses."""
    frame = query.frame
    try:
        answer = client.localize(
            frame.image_path.read_bytes(),
            frame.camera,
            scene,
            query.references,
            variant=variant,
            reference_count=count if query.reranked or not query.references else 0,
            rerank_references=query.reranked,
            ignore_calibration=True,
            mask=frame.mask_path,
            timeout_s=CONNECT.timeout_s,
        )
    except InvalidArgument as error:
        return Outcome(frame.name, frame.world_from_camera, rejection="REFUSED", message=error.message)
    used = answer.diagnostics
    conditions = Conditions(used.features, used.backend, used.variant, used.server_version)
    outcome = Outcome(frame.name, frame.world_from_camera, conditions=conditions)
    if isinstance(answer, Rejected):
        return replace(outcome, rejection=answer.reason, message=answer.message)
    return _judged(outcome, answer)


@dataclass(frozen=True)
class OtherWorld:
    """The motion of a folder's frame in the scene's, by the answers; `left_m` is the median error after undoing it."""

    moved_m: float
    turned_deg: float
    left_m: float

    def __str__(self) -> str:
        return (
            f"the folder's poses are in another world than the scene: answers agree with them to {self.left_m:.3g} m, "
            f"once these are turned by {self.turned_deg:.3g} degrees and moved by {self.moved_m:.3g} m"
        )


def other_world(outcomes: Sequence[Outcome]) -> OtherWorld | None:
    """The motion between the folder's world and the scene's; None if the answers do not show one.

    Each answer's scene_from_folder = answered pose times inverse true pose is a candidate; the one that leaves the
    smallest median error is taken.
    """
    found = [it for it in outcomes if it.pose is not None and it.position is not None]
    if len(found) < MIN_ANSWERS:
        return None
    in_radii = [it.error_m / max(it.position.radius_95, np.finfo(float).tiny) for it in found if it.position]
    if np.median(in_radii) <= FAR:
        return None
    candidates = [it.pose.compose(it.true_pose.inverse()) for it in found if it.pose]
    left = [_median_error_m(found, candidate) for candidate in candidates]
    best = int(np.argmin(left))
    if left[best] > EXPLAINED * float(np.median([it.error_m for it in found])):
        return None
    moved_m, turned_deg = pose_error(RigidTransform(np.eye(3), np.zeros(3)), candidates[best])
    return OtherWorld(moved_m, turned_deg, left[best])


def _judged(outcome: Outcome, answer: LocalizationResult) -> Outcome:
    error_m, error_deg = pose_error(outcome.true_pose, answer.world_from_camera)
    position = rotation = None
    if answer.accuracy is not None and answer.covariance is not None:
        claimed, covariance = answer.accuracy, answer.covariance
        if claimed.calibrated_by:
            raise UsageError("the server is older than this command and cannot answer without the scene's calibration")
        position = Claim.of(error_m, claimed.position_68_m, claimed.position_95_m, covariance[:3, :3])
        in_degrees = np.degrees(np.degrees(covariance[3:, 3:]))
        rotation = Claim.of(error_deg, claimed.rotation_68_deg, claimed.rotation_95_deg, in_degrees)
    return replace(
        outcome,
        pose=answer.world_from_camera,
        error_m=error_m,
        error_deg=error_deg,
        position=position,
        rotation=rotation,
        trust=answer.trust,
        inlier_count=answer.inlier_count,
        match_count=answer.match_count,
    )


def _refuse_another_pose(frame: Frame, own: Sequence[Reference], scene: str) -> None:
    for reference in own:
        off_m, off_deg = pose_error(reference.world_from_camera, frame.world_from_camera)
        if off_m > SAME_M or off_deg > SAME_DEG:
            raise UsageError(
                f"{frame.image_path.name} is reference {reference.reference_id} of scene {scene}, which stands "
                f"{off_m:.3g} m and {off_deg:.3g} degrees from the folder's pose: the folder's poses are not in the "
                "scene's world, or one of the two is wrong"
            )


def _without(client: Client, scene: str, frame: Frame, known: Sequence[Reference], own: Sequence[Reference]) -> Query:
    """The query whose references are all except the photograph itself."""
    if not own:
        return Query(frame)
    left_out = {reference.reference_id for reference in own}
    others = [reference.reference_id for reference in known if reference.reference_id not in left_out]
    if not others:
        raise UsageError(f"scene {scene} has no reference but {frame.image_path.name} itself")
    if len(others) > MAX_RERANKED:
        similar = client.retrieve_references(frame.image_path, frame.camera, scene, MAX_RERANKED, mask=frame.mask_path)
        names = (it.name.rpartition("/")[2] for it in similar)
        others = [name for name in names if name not in left_out]
    return Query(frame, tuple(others), reranked=True)


def _median_error_m(found: Sequence[Outcome], scene_from_folder: RigidTransform) -> float:
    off = [it.pose.translation - scene_from_folder.apply(it.true_pose.translation) for it in found if it.pose]
    return float(np.median(np.linalg.norm(off, axis=1)))
