"""Attempts after a doubtful answer: each a step of the queue, counted, and one row of a table."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.planted_engine import (
    DOUBTFUL_INLIERS,
    SURE_INLIERS,
    Setting,
    caller,
    localized,
    query_of,
    rejected,
)
from support.servers import CAMERA, pose

from mapless_server.engine.query import CutReason, LadderCut, Result, Tried
from mapless_server.engine.search import Material, Search
from mapless_server.engine.verdicts import Verdicts
from mapless_server.method import ladder
from mapless_server.method.bundle.estimate import Support
from mapless_server.method.bundle.priors import PositionPrior, Priors
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.judge.decide import decide
from mapless_server.method.judge.hypothesis import Attempt, Doubt, Failed, Solver
from mapless_server.method.ladder import Rung
from mapless_server.method.options import DoubtOptions
from mapless_server.method.rejection import Advice, Hint, Rejection, RejectionReason
from mapless_server.scenes import Narrowing
from mapless_server.scheduling import Flow, failing
from mapless_server.scheduling.failing import FAILURES
from mapless_server.store import SceneAttributes, SceneState


def ended(result: Result) -> list[tuple[str, str, bool]]:
    return [(it.rung, it.outcome, it.is_chosen) for it in result.attempts]


def test_a_sure_answer_is_one_attempt(setting: Setting) -> None:
    setting.replies["cheap"] = localized(SURE_INLIERS)
    assert ended(setting.localize()) == [("as it is", "localized", True)]


def test_each_attempt_says_how_it_ended(setting: Setting) -> None:
    setting.replies = {"cheap": rejected(), "strong": localized(SURE_INLIERS)}
    result = setting.localize()
    expected = [
        ("as it is", "too_few_matches", False),
        ("wide", "low_overlap", False),
        ("lines", "low_overlap", False),
        ("stronger", "localized", True),
    ]
    assert ended(result) == expected
    assert [it.features for it in result.attempts] == ["cheap"] * 3 + ["strong"]
    assert all(it.seconds > 0 and it.processor_s >= 0 for it in result.attempts)


@pytest.mark.parametrize("seen", [2, 3], ids=["one is outside", "all are near"])
def test_after_a_search_elsewhere_stronger_features_are_tried(setting: Setting, seen: int) -> None:
    """Whether or not the search elsewhere was skipped, since it would have had the same references."""
    setting.replies = dict.fromkeys(("cheap", "strong"), rejected())
    priors = Priors(position=PositionPrior(pose(0.0).translation, (0.1 if seen == 2 else 4.0) ** 2 * np.eye(3)))
    narrowing = replace(Narrowing.of(priors), margin_m=0.01)
    result = setting.localize(reference_ids=(), reference_count=3, priors=priors, narrowing=narrowing)
    by_rung = {it.rung: it.outcome for it in result.attempts}
    assert (by_rung["elsewhere"] == "skipped") is (seen == 3)
    assert by_rung["stronger"] == "too_few_matches"


def test_after_a_skipped_rung_those_of_the_basis_before_are_tried(
    setting: Setting, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the queue had no time for them before, or their order is another."""
    elsewhere = next(it for it in ladder.RUNGS if it.name == "elsewhere")
    monkeypatch.setattr(ladder, "RUNGS", (elsewhere, *(it for it in ladder.RUNGS if it is not elsewhere)))
    setting.replies = dict.fromkeys(("cheap", "strong"), rejected())
    priors = Priors(position=PositionPrior(pose(0.0).translation, 16 * np.eye(3)))
    narrowing = replace(Narrowing.of(priors), margin_m=0.01)
    result = setting.localize(reference_ids=(), reference_count=3, priors=priors, narrowing=narrowing)
    assert [(it.rung, it.outcome) for it in result.attempts][:3] == [
        ("as it is", "too_few_matches"), ("elsewhere", "skipped"), ("wide", "low_overlap")
    ]  # fmt: skip


def test_a_rung_without_memory_leaves_the_best_answer(setting: Setting) -> None:
    def full(*_: object) -> Answer:
        raise MemoryError

    setting.replies = {"cheap": localized(DOUBTFUL_INLIERS), "strong": full}
    result = setting.localize()
    assert isinstance(result.answer.outcome, Localization)
    assert ended(result) == [("as it is", "localized", True), ("stronger", "out_of_memory", False)]


def test_better_answers_are_sent_before_the_last(setting: Setting) -> None:
    setting.replies = {"cheap": localized(DOUBTFUL_INLIERS), "strong": localized(SURE_INLIERS)}
    sent: list[Result] = []

    async def run() -> Result:
        job = setting.engine.query_job(query_of(("r0", "r1")), caller(), on_better=sent.append)
        return await setting.engine.run(job)

    final = setting.loop.run_until_complete(run())
    assert [it.tier.features for it in [*sent, final]] == ["cheap", "strong"]
    assert [len(it.attempts) for it in [*sent, final]] == [1, 2]


