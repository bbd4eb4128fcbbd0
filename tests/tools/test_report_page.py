"""Pages of reports show what became of photographs where it was, and text as text."""

import re
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from datetime import date, datetime, timedelta, timezone
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from support.html import Page
from typer.testing import CliRunner

from mapless import Reference, RigidTransform, Scene
from mapless.answers import Accuracy
from mapless.geometry import Camera, rotation_from_vector
from mapless.provenance import ADOPTED, Provenance, Voucher
from mapless.rejections import WORDS
from mapless.results import PlaceState
from mapless.scene_reports import PeriodCounts, PlaceReport, ReferenceSuggestion, RejectedPosition, SceneReport
from mapless_tools.cli.app import app
from mapless_tools.report.drawing import Seen, outcomes_figure, plan_axes, plan_svg, ring_radius
from mapless_tools.report.page import _shown, report_page
from mapless_tools.report.places import BAD, FAIR, GOOD, NONE, REASONS, Place, floor_of, floors_of, places_of

CAMERA = Camera(1800, 1350, 1500.0, 1500.0, 899.5, 674.5)
NOW = datetime(2026, 11, 21, tzinfo=timezone.utc)
TODAY = date(2026, 11, 30)
SCENE = Scene("hall", 1, 3, NOW, down_in_world=(0.0, 0.0, -1.0))
PLAN = np.array([[1.0, 0, 0], [0, 1.0, 0]])
STRANGE = "<b>入口&$x$ \N{ARABIC LETTER ALEF}"


def upright(x: float, y: float = 0.0, z: float = 1.5, turn: float = 0.0) -> RigidTransform:
    """A level camera that looks along +y, turned about the vertical, z."""
    level = RigidTransform.from_matrix([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]).rotation
    return RigidTransform(rotation_from_vector([0, 0, turn]) @ level, np.array([x, y, z]))


def reference(name: str, pose: RigidTransform) -> Reference:
    return Reference("hall", name, CAMERA, pose, "", 0, NOW)


def counts(localized: int, rejections: Mapping[str, int], weeks_ago: int = 0) -> PeriodCounts:
    last = TODAY - timedelta(days=7 * weeks_ago)
    share = 0.8 if localized else None
    return PeriodCounts(last - timedelta(days=6), last, localized, rejections, share)


def place(name: str, pose: RigidTransform, localized: int, rejections: Mapping[str, int]) -> PlaceReport:
    return PlaceReport(name, pose, (counts(localized, rejections),))


def report(*places: PlaceReport, suggestions: tuple[ReferenceSuggestion, ...] = ()) -> SceneReport:
    weeks = tuple(counts(0, {}, ago) for ago in (3, 2, 1))
    totals: dict[str, int] = {}
    for it in places:
        for reason, count in it.periods[0].rejections.items():
            totals[reason] = totals.get(reason, 0) + count
    last = counts(sum(it.periods[0].localized_count for it in places), totals)
    return SceneReport("hall", TODAY - timedelta(days=27), TODAY, (*weeks, last), places, 0, suggestions)


def suggestion(name: str, at: tuple[float, float, float]) -> ReferenceSuggestion:
    return ReferenceSuggestion(name, 4.0, at, (0.0, 1.0, 0.0), 0.0, f"4 photographs around {name} were rejected")


def drawn(places: Mapping[int, Place], suggestions: Mapping[int, ReferenceSuggestion] | None = None) -> Axes:
    most = max((it.rejected_count for it in places.values()), default=0)
    corners = np.array([-1.0, -1.0]), np.array([9.0, 9.0])
    return plan_axes(Seen("plan", PLAN, *corners, places, suggestions or {}, most, "m"))


def layer(axes: Axes, label: str) -> tuple[np.ndarray, list[str]]:
    """Positions (N, 2) and colours of the shapes with a label."""
    (found,) = (it for it in axes.collections if it.get_label() == label)
    return np.asarray(found.get_offsets()), [to_hex(it) for it in np.asarray(found.get_facecolor())]


