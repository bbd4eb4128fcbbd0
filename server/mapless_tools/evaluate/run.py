"""An evaluation from end to end: client, gRPC, decoding, engine, pipeline; nothing is bypassed."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapless import Client, ConnectOptions, LocalizationResult, NewReference, Rejected, RigidTransform
from mapless.names import parse_reference_name
from mapless_server.method.correspond import OPTIONS
from mapless_server.method.features import FeatureExtractor
from mapless_server.networks.weights import WeightsError
from mapless_server.serve.assembly import image_limits, make_first_features
from mapless_server.settings import Settings
from mapless_tools.child import child_server
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.progress import Progress

from .metrics import QueryResult, pose_error, trajectory_radius
from .plan import EvaluationOptions, Plan, PlannedQuery, UsageError, make_plan

SCENE = "evaluation"

# An answer is measured however late it comes, and however large the photographs are.
CONNECT = ConnectOptions(timeout_s=600.0, upload_timeout_s=3600.0, batch_count=8)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Results and what they are results of.

    Attributes:
        reference_count: references of the scene; when one is left out, the query among them.
        trajectory_radius: of the references, the dataset's unit.
    """

    dataset: Dataset
    options: EvaluationOptions
    reference_count: int
    trajectory_radius: float
    results: tuple[QueryResult, ...]


def evaluate(dataset: Dataset, options: EvaluationOptions, settings: Settings, progress: Progress) -> Evaluation:
    """Measures the server on a folder; starts one and ends it.

    Raises:
        UsageError: the folder does not hold what the options ask for.
        ServerFailed: the server does not start.
        MaplessError: a call failed.
    """
    plan = plan_for(dataset, options, settings, progress)
    with (
        tempfile.TemporaryDirectory(prefix="mapless-evaluate-") as data_dir,
        child_server(Path(data_dir)) as server,
        Client(server.address, CONNECT) as client,
    ):
        upload(client, plan, progress)
        return evaluation_of(plan, options, localize_queries(client, plan, options, progress))


def plan_for(dataset: Dataset, options: EvaluationOptions, settings: Settings, progress: Progress) -> Plan:
    """The plan, chosen with the first features that a server of these settings has.

    Raises:
        UsageError: as `make_plan`, or the settings ask for features that are not there.
    """
    extractor, ratio = first_features(settings)
    return make_plan(dataset, options, extractor, ratio, image_limits(settings), progress)


def first_features(settings: Settings) -> tuple[FeatureExtractor, float]:
    """The first features that a server of these settings has, and their ratio of a match with the query.

    Raises:
        UsageError: the settings ask for features that are not there.
    """
    try:
        features, extractor = make_first_features(settings)
    except (ValueError, ImportError, WeightsError) as error:
        raise UsageError(str(error)) from error
    return extractor, OPTIONS[features].query_ratio


def upload(client: Client, plan: Plan, progress: Progress) -> None:
    """Creates the scene and stores the plan's references in it."""
    store_references(client, SCENE, plan.references, progress)


def store_references(client: Client, scene: str, references: Sequence[Frame], progress: Progress) -> None:
    """Creates a scene with these references.

    Raises:
        MaplessError: a call failed.
    """
    client.create_scene(scene)
    new = (NewReference(f.name, f.image_path, f.camera, f.world_from_camera) for f in references)
    total = len(references)
    progress("storing references", 0, total)
    client.add_references(scene, new, on_progress=lambda done: progress("storing references", done, total))


def localize_queries(
    client: Client, plan: Plan, options: EvaluationOptions, progress: Progress
) -> tuple[QueryResult, ...]:
    """Localizes the plan's queries, one after the other."""
    results: list[QueryResult] = []
    poses = {frame.name: frame for frame in plan.references}
    progress("localizing", 0, len(plan.queries))
    for query in plan.queries:
        results.append(localize_query(client, SCENE, query, options, poses))
        progress("localizing", len(results), len(plan.queries))
    return tuple(results)


def evaluation_of(plan: Plan, options: EvaluationOptions, results: tuple[QueryResult, ...]) -> Evaluation:
    """Results and their plan."""
    radius = trajectory_radius(np.array([f.world_from_camera.translation for f in plan.references]))
    return Evaluation(plan.dataset, options, len(plan.references), radius, results)


def localize_query(
    client: Client, scene: str, query: PlannedQuery, options: EvaluationOptions, references: Mapping[str, Frame]
) -> QueryResult:
    """Localizes one query.

    Args:
        client: of the server.
        scene: id of the scene.
        query: with its references; none: the server chooses k.
        options: variant, scale strategy and k.
        references: those of the scene, by name.

    Raises:
        MaplessError: the call failed.
    """
    frame = query.frame
    image = frame.image_path.read_bytes()
    start_s = time.perf_counter()
    answer = client.localize(
        image,
        frame.camera,
        scene,
        [reference.name for reference in query.references],
        variant=options.variant,
        scale_strategy=options.scale_strategy,
        reference_count=0 if query.references else options.k,
    )
    latency_ms = 1000 * (time.perf_counter() - start_s)
    return _result(frame, answer, query.references, latency_ms, references)


def _result(
    frame: Frame,
    answer: LocalizationResult | Rejected,
    given: Sequence[Frame],
    latency_ms: float,
    references: Mapping[str, Frame],
) -> QueryResult:
    diagnostics = answer.diagnostics
    uses = {parse_reference_name(use.name)[1]: use for use in diagnostics.references}
    used = list(given) or [references[name] for name in uses]
    distances = [
        float(np.linalg.norm(it.world_from_camera.translation - frame.world_from_camera.translation)) for it in used
    ]
    found = answer if isinstance(answer, LocalizationResult) else None
    errors = pose_error(frame.world_from_camera, found.world_from_camera) if found else (math.inf, math.inf)
    best = max(uses, key=lambda name: uses[name].inlier_count, default="") if found else ""
    return QueryResult(
        name=frame.name,
        references=tuple(it.name for it in used),
        translation_error=errors[0],
        rotation_error_deg=errors[1],
        reference_distance=float(np.median(distances)) if distances else math.inf,
        position_68=found.accuracy.position_68_m if found and found.accuracy else None,
        inlier_count=found.inlier_count if found else 0,
        match_count=found.match_count if found else 0,
        rejection="" if isinstance(answer, LocalizationResult) else answer.reason,
        message="" if isinstance(answer, LocalizationResult) else answer.message,
        latency_ms=latency_ms,
        stage_ms={stage: 1000 * seconds for stage, seconds in diagnostics.stage_s.items()},
        backend=diagnostics.backend,
        features=diagnostics.features,
        best_reference=best,
        pose=_numbers(found.world_from_camera) if found else None,
    )


def _numbers(pose: RigidTransform) -> tuple[float, ...]:
    q = pose.quaternion()
    return (*pose.translation.tolist(), q.x, q.y, q.z, q.w)
