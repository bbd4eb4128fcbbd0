"""An evaluation of a folder from beginning to end, through client, gRPC, decoding, engine and method."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mapless import Client, LocalizationResult, NewReference, ReferenceUse, Rejected, RigidTransform
from mapless.names import parse_reference_name
from mapless_server.settings import Settings
from mapless_tools.child import temporary_server
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.progress import Progress, tracked

from .metrics import EarlierAnswer, QueryResult, pose_error, trajectory_radius
from .plan import EvaluationOptions, split_frames
from .references import Matcher, PlannedQuery, check_images, rank_by_matches

SCENE = "evaluation"

_LOOK_S = 1.0
LONGEST_STANDSTILL_S = 600.0
"""Twice as long as a network that could not be loaded rests."""


@dataclass(frozen=True, eq=False)
class Plan:
    """References to upload and queries to localize."""

    references: tuple[Frame, ...]
    queries: tuple[PlannedQuery, ...]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The results of an evaluation, one for each query, with its dataset and options.

    `reference_count` includes the query if one is left out; the references' trajectory radius is in the dataset's unit.
    `scene_id` is the stored scene that was measured; empty for one of the dataset's own frames.
    """

    dataset: Dataset
    options: EvaluationOptions
    reference_count: int
    trajectory_radius: float
    results: tuple[QueryResult, ...]
    scene_id: str = ""


def evaluate(dataset: Dataset, options: EvaluationOptions, settings: Settings, progress: Progress) -> Evaluation:
    """Measures a server of its own on a folder; UsageError if the folder does not suffice for the options."""
    plan = plan_for(dataset, options, settings, progress)
    with temporary_server() as client:
        store_references(client, SCENE, plan.references, progress)
        await_features(client, SCENE, progress)
        results = localize_queries(client, plan, options, progress)
    radius = trajectory_radius(np.array([f.world_from_camera.translation for f in plan.references]))
    return Evaluation(dataset, options, len(plan.references), radius, results)


def plan_for(dataset: Dataset, options: EvaluationOptions, settings: Settings, progress: Progress) -> Plan:
    """Chooses references and queries, and ranks the references of each query by their feature matches with it.

    UsageError if there are too few frames; an image is missing, damaged or of another size than its camera; or the
    settings ask for features that are not there.
    """
    matcher = Matcher.of(settings)
    references, queries = split_frames(dataset.frames, options)
    check_images(dict.fromkeys((*references, *queries)), matcher.limits)
    return Plan(references, rank_by_matches(queries, references, options.k, matcher, progress))


def store_references(client: Client, scene: str, references: Sequence[Frame], progress: Progress) -> None:
    """Creates a scene with these references."""
    client.create_scene(scene)
    new = (
        NewReference(f.name, f.image_path, f.camera, f.world_from_camera, f.mask_path, f.provenance, f.read_depth())
        for f in references
    )
    total = len(references)
    progress("storing references", 0, total)
    client.add_references(scene, new, on_progress=lambda done: progress("storing references", done, total))


def await_features(client: Client, scene: str, progress: Progress = lambda *_: None) -> None:
    """Waits until the server has found the features that doubtful photographs need: their answers depend on them.

    TimeoutError if none were found for `LONGEST_STANDSTILL_S`.
    """
    total, least, found_s = 0, math.inf, time.monotonic()
    while True:
        pending = client.get_scene(scene).pending_work
        left = max((it.reference_count for it in pending if it.kind == "features"), default=0)
        total = max(total, left)
        if total:
            progress("finding further features", total - left, total)
        if not left:
            return
        if left < least:
            least, found_s = left, time.monotonic()
        elif time.monotonic() - found_s >= LONGEST_STANDSTILL_S:
            why = f"the server has found no further features for {LONGEST_STANDSTILL_S:.0f} s"
            raise TimeoutError(f"scene {scene}: {why}, {left} references lack some; its log says why")
        time.sleep(_LOOK_S)