@pytest.mark.parametrize(("is_cut", "asked"), [(True, ["cheap"]), (False, ["cheap", "strong"])])
def test_a_cut_ladder_has_its_cheap_rungs(setting: Setting, is_cut: bool, asked: list[str]) -> None:
    """The result says which rung was left out, and the same cut made again gives the same result."""
    setting.replies = {"cheap": rejected(), "strong": rejected()}
    results = list[Result]()
    for is_cut_at in (lambda *_: is_cut, lambda *it: it in [(cut.rung, cut.features) for cut in results[0].cuts]):
        setting.asked.clear()
        job = setting.engine.query_job(query_of(("r0", "r1")), caller())
        job.step = replace(job.step, payload=replace(job.step.payload, is_cut_at=is_cut_at))
        results.append(setting.loop.run_until_complete(setting.engine.run(job)))
        assert [*dict.fromkeys(setting.asked)] == asked
    first, second = results
    assert first.cuts == ((LadderCut("stronger", "strong", CutReason.CALLER_FAILS),) if is_cut else ())
    assert second.cuts == first.cuts
    assert ended(second) == ended(first)


def test_a_caller_that_fails_beside_others_gets_a_cut_ladder(setting: Setting, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only while others ask, and until one of its photographs is localized."""
    monkeypatch.setattr(failing, "LATELY_S", 60.0)
    setting.replies = {"cheap": rejected(), "strong": rejected()}

    def cuts(name: str = "lost") -> list[CutReason]:
        asking = replace(caller(), flow=Flow("t", name))
        result = setting.run(query_of(("r0", "r1")), asking)[0]
        setting.engine.answered(asking, isinstance(result.answer.outcome, Localization))
        return [it.reason for it in result.cuts]

    assert [cuts() for _ in range(FAILURES)] == [[]] * FAILURES
    cuts("other")
    assert cuts() == [CutReason.CALLER_FAILS]
    setting.replies = {"cheap": localized(SURE_INLIERS)}
    cuts()
    setting.replies = {"cheap": rejected(), "strong": rejected()}
    cuts("other")
    assert cuts() == []


def test_a_further_attempt_is_one_row(setting: Setting, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rung that takes epipolar lines, first of all, whenever a pose has little trust."""
    again = Rung(
        "again",
        "the solver",
        Doubt.LOW_TRUST,
        "nothing",
        "structure and pose",
        "again",
        lambda before, _: before.but(solver=Solver.LINES),
        lambda *_: True,
    )
    monkeypatch.setattr(ladder, "RUNGS", (again, *ladder.RUNGS))
    setting.replies = {"cheap": localized(DOUBTFUL_INLIERS), "strong": localized(SURE_INLIERS)}
    result = setting.localize()
    rungs: Sequence[str] = [it.rung for it in result.attempts]
    assert rungs == ["as it is", "again", "stronger"]
    assert again.change(Attempt(), ladder.Situation()) != Attempt()


@pytest.mark.parametrize("is_part", [True, False])
def test_a_photograph_of_a_group_keeps_the_matches_it_has(setting: Setting, is_part: bool) -> None:
    """Its own rejection is the one that says most; its rig is posed by the matches of whatever attempt has some."""
    unused: Any = SimpleNamespace(features=(), photograph=None, camera=CAMERA)
    none: Any = None
    support = Support(unused, (), none, SimpleNamespace(__len__=lambda: 3), np.zeros(3))  # type: ignore[arg-type]
    cause = Rejection(RejectionReason.LOW_OVERLAP, "planted", Hint("", Advice.ADD_REFERENCES, "planted"))
    attempts = Attempt(), Attempt(solver=Solver.LINES)
    answers = replace(rejected(), support=support), Answer(cause)
    found = tuple(Failed(it, answer, Doubt.STARVED) for it, answer in zip(attempts, answers, strict=True))
    query = replace(query_of(("r0", "r1")), is_part=is_part)
    begun: Search = setting.engine.query_job(query, caller()).step.payload
    material = Material(Attempt(), begun.views, unused, (), SceneState(1, 0, SceneAttributes), SceneAttributes())
    verdict = decide(found, Priors())
    search = replace(begun, found=found, materials=(material,) * 2, tried=attempts, verdict=verdict)
    search = replace(search, attempts=tuple(Tried(str(i), "", "", 0.0, 0.0) for i in range(2)))
    answer = Verdicts(setting.tiers, DoubtOptions()).answer(search).answer
    assert answer.outcome == cause
    assert answer.support is (support if is_part else None)