class TestPlaces:
    @pytest.mark.parametrize(
        ("localized", "rejected", "colour"), [(9, 1, GOOD), (8, 2, FAIR), (5, 5, FAIR), (4, 6, BAD), (0, 0, NONE)]
    )
    def test_colour_is_by_share_localized(self, localized: int, rejected: int, colour: str) -> None:
        (found,) = places_of(report(place("a", upright(0), localized, {"GATE": rejected})), [])
        assert found.colour == colour

    def test_surveyed_references_without_photographs_are_places(self) -> None:
        accuracy, voucher = Accuracy(0.01, 0.02, 0.1, 0.2, False), (Voucher("a", 40),)
        adopted = Provenance(ADOPTED, accuracy, 0.5, voucher)
        others = [reference("a", upright(0)), reference("b", upright(1)), reference("c", upright(2))]
        others[2] = replace(others[2], provenance=adopted)
        found = places_of(report(place("a", upright(0), 2, {})), others)
        assert [(it.reference_id, it.photograph_count) for it in found] == [("a", 2), ("b", 0)]

    @pytest.mark.parametrize(("with_prior", "at"), [(2, (4, 3, 1)), (1, (0, 0, 1.5))])
    def test_rejections_are_where_half_of_the_priors_say(self, with_prior: int, at: tuple[float, ...]) -> None:
        where = RejectedPosition(with_prior, (4.0, 3.0, 1.0), None, 0.1)
        its = replace(place("a", upright(0), 0, {"GATE": 3}), rejected_position=where)
        assert places_of(report(its), [])[0].rejected_at == pytest.approx(at)

    def test_floors_are_apart_by_the_gaps_of_heights(self) -> None:
        heights = np.array([1.2, 4.6, 1.9, 1.5, 4.9, 4.4, 9.0])
        assert floors_of(heights) == [(1.2, 1.9), (4.4, 4.9)]
        assert [floor_of(it, floors_of(heights)) for it in (0.0, 3.0, 3.4, 9.0)] == [0, 0, 1, 1]
        assert floors_of(heights, is_metric=False) == [(1.2, 9.0)]
        assert floors_of(np.array([2.0])) == [(2.0, 2.0)]


