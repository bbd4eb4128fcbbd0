"""The evaluation's split, figures and reports, on planted results."""

import io
import json
import math
from dataclasses import asdict, replace
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from support.evaluations import evaluation, query_result

from bench.report import BenchResult, BenchScene, Figures, Latency, as_json, markdown, met
from mapless import IntrinsicsCheck, PendingWork
from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.method.bundle.estimate import USUAL_GAP, Accuracy
from mapless_server.scenes.calibration.fit import FitOptions, LeftOut
from mapless_server.services.messages.radii import Conditions
from mapless_tools.charts import INK, figure_of, inline_svg, new_axes, plot, use_logarithms
from mapless_tools.child import Memory
from mapless_tools.evaluate import run
from mapless_tools.evaluate.calibrate import fit_calibration
from mapless_tools.evaluate.metrics import QueryResult, pose_error, quantile, summarize
from mapless_tools.evaluate.plan import EvaluationOptions, split_frames
from mapless_tools.evaluate.report import print_report, to_json
from mapless_tools.evaluate.run import Evaluation
from mapless_tools.usage import UsageError


def result(translation: float, rotation_deg: float = 0.01, latency_ms: float = 100.0) -> QueryResult:
    own = {"reference_distance": 2.0, "latency_ms": latency_ms, "stage_ms": {"decode": 10.0, "pnp": 30.0}}
    return query_result("q", translation, rotation_deg, (100, 200), "2 of [8] matches", **own)


MISSED = result(math.inf)


def test_waiting_for_features_ends_where_none_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    class Stands:
        looks = iter([3, 2, *[2] * 1000])

        def get_scene(self, scene: str) -> SimpleNamespace:
            return SimpleNamespace(pending_work=[PendingWork("features", "strong", next(self.looks))])

    monkeypatch.setattr(run, "_LOOK_S", 0.01)
    monkeypatch.setattr(run, "LONGEST_STANDSTILL_S", 0.1)
    client: Any = Stands()
    with pytest.raises(TimeoutError, match=r"scene s: the server has found no further features .*, 2 references lack"):
        run.await_features(client, "s")


class TestSplit:
    def test_small_ones_are_as_derived_by_hand(self) -> None:
        """Half is rounded to even; each frame is left out once, or some; without room for a margin there is none."""
        assert split_frames(range(10), EvaluationOptions(reference_count=3, query_count=2))[0] == (0, 4, 9)
        assert split_frames(range(11), EvaluationOptions()) == (tuple(range(11)), tuple(range(11)))
        assert split_frames(range(11), EvaluationOptions(query_count=3))[1] == (0, 5, 10)
        assert split_frames(range(5), EvaluationOptions(2)) == ((0, 4), (1, 2, 3))

    @given(frames=st.integers(2, 700), references=st.integers(2, 60), queries=st.integers(1, 80))
    def test_gives_existing_frames_and_no_query_among_references(
        self, frames: int, references: int, queries: int
    ) -> None:
        try:
            chosen, asked = split_frames(range(frames), EvaluationOptions(references, queries))
        except ValueError:
            margin = 3 if frames >= 8 else 0
            places = {round(x) for x in np.linspace(margin, frames - 1 - margin, queries)}
            assert references > frames or places <= {round(x) for x in np.linspace(0, frames - 1, references)}
            return
        assert len(chosen) == references
        assert 1 <= len(asked) <= queries
        assert not set(chosen) & set(asked)
        assert list(asked) == sorted(set(asked))

    @pytest.mark.parametrize(
        ("frames", "options", "words"),
        [
            (10, EvaluationOptions(11), "11 references"),
            (2, EvaluationOptions(), "at least 3"),
            (6, EvaluationOptions(6), "no frame is left"),
            (20, EvaluationOptions(20), "no frame is left"),
        ],
    )
    def test_refuses_what_cannot_be_split(self, frames: int, options: EvaluationOptions, words: str) -> None:
        with pytest.raises(ValueError, match=words):
            split_frames(range(frames), options)


