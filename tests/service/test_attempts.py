"""The attempts at a pose, in the diagnostics of an answer and in the metrics."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.servers import CAMERA, PHOTO, RunningServer, make_scene, pose, serving

from mapless import Attempt, Client, GroupRejected, PositionPrior, Priors
from mapless.groups import RigImage
from mapless_server.engine.query import Result, Tried

TRIED = (
    Tried("wide", "cheap", "too_few_matches", 0.25, 0.5),
    Tried("turned", "cheap", "out_of_memory", 0.125, 0.0625),
    Tried("strong", "strong", "localized", 1.5, 2.0, is_chosen=True),
)
SEEN = (
    Attempt("wide", "cheap", "too_few_matches", 0.25, 0.5),
    Attempt("turned", "cheap", "out_of_memory", 0.125, 0.0625),
    Attempt("strong", "strong", "localized", 1.5, 2.0, chosen=True),
)


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RunningServer]:
    """A server whose engine plants these attempts in its answers."""
    with serving(tmp_path) as running:
        computed = running.engine.run

        async def run(job: Any) -> Result:
            return replace(await computed(job), attempts=TRIED)

        monkeypatch.setattr(running.engine, "run", run)
        yield running


def counts(server: RunningServer) -> list[float]:
    return [server.value("mapless_attempts_total", rung=it.rung, outcome=it.outcome) for it in TRIED]


def test_an_answer_lists_its_attempts_and_each_counts_once(server: RunningServer) -> None:
    with Client(server.address) as client:
        scene = make_scene(client, count=2)
        answers = [client.localize(PHOTO, CAMERA, scene) for _ in range(2)]
    assert [it.diagnostics.attempts for it in answers] == [SEEN, SEEN]
    assert counts(server) == [2, 2, 2]
    assert server.value("mapless_attempts_total") == 6


def test_each_photograph_of_a_rig_has_its_attempts(server: RunningServer) -> None:
    with Client(server.address) as client:
        scene = make_scene(client, count=2)
        answer = client.localize_rig([RigImage(PHOTO, CAMERA, pose(i)) for i in range(2)], scene)
    assert [it.diagnostics.attempts for it in answer.images] == [SEEN, SEEN]
    assert counts(server) == [2, 2, 2]


def test_attempts_of_a_round_that_is_not_answered_count(server: RunningServer) -> None:
    """A rejected rig with soft priors is localized a second time, with references of the whole scene."""
    near = Priors(position=PositionPrior(pose(0).translation, covariance_m2=4.0 * np.eye(3)))
    with Client(server.address) as client:
        scene = make_scene(client, count=2)
        images = [RigImage(PHOTO, CAMERA, pose(i), priors=near) for i in range(2)]
        assert isinstance(client.localize_rig(images, scene), GroupRejected)
    assert counts(server) == [4, 4, 4]
