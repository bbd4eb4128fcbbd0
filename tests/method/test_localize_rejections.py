"""Each reason of rejection, planted; what is tried before a photograph is rejected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.compare import assert_pose_close
from support.fake_network import FakeNetwork, FakeNetworkOptions
from support.localizing import (
    MATCHER,
    SCENE,
    ChangedNetwork,
    answer_of,
    blinded,
    pipeline_of,
    pose_of,
    reason_of,
    weak_below,
    without_meaning,
)
from support.scenes import CAMERA, SceneOptions, make_scene, random_for

from mapless.geometry import RigidTransform
from mapless_server.method import solve
from mapless_server.method.coarse import Outcome, Request
from mapless_server.method.features.views import Features, Reconstruction, View
from mapless_server.method.localize import localize
from mapless_server.method.options import LocalizeOptions, ScaleStrategy, Variant
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pipeline import MIN_FEATURES, Pipeline
from mapless_server.method.pose import pnp
from mapless_server.method.rejection import RejectionReason


@pytest.mark.parametrize("backend", ["geometric", "network"])
@pytest.mark.parametrize("count", [0, 1])
def test_no_usable_references_is_the_reason(backend: str, count: int) -> None:
    answer = localize(SCENE.query, SCENE.references[:count], pipeline_of(backend), LocalizeOptions())
    assert reason_of(answer) is RejectionReason.NO_USABLE_REFERENCES
    assert answer.scale is None
    assert "adjust" not in answer.stage_seconds


@pytest.mark.parametrize("backend", ["geometric", "network"])
def test_degenerate_references_is_the_reason(backend: str) -> None:
    where = SCENE.references[0].world_from_camera.translation
    stacked = tuple(
        replace(r, key=f"{r.key}-stacked", world_from_camera=RigidTransform(r.world_from_camera.rotation, where))
        for r in SCENE.references
    )
    pipeline = pipeline_of(backend)
    if backend == "network":
        keys = replace(SCENE, references=stacked)
        pipeline = Pipeline(FakeNetwork(keys), Matcher())
    assert (
        reason_of(localize(SCENE.query, stacked, pipeline, LocalizeOptions())) is RejectionReason.DEGENERATE_REFERENCES
    )


@pytest.mark.parametrize("count", [0, MIN_FEATURES - 1])
def test_low_texture_is_the_reason(count: int) -> None:
    f = SCENE.query.features
    bare = View(CAMERA, Features(f.keypoints[:count], f.descriptors[:count], f.sizes_px[:count]))
    answer = answer_of(pipeline_of("geometric"), query=bare)
    assert reason_of(answer) is RejectionReason.LOW_TEXTURE
    assert not answer.stage_seconds


def test_low_overlap_is_the_reason() -> None:
    for seed in range(3):
        elsewhere = make_scene(random_for("elsewhere", seed), SceneOptions(point_count=400))
        answer = answer_of(pipeline_of("geometric"), query=elsewhere.query)
        assert reason_of(answer) is RejectionReason.LOW_OVERLAP
        assert list(answer.stage_seconds)[:3] == ["correspond", "coarse", "two_view"]


def test_scale_unreliable_is_the_reason() -> None:
    pipeline = Pipeline(ChangedNetwork(FakeNetwork(SCENE), blinded), MATCHER)
    answer = answer_of(pipeline, LocalizeOptions(Variant.FULL))
    assert reason_of(answer) is RejectionReason.SCALE_UNRELIABLE
    assert list(answer.stage_seconds) == ["correspond", "coarse", "scale"]


def test_too_few_matches_is_the_reason() -> None:
    answer = answer_of(pipeline_of("network"), query=without_meaning(SCENE.query))
    assert reason_of(answer) is RejectionReason.TOO_FEW_MATCHES
    assert answer.scale is not None


@pytest.mark.parametrize("seed", range(5))
def test_gate_is_the_reason(seed: int) -> None:
    """The paper's search matches anything near; with a wrong network and random descriptors that is rejected."""
    wrong = FakeNetwork(SCENE, seed, FakeNetworkOptions(pose_noise_m=0.5, pose_noise_deg=2.0))
    options = LocalizeOptions(Variant.FULL, ScaleStrategy.TRIANGULATION)
    answer = answer_of(Pipeline(wrong, MATCHER), options, without_meaning(SCENE.query))
    assert reason_of(answer) is RejectionReason.GATE


@pytest.mark.parametrize(("backend", "times"), [("network", 1), ("geometric", 2)])
def test_a_network_runs_once_for_a_query(backend: str, times: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline, asked = pipeline_of(backend), list[int]()
    kind = type(pipeline.reconstructor)
    reconstruct_many = kind.reconstruct_many

    def counted(self: Any, requests: Sequence[Request]) -> list[Outcome | Exception]:
        asked.append(len(requests))
        return reconstruct_many(self, requests)

    monkeypatch.setattr(kind, "reconstruct_many", counted)
    answer_of(pipeline, doubt=weak_below(10**6))
    assert len(asked) == times


def looking_back(reconstruction: Reconstruction) -> Reconstruction:
    """Right but for the query, which is turned around."""
    query = reconstruction.query
    turned = query.local_from_camera.compose(RigidTransform(np.diag([-1.0, 1.0, -1.0]), np.zeros(3)))
    return replace(reconstruction, query=replace(query, local_from_camera=turned))


def test_pnp_failed_is_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = Pipeline(ChangedNetwork(FakeNetwork(SCENE), looking_back), MATCHER)
    monkeypatch.setattr(pnp, "ransac", lambda *_: None)
    found = pose_of(answer_of(pipeline)).world_from_camera
    assert_pose_close(found, SCENE.world_from_query, metres=0.02, degrees=0.2)  # by two_view
    monkeypatch.setattr(solve, "solve_two_view", lambda *_: None)
    answer = answer_of(pipeline)
    assert reason_of(answer) is RejectionReason.PNP_FAILED
    assert list(answer.stage_seconds)[-2:] == ["pnp", "two_view"]