class TestMetrics:
    def test_pose_error_is_of_the_camera_centre_and_the_orientation(self) -> None:
        true = RigidTransform(rotation_from_vector([0.3, -0.2, 0.1]), np.array([1.0, 2.0, 3.0]))
        turn = rotation_from_vector([0.0, math.radians(2.0), 0.0])
        answered = RigidTransform(true.rotation @ turn, true.translation + np.array([0.03, 0.0, 0.04]))
        assert pose_error(true, answered) == pytest.approx((0.05, 2.0))
        assert pose_error(true, true) == pytest.approx((0.0, 0.0), abs=1e-9)

    def test_medians_and_recall_of_planted_errors(self) -> None:
        summary = summarize([result(t, r) for t, r in [(0.004, 0.5), (0.03, 1.5), (0.05, 5.0), (0.2, 1.0), (0.3, 0.1)]])
        assert summary.median_translation == pytest.approx(0.05)
        assert summary.median_rotation_deg == pytest.approx(1.0)
        assert summary.p90_translation == pytest.approx(0.26)
        assert summary.recall == {"1cm_1deg": 0.2, "5cm_5deg": 0.6, "25cm_2deg": 0.6}
        assert summary.median_relative == pytest.approx(0.025)

    def test_a_rejection_counts_as_infinitely_wrong(self) -> None:
        summary = summarize([result(0.01), result(0.02), MISSED])
        assert (summary.query_count, summary.localized_count) == (3, 2)
        assert summary.median_translation == pytest.approx(0.02)
        assert math.isinf(summary.p90_translation)
        assert summary.recall["25cm_2deg"] == pytest.approx(2 / 3)
        assert summary.rejections == {"LOW_OVERLAP": 1}
        assert math.isinf(summarize([result(0.01), MISSED]).median_translation)

    def test_rejecting_never_improves_a_figure(self) -> None:
        bad = summarize([result(0.01), result(0.02), result(9.0, 90.0)])
        rejected = summarize([result(0.01), result(0.02), MISSED])
        assert rejected.median_translation >= bad.median_translation
        assert rejected.p90_translation >= bad.p90_translation
        assert all(rejected.recall[name] <= bad.recall[name] for name in bad.recall)

    def test_share_of_claimed_radii_that_held(self) -> None:
        assert summarize([result(0.005), result(0.02), MISSED]).claim_held == 0.5
        assert summarize([MISSED]).claim_held is None

    @given(st.lists(st.floats(0, 1e6), min_size=1, max_size=50), st.sampled_from([0.5, 0.9, 0.95]))
    def test_quantile_is_numpys_on_finite_values(self, values: list[float], share: float) -> None:
        assert quantile(values, share) == pytest.approx(float(np.quantile(values, share)))

    @pytest.mark.parametrize("missed", [1, 2, 4, 5])
    def test_quantile_is_never_nan(self, missed: int) -> None:
        values = [1.0] * (5 - missed) + [math.inf] * missed
        assert not any(math.isnan(quantile(values, share)) for share in (0.5, 0.9, 0.95))


