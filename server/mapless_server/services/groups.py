"""LocalizeRig and LocalizeSequence: message to values, engine, values to message."""

from __future__ import annotations

from collections.abc import Sequence

from mapless.v1 import localization_service_pb2 as pb
from mapless_server.engine.groups import (
    MAX_FRAMES,
    MAX_RIG_IMAGES,
    MIN_FRAMES,
    GroupResult,
    localize_each,
)
from mapless_server.engine.interface import Engine
from mapless_server.engine.query import Query
from mapless_server.method.rejection import Rejection
from mapless_server.observability.metrics import LOCALIZED, Metrics
from mapless_server.rpc.call import Call

from .capture.recorder import Recorder
from .messages.groups import (
    poses_from_message,
    queries_from_message,
    rig_to_message,
    sequence_to_message,
    session_from_rig_from_message,
    session_poses_from_message,
)


async def answer_rig(
    request: pb.LocalizeRigRequest, call: Call, engine: Engine, metrics: Metrics, recorder: Recorder | None = None
) -> pb.LocalizeRigResponse:
    """Implements LocalizationService.LocalizeRig; a recorder captures the call."""
    bounds = (1, MAX_RIG_IMAGES)
    queries = queries_from_message(request, "images", bounds, call.principal.tenant, engine.options)
    rig_from_camera = poses_from_message(request.images, "images", "rig_from_camera")
    session_from_rig = session_from_rig_from_message(request)
    with engine.hold(queries, call.caller):
        group = await _localize_each(engine, queries, call, "images")
        outcome = await engine.pose_rig(group.results, rig_from_camera, call.caller)
    response = rig_to_message(outcome, group, queries, request, session_from_rig)
    _conclude(response, outcome, group, call, metrics)
    if recorder is not None:
        parts = list(zip(queries, group.results, strict=True))
        recorder.answered("LocalizeRig", request, response, call, parts, engine.tiers)
    return response


async def answer_sequence(
    request: pb.LocalizeSequenceRequest, call: Call, engine: Engine, metrics: Metrics, recorder: Recorder | None = None
) -> pb.LocalizeSequenceResponse:
    """Implements LocalizationService.LocalizeSequence; a recorder captures the call."""
    bounds = (MIN_FRAMES, MAX_FRAMES)
    queries = queries_from_message(request, "frames", bounds, call.principal.tenant, engine.options)
    axes, session_from_camera = session_poses_from_message(request)
    scale_is_free = request.estimate_session_scale
    with engine.hold(queries, call.caller):
        group = await _localize_each(engine, queries, call, "frames")
        outcome = await engine.pose_sequence(group.results, session_from_camera, scale_is_free, call.caller)
    response = sequence_to_message(outcome, group, queries, request, axes)
    _conclude(response, outcome, group, call, metrics)
    if recorder is not None:
        parts = list(zip(queries, group.results, strict=True))
        recorder.answered("LocalizeSequence", request, response, call, parts, engine.tiers)
    return response


async def _localize_each(engine: Engine, queries: Sequence[Query], call: Call, list_name: str) -> GroupResult:
    call.note(scene=queries[0].scene_key, images=len(queries))
    jobs = [engine.query_job(query, call.caller) for query in queries]
    try:
        return await localize_each(engine, jobs, call.caller, list_name)
    finally:
        for job in jobs:
            call.record(job.records)


def _conclude(
    response: pb.LocalizeRigResponse | pb.LocalizeSequenceResponse,
    outcome: object,
    group: GroupResult,
    call: Call,
    metrics: Metrics,
) -> None:
    """Completes the response, and reports it to the log and the metrics."""
    for report in response.images:
        report.diagnostics.request_id = call.request_id
    for result in group.results:
        metrics.stages(result.stage_seconds)
    alone = sum(not report.HasField("alone") for report in response.images)
    call.note(localized_alone=alone)
    if isinstance(outcome, Rejection):
        metrics.answered(outcome.reason.value)
        call.note(outcome=outcome.reason.value)
        return
    found = response.localization
    call.note(outcome="localized", inliers=found.inlier_count)
    metrics.answered(
        LOCALIZED,
        inlier_count=found.inlier_count,
        match_count=found.match_count,
        reprojection_error_px=found.reprojection_error_px,
        accuracy_radius_m=found.accuracy.position_68_m,
    )
