"""Many queries together, in three parts: each has the answer, or the exception, that it has alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from support.compare import assert_pose_close
from support.fake_network import FakeNetwork
from support.localizing import (
    MATCHER,
    ROUGH,
    SCENE,
    Cancelled,
    ChangedNetwork,
    answer_of,
    blinded,
    fewer_features,
    pipeline_of,
    pose_of,
    reason_of,
    weak_below,
)

from mapless_server.method.bundle.estimate import PoseStage
from mapless_server.method.coarse import Outcome, Request
from mapless_server.method.features.views import View
from mapless_server.method.judge.answer import Answer
from mapless_server.method.localize import localize, refine
from mapless_server.method.options import LocalizeOptions, StageContext, Variant
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pipeline import Coarse, Pipeline, Prepared, coarse_answer, prepare, reconstruct
from mapless_server.method.rejection import RejectionReason


def prepared_of(pipeline: Pipeline, options: LocalizeOptions | None = None, query: View | None = None) -> Prepared:
    context = StageContext()
    prepared = prepare(query or SCENE.query, SCENE.references, pipeline, options or LocalizeOptions(), context)
    assert isinstance(prepared, Prepared), prepared
    return prepared


def coarse_of(result: Coarse | Exception) -> Coarse:
    assert isinstance(result, Coarse), result
    return result


def same_bits(first: Answer, second: Answer) -> bool:
    one, other = pose_of(first), pose_of(second)
    return (
        one.world_from_camera.matrix().tobytes() == other.world_from_camera.matrix().tobytes()
        and (one.inlier_count, one.match_count) == (other.inlier_count, other.match_count)
        and list(first.stage_seconds) == list(second.stage_seconds)
    )


@pytest.mark.parametrize("weak_inliers", [0, 10**6])
@pytest.mark.parametrize("backend", ["geometric", "network"])
def test_queries_of_a_batch_have_the_answers_they_have_alone(backend: str, weak_inliers: int) -> None:
    """To the bit, where the backend itself gives the same bits; with their own options."""
    pipeline = pipeline_of(backend, options=None if backend == "geometric" else ROUGH)
    doubt = weak_below(weak_inliers)
    queries = [fewer_features(seed) for seed in range(3)] if backend == "geometric" else [SCENE.query] * 3
    choices = [LocalizeOptions(variant) for variant in (Variant.BEST, Variant.FULL)]
    options = [choices[i % 2] for i in range(3)]
    batch = [prepared_of(pipeline, o, q) for o, q in zip(options, queries, strict=True)]
    assert len({prepared.bucket for prepared in batch}) == 1
    parts = [coarse_of(result) for result in reconstruct(batch)]
    assert len({part.prepared.context.stage_seconds["coarse"] for part in parts}) == 1
    for part, option, query in zip(parts, options, queries, strict=True):
        assert same_bits(refine(part, doubt), answer_of(pipeline, option, query, doubt))


def test_a_coarse_answer_has_the_initial_pose_and_its_stage() -> None:
    for backend in ("geometric", "network"):
        offset = np.full(3, 1e5)
        far = [replace(r, world_from_camera=r.world_from_camera.shifted(offset)) for r in SCENE.references]
        pipeline = replace(pipeline_of(backend, options=ROUGH), matcher=Matcher())  # the structure is another one
        prepared = prepare(SCENE.query, far, pipeline, LocalizeOptions(), StageContext())
        assert isinstance(prepared, Prepared)
        answer = coarse_answer(coarse_of(reconstruct([prepared])[0]))
        assert answer is not None
        expected = localize(SCENE.query, far, pipeline, LocalizeOptions(Variant.COARSE))
        found, asked_for = pose_of(answer), pose_of(expected)
        assert (found.pose_stage, asked_for.pose_stage) == (PoseStage.COARSE, PoseStage.INITIAL)
        assert found.covariance is None
        assert found.world_from_camera.matrix().tobytes() == asked_for.world_from_camera.matrix().tobytes()
        assert answer.scale is not None
        assert expected.scale is not None
        assert answer.scale.metres_per_unit == expected.scale.metres_per_unit
        assert answer.reference_match_counts == expected.reference_match_counts
        assert list(answer.stage_seconds)[:2] == ["correspond", "coarse"]


def test_without_an_initial_pose_there_is_no_coarse_answer() -> None:
    """But a refined one, from the matches with the references themselves, where the variant has it."""
    pipeline = Pipeline(ChangedNetwork(FakeNetwork(SCENE), blinded), MATCHER)
    hopeful, settled = reconstruct(
        [prepared_of(pipeline, LocalizeOptions(variant)) for variant in (Variant.BEST, Variant.FULL)]
    )
    assert coarse_answer(coarse_of(hopeful)) is None
    found = pose_of(refine(coarse_of(hopeful))).world_from_camera
    assert_pose_close(found, SCENE.world_from_query, metres=0.02, degrees=0.2)
    assert reason_of(refine(coarse_of(settled))) is RejectionReason.SCALE_UNRELIABLE


def test_one_querys_exception_does_not_fail_the_others() -> None:
    """Its check raises before or after the backend, or the backend, which is not called after a failed check."""
    network = FakeNetwork(SCENE)
    fault, asked = MemoryError("of this query"), []

    class Faulty(ChangedNetwork):
        def reconstruct_many(self, requests: Sequence[Request]) -> list[Outcome | Exception]:
            asked.append(len(requests))
            outcomes = super().reconstruct_many(requests)
            return [fault, *outcomes[1:]]

    pipeline = Pipeline(Faulty(network, lambda it: it), MATCHER)
    gone = Cancelled()
    later_calls: list[int] = []

    def already() -> None:
        raise gone

    def later() -> None:
        later_calls.append(len(later_calls))
        if len(later_calls) > 1:
            raise gone

    checks = [already, lambda: None, later, lambda: None]
    batch = [replace(prepared_of(pipeline), context=StageContext(check)) for check in checks]
    first, second, third, fourth = reconstruct(batch)
    assert first is gone
    assert second is fault
    assert third is gone
    assert pose_of(refine(coarse_of(fourth))).pose_stage is PoseStage.REFINED
    assert asked == [3]


def test_an_exception_of_the_whole_batch_is_raised_unchanged() -> None:
    fault = RuntimeError("CUDA error: an illegal memory access was encountered")

    class Broken(ChangedNetwork):
        def reconstruct_many(self, requests: Sequence[Request]) -> list[Outcome | Exception]:
            raise fault

    pipeline = Pipeline(Broken(FakeNetwork(SCENE), lambda it: it), MATCHER)
    with pytest.raises(RuntimeError) as raised:
        reconstruct([prepared_of(pipeline), prepared_of(pipeline)])
    assert raised.value is fault
    with pytest.raises(RuntimeError) as raised:
        answer_of(pipeline)
    assert raised.value is fault


def test_a_batch_has_one_reconstructor() -> None:
    with pytest.raises(ValueError, match="one reconstructor"):
        reconstruct([prepared_of(pipeline_of(backend)) for backend in ("geometric", "network")])
    assert reconstruct([]) == []