class TestPlan:
    def test_rings_are_where_photographs_were_rejected(self) -> None:
        where = RejectedPosition(6, (5.0, 6.0, 1.0), None, 0.1)
        far = replace(place("far", upright(1), 0, {"GATE": 4, "AMBIGUOUS": 2}), rejected_position=where)
        found = places_of(report(far, place("near", upright(7, 8), 1, {"GATE": 1})), [])
        at, colours = layer(drawn(dict(enumerate(found))), "_rejections")
        np.testing.assert_allclose(at, [(5, 6), (5, 6), (7, 8)])
        assert colours == [REASONS[it] for it in ("GATE", "AMBIGUOUS", "GATE")]

    def test_places_are_at_their_references_and_point_ahead(self) -> None:
        (found,) = places_of(report(place("a", upright(3, 4, turn=-np.pi / 2), 9, {})), [])
        axes = drawn({0: found})
        at, colours = layer(axes, "_places")
        np.testing.assert_allclose(at, [(3, 4)])
        assert colours == [GOOD]
        (pins,) = (it for it in axes.collections if it.get_label() == "_places")
        outline = np.asarray(pins.get_paths()[0].vertices)
        tip = outline[np.argmax(np.linalg.norm(outline, axis=1))]
        np.testing.assert_allclose(tip / np.linalg.norm(tip), (1, 0), atol=1e-6)

    def test_a_suggestion_has_its_number_at_its_position(self) -> None:
        axes = drawn({}, {2: suggestion("a", (3.0, 5.0, 1.0))})
        (number,) = axes.texts
        assert (number.get_text(), getattr(number, "xy")) == ("2", (3.0, 5.0))  # noqa: B009 - of annotations alone

    def test_a_suggestion_covers_no_ring(self) -> None:
        (found,) = places_of(report(place("a", upright(4, 4), 0, {"GATE": 9})), [])
        axes = drawn({0: found}, {1: suggestion("b", (4.0, 5.0, 1.0))})
        (number,) = axes.texts
        at, ring = axes.transData.transform([(4, 5), (4, 4)])
        assert isinstance(axes.figure, Figure)
        dpi = axes.figure.dpi
        away = np.linalg.norm(at + np.asarray(number.get_position()) * dpi / 72 - ring) / dpi
        assert away >= ring_radius(9, 9) + 0.1

    def test_states_of_places_are_marked_at_them(self) -> None:
        its = replace(place("a", upright(3, 4), 9, {}), is_outdated=True, adopted_count=2, retired_count=1)
        (found,) = places_of(report(its), [])
        marks = {it.get_label(): np.asarray(it.get_xydata()) for it in drawn({0: found}).lines}
        assert marks.keys() == {"_adopted", "_retired", "_outdated"}
        for at in marks.values():
            np.testing.assert_allclose(at, [(3, 4)])

    def test_area_of_a_ring_grows_with_its_photographs(self) -> None:
        none, some, most = (ring_radius(count, 100) for count in (0, 50, 100))
        assert most**2 - some**2 == pytest.approx(some**2 - none**2)

    def test_each_place_says_what_became_of_its_photographs(self) -> None:
        (found,) = places_of(report(place(STRANGE, upright(3, 4), 9, {"GATE": 1})), [])
        seen = Seen("", PLAN, np.zeros(2), np.full(2, 9.0), {7: found}, {}, 1, "m")
        titles = re.findall(r'<a xlink:href="#place-7"[^>]*><title>(.*?)</title>', plan_svg(seen))
        assert set(titles) == {
            "&lt;b&gt;入口&amp;$x$ \N{ARABIC LETTER ALEF}: 9 of 10 photographs localized; rejected: GATE 1"
        }


def planted() -> SceneReport:
    """A place of any name that is outdated, and one with a suggestion on the floor above."""
    bad = place(STRANGE, upright(0), 2, {"GATE": 5, "NEW_REASON": 1})
    bad = replace(bad, is_outdated=True, state=PlaceState(0.25, 7, 0), adopted_count=1)
    above = place("above", upright(2, z=5.0), 0, {"LOW_OVERLAP": 3})
    nowhere = PlaceReport("", None, (counts(0, {"LOW_TEXTURE": 2}),))
    return report(bad, above, nowhere, suggestions=(suggestion(STRANGE, (0, 0, 1.5)), suggestion("above", (2, 0, 5))))


class TestPage:
    def test_it_is_whole_and_loads_nothing(self) -> None:
        references = [reference(f"r{i}", upright(i, z=1.5 if i < 5 else 5.0)) for i in range(9)]
        html = report_page(planted(), SCENE, references, omitted_count=3)
        page = Page(html)
        text = " ".join(" ".join(page.words).split())
        assert page.tags["b"] == page.tags["script"] == page.tags["link"] == 0
        for expected in (
            f"Places that need a new survey: {STRANGE} at (0.00, 0.00, 1.50)",
            f"4 photographs around {STRANGE} were rejected.",
            "13 photographs, 15 % of them localized",
            "Floor 1 of 2, from above: references at a height of 1.5 to 1.5 m",
            "Floor 2 of 2",
            "Seen along the scene's direction of gravity",
            "2 rejected photographs are not on the plan",
            "3 further references are not drawn",
            "1 rejected, NEW_REASON",
            "5 rejected, GATE: the evidence for a pose does not suffice",
            "GATE 5, LOW_OVERLAP 3, LOW_TEXTURE 2, NEW_REASON 1",
        ):
            assert expected in text
        links = [value for _, name, value in page.attributes if name in ("href", "xlink:href", "src")]
        assert links
        assert all(it.startswith("#") for it in links)

    @pytest.mark.parametrize("count", [0, 1])
    def test_a_scene_without_photographs_says_so(self, count: int) -> None:
        references = [reference("only", upright(0))][:count]
        html = report_page(report(), replace(SCENE, down_in_world=None), references)
        page = Page(html)
        text = " ".join(page.words)
        assert "no photographs counted yet" in text
        assert ("The scene has no references." in text) == (count == 0)
        assert page.tags["svg"] == (0 if count == 0 else 2)  # the plan, and what grey means

    def test_lengths_without_metres_are_in_units(self) -> None:
        arbitrary = replace(planted(), arbitrary_unit=True)
        text = " ".join(Page(report_page(arbitrary, replace(SCENE, arbitrary_unit=True), [])).words)
        assert "x, units" in text
        assert "Floor 1" not in text

    def test_without_gravity_it_names_the_direction(self) -> None:
        poses = [upright(0), RigidTransform(np.diag([1.0, -1, -1]) @ upright(0).rotation, np.array([4.0, 1, 0]))]
        places = [place(f"p{i}", it, 1, {}) for i, it in enumerate(poses)]
        html = report_page(report(*places), replace(SCENE, down_in_world=None), [])
        assert "the direction in which references are spread least" in html


