"""A slow network matches the photograph again with one reference after the other, as long as there is time."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.planted_engine import DOUBT, SURE_INLIERS, Setting, caller, localized, query_of, rejected
from support.servers import whole

from mapless_server.engine.search import SearchStep
from mapless_server.engine.stages import QueryStages
from mapless_server.method.features.views import Matches, View
from mapless_server.method.judge.hypothesis import Attempt
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pairs.pair import Matching
from mapless_server.method.pipeline import Pipeline
from mapless_server.scheduling import CostModel, Next


class OneMatch:
    """A pair matching that matches keypoint 0 with the number of its call."""

    name = "one match"

    def __init__(self, seconds: float = 0.0) -> None:
        self.seconds, self.calls = seconds, 0

    def match_one(self, first: View, second: View, pause: Callable[[], None] = lambda: None) -> Matches:
        time.sleep(self.seconds)
        self.calls += 1
        return np.array([[0, self.calls]], np.int32)


def rematched(step: SearchStep) -> SearchStep:
    """The first step of matching by the network, with nothing tried before."""
    attempt = Attempt(1, matching=Matching.STRONG)
    return replace(step, payload=replace(step.payload, rung="rematched", attempt=attempt))


class TestRematching:
    """The strong tier matches a doubtful photograph again, by a slow network, with one reference after another."""

    def pair_matching(self, setting: Setting, seconds: float = 0.0) -> OneMatch:
        planted = setting.engine.tiers[1].pipeline.matcher.pairs.pair_matching = OneMatch(seconds)
        found = lambda *_: localized(SURE_INLIERS) if planted.calls else rejected()  # noqa: E731
        setting.replies = {"cheap": rejected(), "strong": found}
        return planted

    @pytest.mark.parametrize("chooses", [False, True])
    def test_each_reference_is_a_step_of_its_own(self, setting: Setting, chooses: bool) -> None:
        planted = self.pair_matching(setting)
        result, job = setting.run(query_of(() if chooses else ("r0", "r1")), caller())
        assert planted.calls == 2
        assert [it.stage for it in job.records].count("prepare") == 1 + 1 + 1 + 2
        assert [it.rung for it in result.attempts if it.is_chosen] == ["rematched"]
        assert result.stage_seconds["strong/rematch"] >= 0
        assert result.tier.extractor.name == "strong"

    @pytest.mark.parametrize(("is_alone", "steps"), [(True, 1), (False, 2)])
    def test_alone_as_many_pairs_as_threads_are_a_step(self, setting: Setting, is_alone: bool, steps: int) -> None:
        planted = self.pair_matching(setting)
        tier = replace(setting.engine.tiers[1], pipeline=Pipeline(matcher=Matcher(threads=2, pair_matching=planted)))
        stages = QueryStages([setting.engine.tiers[0], tier], DOUBT, is_alone=lambda: is_alone)
        job = setting.engine.query_job(query_of(("r0", "r1")), caller())
        job.step = rematched(job.step)
        (chosen,) = stages.prepare([job])
        assert isinstance(chosen, Next)
        search = chosen.steps[0].payload
        for _ in range(steps):
            search = stages._rematched(search)
        assert search.material is not None
        assert not search.material.unmatched
        assert planted.calls == 2

    def test_the_method_gets_the_new_matches(self, setting: Setting) -> None:
        self.pair_matching(setting)
        got: list[Sequence[Matches]] = []
        usual = whole(lambda *_: rejected())

        def prepare(*arguments: Any) -> Any:
            got.append(arguments[5])
            return usual.prepare(*arguments)

        stages = QueryStages(setting.engine.tiers, DOUBT, replace(usual, prepare=prepare))
        job = setting.engine.query_job(query_of(("r0", "r1")), caller())
        job.step = rematched(job.step)
        steps = 0
        while job.step.stage == "prepare":
            (done,) = stages.prepare([job])
            assert isinstance(done, Next)
            job.step = done.steps[0]
            steps += 1
        assert steps == 3
        assert [it.tolist() for it in got[0]] == [[[0, 1]], [[0, 2]]]

    @pytest.mark.parametrize(("known_s", "calls"), [(None, 1), (100.0, 0)])
    def test_pairs_that_would_end_too_late_are_not_begun(
        self, setting: Setting, known_s: float | None, calls: int
    ) -> None:
        """The pose is then computed from the matches that there are."""
        planted = self.pair_matching(setting, seconds=1.0)
        setting.engine.tiers[1].pipeline.matcher.pair_s = known_s
        result = setting.localize(deadline_s=3.0)
        assert planted.calls == calls
        assert result.tier.extractor.name == "strong"

    @pytest.mark.parametrize(("deadline_s", "calls"), [(20.0, 0), (30.0, 2)])
    def test_where_only_the_pose_is_in_time_it_is_computed(
        self, setting: Setting, monkeypatch: pytest.MonkeyPatch, deadline_s: float, calls: int
    ) -> None:
        """From the matches at hand: the pair alone would be in time, the pose after it would not."""
        planted = self.pair_matching(setting)
        setting.engine.tiers[1].pipeline.matcher.pair_s = 8.0
        cost_s = {"prepare": 0.1, "coarse": 0.5, "refine": 9.0}
        monkeypatch.setattr(
            CostModel, "predict", lambda _, stage, kind, *__: 8.0 if kind.endswith("rematch") else cost_s[stage]
        )
        result = setting.localize(deadline_s)
        assert result.tier.extractor.name == "strong"
        assert planted.calls == calls