class TestReport:
    KEYS = (
        "queries localized median_translation_m median_rotation_deg p90_translation_m recall latency_ms variant backend"
    )

    def test_json_has_the_promised_fields(self) -> None:
        content = to_json(evaluation(result(0.01), result(0.02), references=30))
        assert set(self.KEYS.split()) <= set(content)
        assert set(content["recall"]) == {"5cm_5deg", "1cm_1deg", "25cm_2deg"}
        assert {"p50", "p95"} <= set(content["latency_ms"])
        assert content["median_translation_m"] == pytest.approx(0.015)
        assert content["per_query"][0]["translation_m"] == 0.01
        assert content["ground_truth"] == "survey"

    def test_json_has_each_photographs_claims_and_costs(self) -> None:
        check = IntrinsicsCheck("K1", 0.0, 0.2, 0.01, 0.02, conflict=True, used=False)
        costly = replace(result(0.015), trust=0.9, processor_ms=250.0)
        accused = replace(MISSED, intrinsics_checks=(check,), processor_ms=4000.0)
        content = to_json(evaluation(costly, accused))
        right, lost = content["per_query"]
        assert (right["claimed_68_m"], right["claimed_95_m"]) == (0.01, 0.02)
        assert (right["claimed_68_deg"], right["claimed_95_deg"]) == (0.1, 0.2)
        assert (right["calibration"], right["trust"], right["processor_ms"]) == ("GENERIC", 0.9, 250.0)
        assert (lost["claimed_95_m"], lost["trust"]) == (None, None)
        assert lost["intrinsics_checks"] == [asdict(check)]
        assert (content["claimed_68_held"], content["claimed_95_held"]) == (0.0, 1.0)
        assert content["processor_ms"] == {"mean": 2125.0, "localized": 250.0, "rejected": 4000.0}

    def test_features_are_those_of_every_answer(self) -> None:
        """Where stronger features answered some queries, and their stages are one sum for people."""
        stages = {"decode": 10.0, "pnp": 20.0, "aliked-n16-1024px/coarse": 50.0, "aliked-n16-1024px/pnp": 20.0}
        stronger = replace(result(0.01), features="aliked-n16-1024px", stage_ms=stages)
        mixed = evaluation(stronger, *[replace(result(0.01), stage_ms={})] * 2)
        content = to_json(mixed)
        assert content["features"] == {"sift": 2, "aliked-n16-1024px": 1}
        assert [query["features"] for query in content["per_query"]] == ["aliked-n16-1024px", "sift", "sift"]
        text = printed(mixed)
        assert "geometric, sift 2, aliked-n16-1024px 1;" in text
        assert "decode 10 %, pnp 20 %, aliked 70 % " in text
        assert to_json(evaluation(result(0.01)))["features"] == "sift"

    def test_infinite_is_null(self) -> None:
        content = to_json(evaluation(MISSED, MISSED))
        json.dumps(content, allow_nan=False)
        assert content["median_translation_m"] is None
        assert content["claimed_68_held"] is None
        assert content["per_query"][0]["rejection"] == {"reason": "LOW_OVERLAP", "message": "2 of [8] matches"}

    def test_an_arbitrary_unit_is_never_called_a_metre(self) -> None:
        content = to_json(evaluation(result(0.02), metric=False))
        assert content["median_translation_m"] is None
        assert set(content["recall"].values()) == {None}
        assert "translation_m" not in content["per_query"][0]
        assert content["relative"]["median_translation_units"] == 0.02
        assert content["relative"]["median_translation_of_reference_radius"] == pytest.approx(0.005)

    def test_table_of_an_arbitrary_unit(self) -> None:
        text = printed(evaluation(result(0.02), metric=False))
        assert "0.02 units" in text
        assert " cm" not in text
        assert "recall" not in text.split("Medians")[0]
        assert "arbitrary" in text


def printed(measured: Evaluation) -> str:
    file = io.StringIO()
    print_report(measured, Console(file=file, width=200))
    return file.getvalue()