def test_a_legend_of_all_reasons_is_within_its_chart() -> None:
    figure = outcomes_figure([counts(1, dict.fromkeys(WORDS, 1))])
    figure.draw_without_rendering()
    assert figure.legends[0].get_window_extent().x1 < figure.bbox.x1


class TestCommand:
    def run(self, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> tuple[int, str, list[dict[str, object]]]:
        asked: list[dict[str, object]] = []

        def get_scene_report(scene: str, **days: object) -> SceneReport:
            asked.append(days)
            return planted()

        client = SimpleNamespace(
            get_scene_report=get_scene_report,
            get_scene=lambda scene: SCENE,
            list_references=lambda scene: iter([reference("r", upright(1))]),
        )
        monkeypatch.setattr("mapless_tools.connection.connected", lambda *_: nullcontext(client))
        result = CliRunner().invoke(app, ["report", "hall", *arguments])
        return result.exit_code, result.output, asked

    def test_weeks_end_with_the_day_of_the_server(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        page = tmp_path / "page.html"
        code, output, asked = self.run(monkeypatch, "--weeks", "2", "--html", str(page))
        assert (code, output) == (0, f"the page is in {page}\n")
        assert asked[-1] == {"first_day": date(2026, 11, 17), "last_day": TODAY}
        assert "2 further references are not drawn" in page.read_text(encoding="utf-8")

    @pytest.mark.parametrize(
        ("arguments", "error"),
        [
            (("--since", "2026-11-30", "--until", "2026-11-01"), "--since 2026-11-30 is after --until 2026-11-01"),
            (("--since", "tomorrow"), "'tomorrow' is no day such as 2026-11-02"),
            (("--until", "2026-11-31"), "'2026-11-31' is no day such as 2026-11-02"),
            (("--until", "0001-01-01"), "must be 1970-01-01 or later"),
            (("--weeks", "0"), "--weeks"),
            (("--html", "/absent/page.html"), "/absent/page.html cannot be written"),
        ],
    )
    def test_wrong_flags_are_named(
        self, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], error: str
    ) -> None:
        code, output, asked = self.run(monkeypatch, *arguments)
        assert code == 2
        assert error in output
        assert not asked


def test_one_wrong_prior_does_not_shrink_the_plan() -> None:
    far = RejectedPosition(3, (2000.0, 0.0, 1.5), None, 0.1)
    planted = [place("a", upright(0.0), 5, {"LOW_OVERLAP": 3}), place("b", upright(10.0), 5, {})]
    given = report(replace(planted[0], rejected_position=far), planted[1])
    low, high = _shown(given, places_of(given, []), PLAN)
    assert 10 < high[0] - low[0] < 20
