"""The demo without its server: its photographs, pictures, errors, the verdict."""

import itertools
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console
from support import corner

from mapless import Camera, Client, LocalizationResult, Rejected, RigidTransform
from mapless.diagnostics import Debug, Diagnostics, ReferenceUse
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.features.matching import mutual_matches
from mapless_tools.child import ChildServer
from mapless_tools.demo import Photograph, Place, depth_map_m, room, run
from mapless_tools.demo.photographs import ROOM
from mapless_tools.matches import read_picture

CAMERA = Camera(320, 240, 280.0, 280.0, 160.3, 118.9)


POSES = [corner.pose(-15.0 + 6 * i, height_m=-1.6 + 0.05 * (i % 2)) for i in range(6)]


@pytest.fixture(scope="module")
def photos() -> list[Photograph]:
    """Six photographs of a corner between papered walls."""
    return [Photograph(f"p{i}", corner.photograph(it, CAMERA), CAMERA, it) for i, it in enumerate(POSES)]


@pytest.fixture(scope="module")
def place() -> Place:
    return room()


# The room's photographs


def test_the_room_has_16_references_and_8_queries_in_6_mb(place: Place) -> None:
    assert (len(place.references), len(place.queries)) == (16, 8)
    assert place.outline is not None
    assert set(place.outline.visible_edges) == {it.name for it in place.queries}
    assert sum(path.stat().st_size for path in ROOM.rglob("*") if path.is_file()) < 6e6


def test_photographs_show_the_same_points_in_place(place: Place) -> None:
    """Half a pixel would be seen: keypoints of references, lifted by their depths, beside their matches in queries."""
    offsets = []
    queries, references = place.queries[:2], place.references[2::8]
    views = {it.name: SiftExtractor().extract(read_picture(it.data, 960), it.camera) for it in (*queries, *references)}
    for query, reference in itertools.product(queries, references):
        pairs = mutual_matches(views[query.name].features, views[reference.name].features, 0.7)
        keypoints = [views[it.name].features.keypoints[pairs[:, i]] for i, it in enumerate((query, reference))]
        cameras = [views[it.name].camera for it in (query, reference)]
        column, row = np.rint(cameras[1].resized(240, 180).project(cameras[1].rays(keypoints[1]))).astype(int).T
        in_reference = cameras[1].rays(keypoints[1]) * depth_map_m(reference.name)[row, column, None]
        in_query = query.world_from_camera.inverse().apply(reference.world_from_camera.apply(in_reference))
        offsets.append(keypoints[0] - cameras[0].project(in_query))
    together = np.concatenate(offsets)
    near = np.linalg.norm(together, axis=-1) < 5  # neither a wrong match nor a depth beside an edge
    assert near.sum() > 200
    assert np.abs(np.median(together[near], axis=0)).max() < 0.2


@pytest.mark.nightly
def test_the_script_renders_the_photographs_that_are_here(place: Place) -> None:
    from research.rendered_room.furniture import lit_room
    from research.rendered_room.photographs import photograph, walk

    station = walk(0, 16)[5]
    expected = place.references[5]
    np.testing.assert_allclose(station.world_from_camera.matrix(), expected.world_from_camera.matrix(), atol=1e-12)
    difference = photograph(lit_room(0), station, 0).astype(float) - read_picture(expected.data, 960)
    assert np.sqrt(np.mean(difference**2)) < 6  # the compression of a noisy picture


class FakeClient(Client):
    """Answers with the truth moved by a known offset, and rejects the names in `rejected`."""

    offset_m = 0.01
    rejected: tuple[str, ...] = ()
    truth: dict[bytes, tuple[str, RigidTransform]]

    def create_scene(self, scene_id: str, **_: Any) -> Any:
        self.stored: list[str] = []

    def add_references(self, scene: str, references: Any, **_: Any) -> Any:
        self.stored += [reference.reference_id for reference in references]

    def localize(
        self, image: Any, camera: Camera | None = None, scene: str = "", *_: Any, **__: Any
    ) -> LocalizationResult | Rejected:
        assert camera is not None
        name, pose = self.truth[image]
        uses = tuple(ReferenceUse(f"scenes/{scene}/references/{n}", 50, 40) for n in self.stored)
        size = (camera.width_px, camera.height_px)
        diagnostics = Diagnostics("", "geometric", "", "sift", "best", 1, uses, None, {}, 0.0, 0.5, *size, "0")
        if name in self.rejected:
            return Rejected("LOW_OVERLAP", "nothing in common", diagnostics)
        moved = RigidTransform(pose.rotation, pose.translation + np.array([self.offset_m, 0, 0]))
        points = pose.apply(np.random.default_rng(0).uniform([-0.5, -0.5, 3], [0.5, 0.5, 5], (40, 3)))
        seen, shown = (camera.project(it.inverse().apply(points)) for it in (pose, moved))
        debug = Debug(seen, points, np.ones(40, bool), np.zeros(40), np.zeros(40, int), shown)
        return LocalizationResult(moved, None, None, "REFINED", 40, 50, 0.6, diagnostics, debug=debug)


@pytest.fixture
def folder(photos: list[Photograph], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    images = {f"images/{it.name}.png": (it.data, it.camera, it.world_from_camera) for it in photos}
    frames = []
    for name, (data, camera, at) in images.items():
        file = tmp_path / "walls" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
        size = {"width": camera.width_px, "height": camera.height_px, "K": camera.matrix().tolist()}
        frames.append({"image": name, **size, "world_from_camera": at.matrix().tolist()})
    (tmp_path / "walls" / "cameras.json").write_text(json.dumps({"frames": frames}))
    FakeClient.truth = {it.data: (it.name, it.world_from_camera) for it in photos}

    @contextmanager
    def no_server(data_dir: Path) -> Iterator[ChildServer]:
        yield ChildServer("127.0.0.1:1", 0)

    monkeypatch.setattr(run, "child_server", no_server)
    monkeypatch.setattr(run, "Client", FakeClient)
    return tmp_path / "walls"


def test_a_folder_is_split_localized_and_drawn(folder: Path, tmp_path: Path) -> None:
    console = Console(record=True, width=140)
    assert run.run_demo(folder, tmp_path / "out", console)
    said = console.export_text()
    assert "4 references, 2 queries" in said
    assert "every 3rd frame a query" in said
    assert "median error over all 1.00 cm, 0.000 deg" in said
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["all.png", "p1.png", "p4.png"]
    image = cv2.imread(str(tmp_path / "out" / "p1.png"))
    assert image is not None
    assert image.std() > 20


def test_rejections_are_shown_and_drawn(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeClient, "rejected", ("p1", "p4"))
    console = Console(record=True, width=140)
    assert not run.run_demo(folder, tmp_path / "out", console)
    said = console.export_text()
    assert "LOW_OVERLAP" in said
    assert "0 of 2 localized" in said


@pytest.mark.parametrize(("offset_m", "good"), [(0.029, True), (0.031, False), (math.inf, False)])
def test_the_room_must_reach_its_limits(place: Place, offset_m: float, good: bool) -> None:
    client = FakeClient("127.0.0.1:1")
    client.offset_m, client.stored, client.truth = offset_m, [], {b"": ("x", place.queries[0].world_from_camera)}
    client.rejected = () if math.isfinite(offset_m) else ("x",)
    outcomes = [run.judge(place.queries[0], client.localize(b"", CAMERA, "demo"))]
    assert run.summarize(Console(quiet=True), place, outcomes) == good
