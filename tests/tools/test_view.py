"""The viewer draws things where they belong, writes text as text, and serves its own pages alone."""

import socket
import threading
from collections.abc import Iterator
from dataclasses import replace
from datetime import date, datetime, timezone
from typing import Any
from urllib.request import Request, urlopen

import cv2
import numpy as np
import pytest
from support.images import encode
from typer.testing import CliRunner

from mapless import Datum, Quaternion, Reference, Scene, Unavailable
from mapless.answers import Accuracy, Hint, Hypothesis, LocalizationResult, Rejected
from mapless.diagnostics import Debug, Diagnostics, ReferenceUse
from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless.scene_reports import PeriodCounts, PlaceReport, ReferenceSuggestion, RejectedPosition, SceneReport
from mapless_tools.cli.app import app
from mapless_tools.depth_points import ColouredPoints
from mapless_tools.matches import colours_at, read_picture
from mapless_tools.report.places import BAD, GOOD, places_of, reason_colour
from mapless_tools.view.drawing import Drawing, ellipsoid, rgb
from mapless_tools.view.failures import MOST_POINTS, NOTHING_COUNTED, Failures, rejection_points
from mapless_tools.view.feed import Query
from mapless_tools.view.scenery import lay_out, spread_out

CAMERA = Camera(1800, 1350, 1500.0, 1500.0, 899.5, 674.5)
NOW = datetime(2026, 11, 21, tzinfo=timezone.utc)
SCENE = Scene("hall", 1, 3, NOW)


def reference(number: int, pose: RigidTransform) -> Reference:
    return Reference("hall", f"r{number}", CAMERA, pose, "", 0, NOW)


def upright(x_m: float, y_m: float = 0.0, turn: float = 0.0) -> RigidTransform:
    """A level camera in a world whose z points up, far from its origin: it looks north, turned about the vertical."""
    level = RigidTransform.from_matrix([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]).rotation
    return RigidTransform(rotation_from_vector([0, 0, turn]) @ level, np.array([4e5 + x_m, 5e6 + y_m, 30.0]))


def query(pose: RigidTransform | None, debug: Debug | None = None, image: bytes = b"") -> Query:
    text = "why"
    uses = (ReferenceUse(f"scenes/hall/references/{text}", 9, 7),)
    used = Diagnostics(text, "geometric", "", "sift", "BEST", 1, uses, None, {}, 0.0, 0.2, 96, 64, "0.1.0")
    if pose is None:
        hint = Hint("pnp", "LOOK_AT_REFERENCE", text, "")
        return Query(4, image, CAMERA, Rejected("LOW_OVERLAP", text, used, hint=hint, debug=debug))
    accuracy = Accuracy(0.01, 0.02, 0.1, 0.2, False)
    found = LocalizationResult(pose, np.eye(6), accuracy, "REFINED", 7, 9, 0.5, used, trust=0.3, debug=debug)
    return Query(4, image, CAMERA, found)


class TestShapes:
    def test_the_ellipsoid_holds_95_percent(self) -> None:
        random = np.random.default_rng(4)
        root = random.normal(size=(6, 6))
        covariance = root @ root.T
        vertices, faces = ellipsoid(covariance)
        inside = np.linalg.inv(covariance[:3, :3])
        reach = np.einsum("ni,ij,nj->n", vertices, inside, vertices)
        np.testing.assert_allclose(reach, reach[0])
        errors = random.multivariate_normal(np.zeros(3), covariance[:3, :3], 100_000)
        share = (np.einsum("ni,ij,nj->n", errors, inside, errors) <= reach[0]).mean()
        assert share == pytest.approx(0.95, abs=0.004)
        assert faces.max() == len(vertices) - 1


