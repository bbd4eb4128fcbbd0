"""The attempts at a pose, in the diagnostics of an answer and in the metrics."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.servers import CAMERA, PHOTO, make_scene, pose, serving

from mapless import Attempt, Client, GroupRejected, PositionPrior, Priors
from mapless.groups import RigImage
from mapless_server.engine.query import Result, Tried

TRIED = (
    Tried("wide", "cheap", "too_few_matches", 0.25, 0.5),
    Tried("strong", "strong", "localized", 1.5, 2.0, is_chosen=True),
)
SEEN = (
    Attempt("wide", "cheap", "too_few_matches", 0.25, 0.5),
    Attempt("strong", "strong", "localized", 1.5, 2.0, chosen=True),
)


def test_an_answer_lists_its_attempts_and_each_counts_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rejected rig with soft priors is localized a second time, by references of the whole scene: that counts too."""
    near = Priors(position=PositionPrior(pose(0).translation, covariance_m2=4.0 * np.eye(3)))
    with serving(tmp_path) as server, Client(server.address) as client:
        computed = server.engine.run

        async def run(job: Any) -> Result:
            return replace(await computed(job), attempts=TRIED)

        monkeypatch.setattr(server.engine, "run", run)
        scene = make_scene(client, count=2)
        assert client.localize(PHOTO, CAMERA, scene).diagnostics.attempts == SEEN
        rig = client.localize_rig([RigImage(PHOTO, CAMERA, pose(i), priors=near) for i in range(2)], scene)
        assert isinstance(rig, GroupRejected)
        assert [it.diagnostics.attempts for it in rig.images] == [SEEN, SEEN]
        counts = [server.value("mapless_attempts_total", rung=it.rung, outcome=it.outcome) for it in TRIED]
        assert counts == [5, 5]
        assert server.value("mapless_attempts_total") == 10