class TestBench:
    SCENE = BenchScene("kitchen", 5, Figures(1.0, 0.23, 2), Figures(0.87, 0.208, 37))

    def test_a_target_asks_for_errors_and_for_localized_queries(self) -> None:
        target = self.SCENE.target
        assert met(target, summarize([result(0.01), result(0.01), MISSED]))
        assert not met(target, summarize([result(0.01), MISSED]))
        assert not met(target, summarize([result(0.011), result(0.011)]))
        assert not met(target, summarize([result(0.01, 0.24), result(0.01, 0.24)]))
        everything = replace(target, localized=None)
        assert not met(everything, summarize([result(0.01), result(0.01), MISSED]))

    def test_report_is_a_table_for_people_and_json_for_programs(self) -> None:
        calls = (result(0.01, latency_ms=100.0), result(0.01, latency_ms=300.0))
        latency = Latency((900.0, 700.0), calls, calls, Memory(200.0, 300.0))
        measured = BenchResult(
            "CPU, 2 cores",
            [(self.SCENE, evaluation(*calls, references=5))],
            [evaluation(result(0.02), MISSED, metric=False)],
            latency,
            ["fountain-P11"],
            quick=False,
        )
        text = "\n".join(markdown(measured))
        assert "| kitchen | 5 | 2 of 2 | 1.00 cm / 0.010° | 1.00 cm / 0.230°, 2 of 40 | yes |" in text
        assert "| kitchen | 1 of 2 | infinite / infinite | infinite | infinite |" in text
        assert "median of 2 | 800 |" in text
        assert "peak 300 MiB" in text
        assert "fountain-P11" in text
        assert "Rejected in kitchen, leave one out: 1 LOW_OVERLAP." in text
        content = json.loads(json.dumps(as_json(measured), allow_nan=False))
        assert content["scenes"][0]["target_met"] is True
        assert content["latency"]["warm_p50_ms"] == 200.0


class TestCalibrate:
    def measured(self, count: int, times: float, features: str = "sift") -> list[tuple[Conditions, LeftOut]]:
        """Right answers whose errors are so many times what the model expects."""
        off, claimed = times * FitOptions().median_ratio, Accuracy(0.005, 0.01, 0.1, 0.2)
        one = LeftOut(0.005 * off, 0.1 * off, claimed, 0.5, USUAL_GAP, 50.0)
        return [(Conditions(features, "geometric", "BEST", "1"), one)] * count

    def test_the_features_of_most_answers_are_calibrated(self) -> None:
        found = fit_calibration([*self.measured(40, 3.0), *self.measured(15, 1.0, "aliked")])
        assert (found.calibration.features, found.calibration.query_count) == ("sift", 40)
        known = found.calibration  # equal radii do not tell factors from errors of the references
        assert math.hypot(known.position_factor_68, known.reference_noise_m / 0.005) == pytest.approx(3.0, rel=0.15)
        assert found.positions_held == found.rotations_held == 1.0

    @pytest.mark.parametrize(("count", "times", "words"), [(9, 1.0, "9 photographs are"), (40, 60.0, "too large for")])
    def test_few_or_inexplicable_answers_are_refused(self, count: int, times: float, words: str) -> None:
        with pytest.raises(UsageError, match=f"nothing is stored: .*{words}"):
            fit_calibration(self.measured(count, times))

    def test_without_answers_nothing_is_stored(self) -> None:
        with pytest.raises(UsageError, match="nothing is stored: 0 photographs"):
            fit_calibration([])


def test_a_failure_is_a_cross_and_breaks_the_curve() -> None:
    axes = new_axes("a < b", "query", "translation error, cm")
    plot(axes, "best & all", range(5), [1.0, 2.0, math.inf, 1.0, 1.0])
    curve, crosses = axes.lines
    assert np.isnan(np.asarray(curve.get_ydata(), float)).tolist() == [False, False, True, False, False]
    assert (np.asarray(crosses.get_xdata()).tolist(), crosses.get_marker()) == ([2.0], "x")
    svg = ElementTree.fromstring(inline_svg(figure_of(axes)))
    assert {"a < b", "query", "translation error, cm", "best & all"} <= set(svg.itertext())


def test_a_chart_has_the_colour_of_the_page_around_it() -> None:
    svg = inline_svg(figure_of(new_axes("title", "x", "y")))
    assert INK not in svg
    assert "currentColor" in svg
    assert svg == inline_svg(figure_of(new_axes("title", "x", "y"))), "the same chart is the same text"


def test_logarithmic_scales_have_plain_numbers() -> None:
    axes = new_axes("title", "x", "y")
    use_logarithms(axes.yaxis)
    plot(axes, "curve", [0, 1], [0.03, 40.0])
    texts = set(ElementTree.fromstring(inline_svg(figure_of(axes))).itertext())
    assert {"0.1", "1", "10", "0.05", "0.5", "20"} <= texts