class TestScenery:
    def test_a_world_far_from_its_origin_is_drawn_near_zero(self) -> None:
        scenery = lay_out(SCENE, [reference(i, upright(i)) for i in range(5)], 10)
        drawn = [scenery.placed(it.world_from_camera) for it in scenery.references]
        assert max(float(np.abs(it.translation).max()) for it in drawn) <= 4
        np.testing.assert_array_equal(drawn[0].rotation, upright(0).rotation)
        assert 0.2 < scenery.size_m < 0.5
        assert 3 < scenery.extent_m < 5

    @pytest.mark.parametrize(
        ("scene", "down"),
        [
            (SCENE, (0, 0, -1)),
            (replace(SCENE, down_in_world=(0.0, 1.0, 0.0)), (0, 1, 0)),
            # The world's y axis points up, since it is turned to the Earth's.
            (
                replace(SCENE, datum=Datum(48.0, 8.0, 100.0, Quaternion(np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)))),
                (0, -1, 0),
            ),
        ],
        ids=["estimated", "given", "datum"],
    )
    def test_which_way_is_down(self, scene: Scene, down: tuple[float, float, float]) -> None:
        scenery = lay_out(scene, [reference(i, upright(i, turn=i)) for i in range(6)], 10)
        np.testing.assert_allclose(scenery.down, down, atol=1e-6)

    def test_few_of_thousands_are_spread_over_the_scene(self) -> None:
        random = np.random.default_rng(3)
        cluster = random.normal(0, 0.1, (3000, 2))
        corners = np.array([(50.0, 0.0), (0.0, 40.0), (-30.0, -30.0)])
        spots = np.concatenate([cluster, corners])
        chosen = spread_out(spots, 4)
        assert set(chosen[1:].tolist()) == {3000, 3001, 3002}
        everything = spread_out(spots[-20:], 100)
        assert sorted(everything.tolist()) == list(range(20))
        assert len(set(spread_out(np.zeros((9, 6)), 5).tolist())) == 5

    def test_neighbours_see_about_the_same(self) -> None:
        scenery = lay_out(SCENE, [reference(i, upright(i, turn=0 if i < 6 else np.pi)) for i in range(12)], 12)
        assert [it.reference_id for it in scenery.neighbours(2, 2)] in (["r1", "r3"], ["r3", "r1"])
        assert "r2" not in {it.reference_id for it in scenery.neighbours(2, 50)}

    def test_a_scene_without_references_is_refused(self) -> None:
        with pytest.raises(ValueError, match="no references"):
            lay_out(SCENE, [], 10)


