"""Localizing a folder's photographs through a server, and what each answer claimed beside the truth."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapless import Client, InvalidArgument, LocalizationResult, Reference, Rejected, RigidTransform
from mapless_server.method.uncertainty.accuracy import Accuracy
from mapless_server.services.messages.factors import Conditions, Factors, scaled_accuracy, scaled_covariance
from mapless_tools.dataset import Frame
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.plan import PlannedQuery, UsageError
from mapless_tools.evaluate.run import CONNECT
from mapless_tools.progress import Progress

from .claims import Claim

MAX_RERANKED = 1000
"""References that one call may name to choose among."""
SAME_M, SAME_DEG = 1e-3, 0.01
"""A photograph that is a reference, too, must have the same pose in both; nobody writes poses less exactly."""


@dataclass(frozen=True, eq=False)
class Question:
    """A photograph and what it is compared with.

    Attributes:
        frame: with its true pose, in the scene's world.
        references: names; none: the server chooses among all.
        reranked: whether it chooses `count` among `references`.
    """

    frame: Frame
    references: tuple[str, ...] = ()
    reranked: bool = False


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of a photograph.

    Attributes:
        name: of the frame.
        error_m, error_deg: of the answered pose; infinite if there is none.
        position, rotation: what was claimed, in metres and degrees; None if nothing was.
        trust: of the answer; None if it has none.
        inlier_count, match_count: of the answer.
        rejection, message: why there is no pose; empty if there is one.
        conditions: what computed it; None if the server refused the photograph.
        true_pose: world from camera.
        pose: the answered one.
    """

    name: str
    error_m: float
    error_deg: float
    position: Claim | None
    rotation: Claim | None
    trust: float | None
    inlier_count: int
    match_count: int
    rejection: str
    message: str
    conditions: Conditions | None
    true_pose: RigidTransform
    pose: RigidTransform | None


def planned_questions(queries: Sequence[PlannedQuery]) -> list[Question]:
    """The questions of an evaluation's plan."""
    return [Question(query.frame, tuple(reference.name for reference in query.references)) for query in queries]


def scene_questions(client: Client, scene: str, frames: Sequence[Frame], progress: Progress) -> list[Question]:
    """Questions to a scene that is there: no photograph is offered itself, nor a copy of itself.

    Raises:
        UsageError: the scene has too few references, or a photograph's poses in the folder and in the scene differ.
        MaplessError: a call failed.
    """
    known = list(client.list_references(scene, page_size=1000))
    if len(known) < 2:
        raise UsageError(
            f"scene {scene} has {len(known)} reference{'s' * (len(known) != 1)}; two are needed to localize anything"
        )
    by_digest: dict[str, list[Reference]] = {}
    for reference in known:
        by_digest.setdefault(reference.image_sha256, []).append(reference)
    questions = []
    for frame in frames:
        own = by_digest.get(hashlib.sha256(frame.image_path.read_bytes()).hexdigest(), [])
        _refuse_another_pose(frame, own, scene)
        questions.append(_without(client, scene, frame, known, own))
        progress("choosing references", len(questions), len(frames))
    return questions


def ask(
    client: Client, scene: str, question: Question, *, count: int, variant: str, scaled: Factors | None = None
) -> Outcome:
    """Localizes one photograph.

    Args:
        client: of the server.
        scene: id of the scene.
        question: the photograph.
        count: references to choose, where the server does.
        variant: form of the method.
        scaled: factors that the server multiplies claims by if they are calibrated; they are divided out again.

    Raises:
        MaplessError: the call failed, for another reason than the photograph.
    """
    frame = question.frame
    try:
        answer = client.localize(
            frame.image_path.read_bytes(),
            frame.camera,
            scene,
            question.references,
            variant=variant,
            reference_count=count if question.reranked or not question.references else 0,
            rerank_references=question.reranked,
            timeout_s=CONNECT.timeout_s,
        )
    except InvalidArgument as error:
        return _nothing(frame, "REFUSED", error.message)
    used = answer.diagnostics
    conditions = Conditions(used.features, used.backend, used.variant, used.server_version)
    if isinstance(answer, Rejected):
        return replace(_nothing(frame, answer.reason, answer.message), conditions=conditions)
    return _outcome(frame, answer, conditions, scaled)


def _outcome(frame: Frame, answer: LocalizationResult, conditions: Conditions, scaled: Factors | None) -> Outcome:
    error_m, error_deg = pose_error(frame.world_from_camera, answer.world_from_camera)
    position = rotation = None
    if answer.accuracy is not None and answer.covariance is not None:
        said, covariance = answer.accuracy, answer.covariance
        accuracy = Accuracy(said.position_68_m, said.position_95_m, said.rotation_68_deg, said.rotation_95_deg)
        if said.calibrated and scaled is not None:
            accuracy = scaled_accuracy(accuracy, scaled.inverse)
            covariance = scaled_covariance(covariance, scaled.inverse)
        position = Claim.of(error_m, accuracy.position_68_m, accuracy.position_95_m, covariance[:3, :3])
        in_degrees = np.degrees(np.degrees(covariance[3:, 3:]))
        rotation = Claim.of(error_deg, accuracy.rotation_68_deg, accuracy.rotation_95_deg, in_degrees)
    return Outcome(
        name=frame.name,
        error_m=error_m,
        error_deg=error_deg,
        position=position,
        rotation=rotation,
        trust=answer.trust,
        inlier_count=answer.inlier_count,
        match_count=answer.match_count,
        rejection="",
        message="",
        conditions=conditions,
        true_pose=frame.world_from_camera,
        pose=answer.world_from_camera,
    )


def _nothing(frame: Frame, reason: str, message: str) -> Outcome:
    pose = frame.world_from_camera
    return Outcome(frame.name, math.inf, math.inf, None, None, None, 0, 0, reason, message, None, pose, None)


def _refuse_another_pose(frame: Frame, own: Sequence[Reference], scene: str) -> None:
    for reference in own:
        off_m, off_deg = pose_error(reference.world_from_camera, frame.world_from_camera)
        if off_m > SAME_M or off_deg > SAME_DEG:
            raise UsageError(
                f"{frame.image_path.name} is reference {reference.reference_id} of scene {scene}, which stands "
                f"{off_m:.3g} m and {off_deg:.3g} degrees from the folder's pose: the folder's poses are not in the "
                "scene's world, or one of the two is wrong"
            )


def _without(
    client: Client, scene: str, frame: Frame, known: Sequence[Reference], own: Sequence[Reference]
) -> Question:
    """The question whose references are all but the photograph itself."""
    if not own:
        return Question(frame)
    left_out = {reference.reference_id for reference in own}
    others = [reference.reference_id for reference in known if reference.reference_id not in left_out]
    if not others:
        raise UsageError(f"scene {scene} has no reference but {frame.image_path.name} itself")
    if len(others) > MAX_RERANKED:
        similar = client.retrieve_references(frame.image_path, frame.camera, scene, MAX_RERANKED)
        names = (it.name.rpartition("/")[2] for it in similar)
        others = [name for name in names if name not in left_out]
    return Question(frame, tuple(others), reranked=True)