def localize_queries(
    client: Client, plan: Plan, options: EvaluationOptions, progress: Progress
) -> tuple[QueryResult, ...]:
    """Localizes the plan's queries, one after the other."""
    references = {frame.name: frame.world_from_camera for frame in plan.references}
    queries = tracked("localizing", plan.queries, len(plan.queries), progress)
    return tuple(localize_query(client, SCENE, query, options, references) for query in queries)


def localize_query(
    client: Client,
    scene: str,
    query: PlannedQuery,
    options: EvaluationOptions,
    references: Mapping[str, RigidTransform],
) -> QueryResult:
    """Localizes one query; if it has no references, the server chooses k of those of the scene, given by name."""
    return ask(client, scene, query, options, references)[0]


def ask(
    client: Client,
    scene: str,
    query: PlannedQuery,
    options: EvaluationOptions,
    references: Mapping[str, RigidTransform],
    **flags: Any,
) -> tuple[QueryResult, LocalizationResult | Rejected]:
    """Localizes as `localize_query`, with flags of `Client.localize`; returns the answer itself, too."""
    frame = query.frame
    image = frame.image_path.read_bytes()
    mask = None if frame.mask_path is None else frame.mask_path.read_bytes()
    start_s = time.perf_counter()
    *earlier, answer = client.localize_progressively(
        image,
        frame.camera,
        scene,
        [reference.name for reference in query.references],
        variant=options.variant,
        scale_strategy=options.scale_strategy,
        reference_count=0 if query.references else options.k,
        mask=mask,
        **flags,
    )
    latency_ms = 1000 * (time.perf_counter() - start_s)
    result = _result(frame, answer, query.references, latency_ms, references)
    accepted = tuple(_earlier(frame, it) for it in earlier if isinstance(it, LocalizationResult))
    return replace(result, earlier=accepted), answer


def reference_id(use: ReferenceUse) -> str:
    """The id of a reference that an answer used."""
    return parse_reference_name(use.name)[1]


def _earlier(frame: Frame, answer: LocalizationResult) -> EarlierAnswer:
    rung = next((attempt.rung for attempt in answer.diagnostics.attempts if attempt.chosen), "")
    return EarlierAnswer(rung, *pose_error(frame.world_from_camera, answer.world_from_camera))


def _result(
    frame: Frame,
    answer: LocalizationResult | Rejected,
    given: Sequence[Frame],
    latency_ms: float,
    references: Mapping[str, RigidTransform],
) -> QueryResult:
    diagnostics = answer.diagnostics
    uses = {reference_id(use): use for use in diagnostics.references}
    used = [it.name for it in given] or list(uses)
    centre = frame.world_from_camera.translation
    distances = [float(np.linalg.norm(references[it].translation - centre)) for it in used if it in references]
    found = answer if isinstance(answer, LocalizationResult) else None
    errors = pose_error(frame.world_from_camera, found.world_from_camera) if found else (math.inf, math.inf)
    return QueryResult(
        name=frame.name,
        references=tuple(used),
        translation_error=errors[0],
        rotation_error_deg=errors[1],
        reference_distance=float(np.median(distances)) if distances else math.inf,
        inlier_count=found.inlier_count if found else 0,
        match_count=found.match_count if found else 0,
        rejection="" if isinstance(answer, LocalizationResult) else answer.reason,
        message="" if isinstance(answer, LocalizationResult) else answer.message,
        latency_ms=latency_ms,
        stage_ms={stage: 1000 * seconds for stage, seconds in diagnostics.stage_s.items()},
        backend=diagnostics.backend,
        features=diagnostics.features,
        best_reference=max(uses, key=lambda name: uses[name].inlier_count, default="") if found else "",
        pose=_numbers(found.world_from_camera) if found else None,
        accuracy=found.accuracy if found else None,
        trust=found.trust if found else None,
        intrinsics_checks=answer.intrinsics_checks,
        processor_ms=1000 * diagnostics.processor_s,
        attempts=diagnostics.attempts,
    )


def _numbers(pose: RigidTransform) -> tuple[float, ...]:
    q = pose.quaternion()
    return (*pose.translation.tolist(), q.x, q.y, q.z, q.w)
