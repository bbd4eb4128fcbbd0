"""Cost and answer of a query: one tier where that is enough, the better of two where it is not."""

import asyncio
import gc
import hashlib
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from support.images import encode, textured
from support.planted_engine import (
    DOUBTFUL_INLIERS,
    FEATURES,
    NEAR_ORIGIN,
    PIXELS,
    SCENE,
    SURE_INLIERS,
    Setting,
    caller,
    hint_of,
    is_outcome,
    localized,
    query_of,
    rejected,
)
from support.servers import CAMERA, PHOTO, StandInExtractor, pose

from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import CutReason, MissingEvidence, Photo, Result, Tier
from mapless_server.engine.search import SearchJob
from mapless_server.engine.stages import MAX_LISTINGS
from mapless_server.errors import InvalidArgument, NotFound, Unavailable
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.judge.judge import LEVELS, JudgeOptions
from mapless_server.method.rejection import Advice, Rejection, RejectionReason
from mapless_server.scenes import Narrowing, Sphere
from mapless_server.scenes.later import Pending
from mapless_server.scheduling import CostModel
from mapless_server.serve.assembly import engine_over
from mapless_server.store import NewReference, SelfCalibration, calibrations


class TestTiers:
    @pytest.mark.parametrize(
        "sure", [localized(SURE_INLIERS), rejected(RejectionReason.DEGENERATE_REFERENCES)], ids=["pose", "rejection"]
    )
    def test_a_trusted_answer_uses_one_tier(self, setting: Setting, sure: Answer) -> None:
        setting.replies["cheap"] = sure
        result = setting.localize()
        assert setting.asked == ["cheap"]
        assert not setting.extractors["strong"].seen
        assert is_outcome(result, sure)
        assert result.tier.extractor.name == "cheap"
        assert list(result.stage_seconds) == list(
            dict.fromkeys(["decode", "features", "correspond", *sure.stage_seconds])
        )

    @pytest.mark.parametrize(
        ("first", "second", "answered"),
        [
            (rejected(), localized(SURE_INLIERS), "strong"),
            (rejected(), rejected(RejectionReason.GATE), "strong"),
            (localized(DOUBTFUL_INLIERS), localized(SURE_INLIERS), "strong"),
            (localized(DOUBTFUL_INLIERS), rejected(), "cheap"),
        ],
    )
    def test_a_doubtful_answer_is_retried_and_the_better_one_given(
        self, setting: Setting, first: Answer, second: Answer, answered: str
    ) -> None:
        setting.replies = {"cheap": first, "strong": second}
        result = setting.localize()
        assert setting.asked == ["cheap", "strong"]
        assert result.tier.extractor.name == answered
        assert is_outcome(result, {"cheap": first, "strong": second}[answered])

    def test_a_scenes_own_quantiles_replace_the_usual_trust(self, setting: Setting) -> None:
        """In the judge and for doubt; unless the query ignores calibrations."""
        setting.replies = dict.fromkeys(("cheap", "strong"), localized(DOUBTFUL_INLIERS))
        quantiles = tuple(np.asarray(LEVELS) ** 0.1)
        kind = setting.tiers[0].kind
        claim = calibrations.claim_scene(setting.store.database, kind)
        assert claim is not None
        assert calibrations.add(setting.store, claim, SelfCalibration(kind, 1, 9, trust_quantiles=quantiles), 60.0)
        setting.localize()
        assert setting.asked == ["cheap"]
        setting.localize(is_generic=True)
        assert setting.asked == ["cheap", "cheap", "strong"]
        usual = JudgeOptions()
        assert setting.judges == [usual.with_trust(quantiles), usual, usual]

    def test_contradicting_poses_are_both_hypotheses(self, setting: Setting) -> None:
        near, far = localized(DOUBTFUL_INLIERS), localized(DOUBTFUL_INLIERS, at=pose(3.0))
        setting.replies = {"cheap": near, "strong": far}
        outcome = setting.localize().answer.outcome
        assert isinstance(outcome, Rejection)
        assert outcome.reason is RejectionReason.AMBIGUOUS
        assert outcome.message.startswith("two poses 3.00 m and 17 degrees apart explain the photograph")
        assert [it.inlier_count for it in outcome.hypotheses] == [DOUBTFUL_INLIERS] * 2

    def test_a_rejection_of_the_engine_has_a_hint(self, setting: Setting) -> None:
        """Where tiers disagree, a pose contradicts the prior, a tier fails, or there are no references."""
        near, far = localized(DOUBTFUL_INLIERS), localized(DOUBTFUL_INLIERS, at=pose(3.0))
        setting.replies = {"cheap": near, "strong": far}
        hint = hint_of(setting.localize())
        assert (hint.advice, hint.best_reference) == (Advice.TELL_PLACES_APART, "scenes/s/references/r1")
        setting.replies = {"cheap": far, "strong": far}
        assert hint_of(setting.localize(narrowing=NEAR_ORIGIN)).advice is Advice.CHECK_PRIOR
        setting.replies = {"cheap": rejected(), "strong": lambda *_: 1 / 0}  # type: ignore[dict-item]
        assert hint_of(setting.localize()).message
        elsewhere = Narrowing(Sphere(pose(900.0).translation, 0.5))
        assert hint_of(setting.localize(reference_ids=(), narrowing=elsewhere)).advice is Advice.CHECK_PRIOR

    def test_a_pose_outside_the_prior_is_doubtful_too(self, setting: Setting) -> None:
        setting.replies = {"cheap": localized(SURE_INLIERS, at=pose(3.0)), "strong": localized(SURE_INLIERS)}
        result = setting.localize(narrowing=NEAR_ORIGIN)
        assert isinstance(result.answer.outcome, Localization)
        assert setting.asked == ["cheap", "strong"]

    def test_each_tier_uses_its_own_features_on_one_photograph(self, setting: Setting) -> None:
        """The photograph is decoded once; the references are those of each tier, the same ones."""
        setting.replies = {"cheap": rejected(), "strong": rejected()}
        setting.localize()
        (first, first_references), (second, second_references) = setting.seen
        assert first.photograph is second.photograph
        assert len(setting.extractors["cheap"].seen) == len(setting.extractors["strong"].seen) == 1
        assert setting.extractors["cheap"].seen[0] is setting.extractors["strong"].seen[0]
        assert [it.key for it in first_references] == [it.key for it in second_references]

    @pytest.mark.parametrize("steps", ["long", "short"])
    def test_no_answer_is_lost_because_a_better_one_comes_too_late(self, setting: Setting, steps: str) -> None:
        """The stronger features are given up before the deadline, even in the middle of a step."""
        answered = threading.Event()

        def endless(_: View, __: Sequence[PosedView], check: Callable[[], None]) -> Answer:
            if steps == "long":
                assert answered.wait(20)
            while True:
                check()
                time.sleep(0.01)

        setting.replies = {"cheap": localized(DOUBTFUL_INLIERS), "strong": endless}
        result = setting.localize(deadline_s=0.8)
        answered.set()
        assert result.tier.extractor.name == "cheap"
        assert isinstance(result.answer.outcome, Localization)
        assert [(it.rung, it.outcome) for it in result.attempts][-1] == ("stronger", "unfinished")
        assert [it.is_chosen for it in result.attempts].index(True) == 0

    def test_no_answer_is_lost_because_a_better_one_fails(
        self, setting: Setting, caplog: pytest.LogCaptureFixture
    ) -> None:
        def failing(*_: object) -> Answer:
            raise RuntimeError("out of memory, say")

        setting.replies = {"cheap": localized(DOUBTFUL_INLIERS), "strong": failing}
        result = setting.localize()
        assert result.tier.extractor.name == "cheap"
        assert (result.attempts[-1].features, result.attempts[-1].outcome) == ("strong", "failed")
        assert "the attempt 'stronger' failed" in caplog.text
        assert "out of memory, say" in caplog.text

    def test_stronger_features_wait_where_calls_come_together(
        self, setting: Setting, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Each call costs more than there is room for beside the others, but its caller has the time."""
        monkeypatch.setattr(CostModel, "predict", lambda _, stage, kind, *__: 3.0 if "tier 1" in kind else 0.01)
        setting.replies = {"cheap": localized(DOUBTFUL_INLIERS), "strong": localized(SURE_INLIERS)}
        jobs = [setting.engine.query_job(query_of(("r0", "r1")), caller()) for _ in range(4)]

        async def all_at_once() -> list[Result]:
            return await asyncio.gather(*map(setting.engine.run, jobs))

        results = setting.loop.run_until_complete(all_at_once())
        assert [it.tier.extractor.name for it in results] == ["strong"] * 4

    def test_a_rejection_says_what_was_not_tried(self, setting: Setting) -> None:
        """A caller with a hint to check the intrinsics would, though asking again is what helps."""
        setting.replies = {"cheap": rejected(), "strong": rejected()}
        advice = hint_of(setting.localize()).message

        def unavailable(*_: object) -> Answer:
            raise RuntimeError("out of memory, say")

        setting.replies["strong"] = unavailable
        assert hint_of(setting.localize()).message == (
            f"{advice} Trying it with stronger features was not finished: asking again, when less is asked, may help."
        )

    def test_a_query_makes_the_features_it_needs_and_stores_them(self, setting: Setting) -> None:
        setting.replies = {"cheap": localized(DOUBTFUL_INLIERS), "strong": localized(SURE_INLIERS)}
        add_late(setting)
        missing = []
        for _ in range(2):
            result = setting.localize(reference_ids=("r0", "late"))
            assert result.tier.extractor.name == "strong"
            missing.append(result.missing)
        assert missing == [(MissingEvidence("features", "strong", 1, 1),), ()]
        assert times_seen(setting, "strong") == 1

    def test_features_there_is_no_time_for_are_made_after_the_call(
        self, setting: Setting, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        setting.replies = {"cheap": localized(DOUBTFUL_INLIERS), "strong": localized(SURE_INLIERS)}
        add_late(setting)
        monkeypatch.setattr("mapless_server.engine.search.MAKE_S", 0.0)
        result = setting.localize(reference_ids=("r0", "late"))
        assert (result.tier.extractor.name, result.attempts[-1].outcome) == ("cheap", "unfinished")
        assert [it.reason for it in result.cuts] == [CutReason.FEATURES_MISSING]
        assert result.missing == (MissingEvidence("features", "strong", 1, 0),)
        until_s = time.monotonic() + 20
        while setting.localize(reference_ids=("r0", "late")).tier.extractor.name != "strong":
            assert time.monotonic() < until_s
        assert times_seen(setting, "strong") == 1

    def test_an_attempt_is_made_with_the_references_that_have_features(
        self, setting: Setting, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        setting.replies = {"cheap": localized(DOUBTFUL_INLIERS), "strong": localized(SURE_INLIERS)}
        add_late(setting)
        monkeypatch.setattr("mapless_server.engine.search.MAKE_S", 0.0)
        result = setting.localize(reference_ids=(), reference_count=4)
        assert result.tier.extractor.name == "strong"
        assert {it.name[-2:] for it in result.references} == {"r0", "r1", "r2"}
        assert result.missing == (MissingEvidence("features", "strong", 1, 0),)

    @pytest.mark.parametrize(
        ("pending", "answered"),
        [
            (Pending("features", "strongest", 7), "none"),
            (Pending("matches", "strong (network)", 7), "strongest"),
        ],
    )
    def test_where_features_lack_later_attempts_take_bounded_time(
        self, setting: Setting, monkeypatch: pytest.MonkeyPatch, pending: Pending, answered: str
    ) -> None:
        def slow(*_: object) -> Answer:
            time.sleep(0.6)
            return rejected()

        many = Setting(setting.store, names=("cheap", "strong", "strongest"))
        many.replies = dict.fromkeys(many.names, rejected())
        many.localize()  # stores the features of the references
        many.replies |= {"strong": slow, "strongest": localized(SURE_INLIERS)}
        many.engine.references.pending = lambda _: (pending,)
        monkeypatch.setattr("mapless_server.engine.search.LACKING_S", 0.3)
        result = many.localize()
        many.close()
        ended = {(it.rung, it.features): it.outcome for it in result.attempts}
        assert ended["stronger", "strong"] == "too_few_matches", "it ended, though after the limit"
        assert result.missing == (MissingEvidence(pending.work, pending.name, 7),)
        if answered == "none":
            assert result.attempts[-1].outcome == "unfinished"
            assert {it.reason for it in result.cuts} == {CutReason.FEATURES_MISSING}
            assert "references still lack evidence" in hint_of(result).message
        else:
            assert (result.tier.extractor.name, result.cuts) == (answered, ())

    @pytest.mark.parametrize("error", [Unavailable("the store is away"), NotFound("the scene is gone", field="scene")])
    def test_a_doubtful_answer_is_given_without_the_store(
        self, setting: Setting, error: Exception, caplog: pytest.LogCaptureFixture
    ) -> None:
        def away(_: object) -> list[Pending]:
            raise error

        setting.replies = dict.fromkeys(("cheap", "strong"), localized(DOUBTFUL_INLIERS))
        setting.engine.references.pending = away
        result = setting.localize()
        assert isinstance(result.answer.outcome, Localization)
        assert (result.missing, caplog.text.count(str(error))) == ((), 1)

    def test_tiers_share_neither_names_nor_what_remembers_matches(self, setting: Setting) -> None:
        cheap, strong = setting.engine.tiers
        same_name = Tier(StandInExtractor("cheap"), strong.pipeline)
        same_matcher = Tier(strong.extractor, cheap.pipeline)
        for tiers in ([], [cheap, same_name], [cheap, same_matcher]):
            with pytest.raises(ValueError, match="each with an extractor and a matcher of its own"):
                engine_over(setting.store, tiers, EngineOptions())


class TestMemory:
    def test_a_group_photo_is_counted_with_its_group_only(
        self, setting: Setting, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        setting.replies["cheap"] = localized(SURE_INLIERS)
        run, sizes = setting.engine.queue.run, list[int]()

        def noted(job: SearchJob) -> Any:
            sizes.append(job.size_bytes)
            return run(job)

        monkeypatch.setattr(setting.engine.queue, "run", noted)
        setting.localize()
        setting.localize(is_part=True)
        assert sizes == [len(PHOTO), 0]


class TestPhotograph:
    def test_reaches_the_method_with_the_query_and_every_reference(self, setting: Setting) -> None:
        setting.replies["cheap"] = localized(SURE_INLIERS)
        setting.localize()
        ((query, references),) = setting.seen
        assert query.photograph is not None
        assert query.photograph.sha256 == hashlib.sha256(PHOTO).hexdigest()
        assert query.photograph.camera == CAMERA
        np.testing.assert_array_equal(query.photograph.read(), PIXELS)
        for i, reference in enumerate(references):
            assert reference.view.photograph is not None
            np.testing.assert_array_equal(reference.view.photograph.read(), textured(seed=i))

    def test_is_freed_with_the_answer(self, setting: Setting) -> None:
        """By no cycle that waits for the garbage collector: its point maps and pixels are 15 MB."""
        setting.replies["cheap"] = localized(SURE_INLIERS)
        gc.collect()
        gc.disable()
        try:
            setting.localize()
            freed = threading.Event()
            weakref.finalize(setting.seen.pop()[0], freed.set)
            assert freed.wait(10)
        finally:
            gc.enable()

    def test_one_deleted_during_the_network_is_no_candidate(self, setting: Setting) -> None:
        """The server chose it, so the caller must not get an error."""

        def look(_: View, references: Sequence[PosedView], __: Any) -> Answer:
            if len(setting.asked) == 1:
                setting.store.delete_reference(SCENE, references[0].name.rpartition("/")[2])
            for reference in references:
                assert reference.view.photograph is not None
                reference.view.photograph.read()
            return localized(SURE_INLIERS)

        setting.replies["cheap"] = look
        result = setting.localize(reference_ids=(), reference_count=3)
        assert setting.asked == ["cheap", "cheap"]
        assert len(result.references) == 2
        assert len(setting.extractors["cheap"].seen) == 1, "the photograph is described once"

    @pytest.mark.parametrize("tier", ["cheap", "strong"])
    def test_a_scene_that_is_being_emptied_costs_no_answer_at_hand(self, setting: Setting, tier: str) -> None:
        """Whatever the scene was listed for, it is listed again only so often."""

        def look(_: View, references: Sequence[PosedView], __: Any) -> Answer:
            (photograph,) = {it.view.photograph for it in references[:1]}
            assert photograph is not None
            setting.store.delete_reference(SCENE, references[0].name.rpartition("/")[2])
            photograph.read()
            raise AssertionError("it was deleted")

        setting.replies = {"cheap": localized(DOUBTFUL_INLIERS), "strong": localized(SURE_INLIERS)} | {tier: look}
        if tier == "cheap":
            with pytest.raises(Unavailable) as caught:
                setting.localize(reference_ids=())
            assert caught.value.reason == "SCENE_CHANGED"
        else:
            result = setting.localize(reference_ids=())
            assert result.tier.extractor.name == "cheap"
            assert result.attempts[-1].outcome == "failed"
        assert setting.asked.count(tier) == MAX_LISTINGS


class TestDescribingReferences:
    """A store that was filled under other features: the first call that needs a reference describes it."""

    STEP_S = 0.2

    def test_teaches_the_queue_nothing_of_the_queries_to_come(
        self, setting: Setting, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        seen: list[tuple[str, float]] = []
        monkeypatch.setattr(
            CostModel, "observe", lambda _, stage, __, ___, seconds, ____: seen.append((stage, seconds))
        )
        setting.replies["cheap"] = localized(SURE_INLIERS)
        add_undescribed(setting, 2)
        extract = setting.extractors["cheap"].extract

        def slow(*arguments: Any) -> View:
            time.sleep(self.STEP_S)
            return extract(*arguments)

        monkeypatch.setattr(setting.extractors["cheap"], "extract", slow)
        query = query_of(("new0", "new1"))
        _, job = setting.run(query, caller())
        (seconds,) = (it for stage, it in seen if stage == "prepare")
        (took_s,) = (it.end_s - it.start_s for it in job.records if it.stage == "prepare")
        assert took_s - seconds >= 2 * self.STEP_S
        assert seconds >= self.STEP_S, "the photograph's own description is part of it"


def add_late(setting: Setting) -> None:
    """A reference that lacks the stronger features."""
    photo = encode(".png", textured(seed=7))
    (found,) = setting.describe([Photo(photo, CAMERA, "image")])
    new = NewReference("late", photo, CAMERA, pose(9.0), found.views, found.descriptors)
    setting.store.add_references(SCENE, [new])


def times_seen(setting: Setting, features: str) -> int:
    """How often such features were sought in that reference."""
    return sum(np.array_equal(it, textured(seed=7)) for it in setting.extractors[features].seen)


def add_undescribed(setting: Setting, count: int) -> None:
    """References new0, new1, ... with features that no tier has."""
    of_others = {"others": View(CAMERA, FEATURES)}
    photos = [encode(".png", textured(seed=20 + i)) for i in range(count)]
    added = [NewReference(f"new{i}", photo, CAMERA, pose(9.0 + i), of_others) for i, photo in enumerate(photos)]
    setting.store.add_references(SCENE, added)


class TestDescribe:
    def test_a_bad_image_names_its_field(self, setting: Setting) -> None:
        photos = [Photo(PHOTO, CAMERA, "requests[0].image"), Photo(PHOTO[:-50], CAMERA, "requests[1].image")]
        with pytest.raises(InvalidArgument) as caught:
            setting.describe(photos)
        assert caught.value.field == "requests[1].image"