class TestPictures:
    def test_colours_are_those_of_the_pixels(self) -> None:
        random = np.random.default_rng(1)
        coarse = random.integers(0, 256, (27, 36, 3)).astype(np.uint8)
        whole = cv2.resize(coarse, (1800, 1350), interpolation=cv2.INTER_NEAREST)
        reduced = read_picture(encode(".png", np.asarray(whole, np.uint8)), 360)
        pixels = random.uniform((0, 0), (1799, 1349), (200, 2))
        cells = (pixels + 0.5) / 50
        inner = (np.abs(cells % 1 - 0.5) < 0.3).all(axis=1)
        expected = coarse[cells[:, 1].astype(int), cells[:, 0].astype(int)]
        np.testing.assert_allclose(colours_at(reduced, CAMERA, pixels)[inner].astype(int), expected[inner], atol=2)


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Where viser serves."""
    pytest.importorskip("viser", reason="needs the extra view")
    from mapless_tools.view.guarded import GuardedViser

    server = GuardedViser("127.0.0.1", 0, "test")
    assert server.request_share_url() is None
    yield f"127.0.0.1:{server.get_port()}"
    server.stop()


class TestGuard:
    def status(self, address: str, **headers: str) -> int:
        try:
            with urlopen(Request(f"http://{address}/", headers=headers), timeout=10) as answer:
                return int(answer.status)
        except OSError as error:
            return int(getattr(error, "code", 0))

    def test_its_own_page_is_served(self, address: str) -> None:
        assert self.status(address) == 200
        assert self.status(address, Host=address.replace("127.0.0.1", "localhost")) == 200

    def test_by_another_name_it_is_not_there(self, address: str) -> None:
        assert self.status(address, Host="rebound.example") == 403
        assert self.status(address, Host=f"rebound.example:{address.rpartition(':')[2]}") == 403

    @pytest.mark.parametrize("origin", ["http://elsewhere.example", "https://127.0.0.1", "null", "http://localhost:1"])
    def test_another_page_cannot_connect(self, address: str, origin: str) -> None:
        websockets = pytest.importorskip("websockets.sync.client")
        from websockets.exceptions import InvalidStatus

        with pytest.raises(InvalidStatus) as refused:
            websockets.connect(f"ws://{address}", origin=origin)
        assert refused.value.response.status_code == 403

    def test_its_own_page_can(self, address: str) -> None:
        websockets = pytest.importorskip("websockets.sync.client")
        import viser

        own = f"http://{address}"
        with websockets.connect(f"ws://{address}", origin=own, subprotocols=[f"viser-v{viser.__version__}"]) as socket:
            assert socket.recv(timeout=10)


class TestCommand:
    def run(self, *arguments: str) -> Any:
        return CliRunner().invoke(app, ["view", "hall", "--no-open", *arguments])

    @pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "::"])
    def test_it_stays_on_this_machine(self, host: str) -> None:
        result = self.run("--host", host)
        assert result.exit_code == 2
        assert "not a loopback address" in result.stderr
        assert "ssh -L" in result.stderr

    def test_senseless_numbers_are_refused(self) -> None:
        result = self.run("--max-pictured", "0")
        assert result.exit_code == 2
        assert "--max-pictured" in result.stderr

    def test_a_server_that_is_not_there(self) -> None:
        pytest.importorskip("viser", reason="needs the extra view")
        before = threading.active_count()
        result = self.run("--address", "127.0.0.1:1", "--port", "0")
        assert result.exit_code == 1
        assert "UNAVAILABLE" in result.stderr
        assert threading.active_count() <= before + 1


def test_a_port_that_is_taken_is_not_exchanged_for_another() -> None:
    pytest.importorskip("viser", reason="needs the extra view")
    from mapless_tools.view.guarded import GuardedViser

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(RuntimeError, match=f"port {port} of 127.0.0.1 is taken"):
            GuardedViser("127.0.0.1", port, "test")


def test_queries_of_every_outcome_come_and_go() -> None:
    pytest.importorskip("viser", reason="needs the extra view")
    from mapless_tools.view.guarded import GuardedViser
    from mapless_tools.view.stage import MAX_QUERIES, Stage

    random = np.random.default_rng(6)
    x = upright(0).apply(random.uniform((-2, -1.5, 4), (2, 1.5, 6), (40, 3)))
    pixels = CAMERA.project(upright(0).inverse().apply(x))
    image = encode(".png", np.full((1350, 1800, 3), 90, np.uint8))
    source = np.where(np.arange(40) % 2, "TRIANGULATED", "MEASURED_DEPTH")
    debug = Debug(pixels, x, np.arange(40) % 5 != 0, np.zeros(40), np.zeros(40, int), pixels, source)
    hypotheses = (Hypothesis(upright(0), 9, ()), Hypothesis(upright(3), 8, ()))
    lost = query(None, debug, image)
    assert isinstance(lost.answer, Rejected)
    ambiguous = replace(lost, answer=replace(lost.answer, reason="AMBIGUOUS", hypotheses=hypotheses))
    outcomes = [query(upright(0), debug, image), query(upright(1), None, image), lost, ambiguous]
    server = GuardedViser("127.0.0.1", 0, "test")
    try:
        scenery = lay_out(SCENE, [reference(i, upright(i)) for i in range(9)], 6)
        stage = Stage(server, scenery, "hall", lambda reference_id: image)
        stage.show_picture("r4", read_picture(image, 160))
        for number in range(MAX_QUERIES + 5):
            stage.show_query(replace(outcomes[number % 4], number=number + 1))
        for _ in range(2):
            stage.show_points(debug.x_in_world, np.zeros((40, 3), np.uint8), debug.is_by_depth)
        stage.show_depth("r4", ColouredPoints(debug.x_in_world, np.zeros((40, 3), np.uint8)))
        stage.report("live", True)
        assert "None yet" in stage._nothing.content
        stage.report("not shown", False)
        assert "yet" not in stage._nothing.content
        handles: dict[str, Any] = dict(server.scene._handle_from_node_name)
        names = {name for name in handles if name.startswith("/queries/")}
        counts = {name: len(handles[name].points) for name in ("/points", "/points-by-depth", "/depth/0-r4")}
        setattr(stage._show_depths, "value", False)  # noqa: B010 - its type says that it is only read
        stage._show_clouds()
        shown = {name: handles[name].visible for name in counts}
    finally:
        server.stop()
    assert counts == {"/points": 20, "/points-by-depth": 20, "/depth/0-r4": 40}
    assert shown == {"/points": True, "/points-by-depth": False, "/depth/0-r4": False}
    kept = range(6, MAX_QUERIES + 6)
    cameras = {1: 1, 2: 1, 3: 0, 0: 2}
    assert {it for it in names if "/camera-" in it} == {
        f"/queries/{number}/camera-{i}" for number in kept for i in range(cameras[number % 4])
    }
    assert {it for it in names if it.endswith("/right")} == {
        f"/queries/{number}/right" for number in kept if number % 4 == 1
    }


def reported(name: str, pose: RigidTransform, localized: int, rejections: dict[str, int]) -> PlaceReport:
    days = date(2026, 11, 24), date(2026, 11, 30)
    return PlaceReport(name, pose, (PeriodCounts(*days, localized, rejections),))


class TestFailures:
    """The layer of a report: r0 is good, r1 bad with its photographs 9 m beyond, where a suggestion is."""

    BEYOND = (4e5 + 10.0, 5e6, 30.0)

    @pytest.fixture
    def report(self) -> SceneReport:
        places = reported("r0", upright(0), 9, {}), reported("r1", upright(1), 1, {"GATE": 2, "LOW_OVERLAP": 60})
        where = RejectedPosition(62, self.BEYOND, None, 0.5)
        suggested = ReferenceSuggestion("r1", 60.0, self.BEYOND, (0.0, 1.0, 0.0), 9.0, "look <here>")
        period = PeriodCounts(date(2026, 11, 24), date(2026, 11, 30), 10, {"LOW_OVERLAP": 60, "GATE": 2}, 1.0)
        both = places[0], replace(places[1], rejected_position=where)
        return SceneReport("hall", period.first_day, period.last_day, (period,), both, 0, (suggested,))

    def test_rejections_are_points_by_reason_where_they_were(self, report: SceneReport) -> None:
        points, colours = rejection_points(places_of(report, []), 0.3)
        np.testing.assert_allclose(points.mean(axis=0), self.BEYOND, atol=0.1)
        assert len(points) == MOST_POINTS
        of_reason = {tuple(it) for it in colours.tolist()}
        assert of_reason == {rgb(reason_colour("GATE")), rgb(reason_colour("LOW_OVERLAP"))}

    def test_it_is_drawn_on_demand_of_the_weeks_chosen(self, report: SceneReport) -> None:
        pytest.importorskip("viser", reason="needs the extra view")
        from mapless_tools.view.guarded import GuardedViser

        asked: list[int] = []

        def read(weeks: int) -> SceneReport:
            asked.append(weeks)
            if weeks == 52:
                raise Unavailable("UNAVAILABLE", "the server <is> away")
            period = replace(report.periods[0], localized_count=0, rejections={})
            return report if weeks == 4 else replace(report, periods=(period,), places=(), suggestions=())

        server = GuardedViser("127.0.0.1", 0, "test")
        try:
            scenery = lay_out(SCENE, [reference(i, upright(i)) for i in range(3)], 3)
            layer = Failures(server, Drawing(server, scenery), scenery, read)
            handles: dict[str, Any] = server.scene._handle_from_node_name
            layer.update()
            assert not asked
            assert not [it for it in handles if it.startswith("/what-fails")]
            self.choose(layer, show=True)
            shown = {name: it for name, it in handles.items() if name.startswith("/what-fails/")}
            places = shown["/what-fails/places"]
            np.testing.assert_allclose(places.points, [scenery.placed(upright(i)).translation for i in (0, 1)])
            assert [tuple(it) for it in places.colors.tolist()] == [rgb(GOOD), rgb(BAD)]
            start, end = shown["/what-fails/suggestion-1"].points[0]
            np.testing.assert_allclose(start, np.array(self.BEYOND) - scenery.origin)
            assert end[1] > start[1]
            assert shown["/what-fails/suggestion-1-label"].text == "1"
            assert "look &lt;here&gt;" in layer.legend.content
            self.choose(layer, show=False)
            assert not any(it.visible for it in (*shown.values(), layer.legend))
            self.choose(layer, show=True)
            assert asked == [4]
            self.choose(layer, show=True, weeks="1 week")
            assert NOTHING_COUNTED in layer.legend.content
            assert not [it for it in handles if it.startswith("/what-fails/")]
            self.choose(layer, show=True, weeks="52 weeks")
            assert "the server &lt;is&gt; away" in layer.legend.content
        finally:
            server.stop()

    def choose(self, layer: Failures, *, show: bool, weeks: str = "") -> None:
        """Sets the box or the weeks as a browser does; here they call nothing by themselves."""
        setattr(layer.show, "value", show)  # noqa: B010 - its type says that it is only read
        if weeks:
            setattr(layer.weeks, "value", weeks)  # noqa: B010 - likewise
        layer.update(again=bool(weeks))
