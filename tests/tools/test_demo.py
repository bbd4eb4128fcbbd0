"""The demo without its server: triangulated points, pictures, errors, the verdict."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from mapless import Camera, Client, LocalizationResult, Rejected, RigidTransform
from mapless.answers import Diagnostics, ReferenceUse
from mapless.geometry import RadialTangential, rotation_from_vector
from mapless_tools.child import ChildServer
from mapless_tools.demo import run
from mapless_tools.demo.raycast import Quad, Surface
from mapless_tools.demo.room import Photo, Station, look_at, take, write_folder
from mapless_tools.demo.sparse import Shot, find_in, points_to_draw, triangulate, undistorted
from mapless_tools.demo.textures import painting

CAMERA = Camera(320, 240, 280.0, 280.0, 160.3, 118.9)


@pytest.fixture(scope="module")
def photos() -> list[Photo]:
    """Six photographs of two painted walls that meet in a corner."""
    random = np.random.default_rng(5)
    walls = [
        Quad(np.array([0.0, 2, 2]), np.array([2.0, 0, 0]), np.array([0, 0, -2.0]), painting(random, (700, 700))),
        Quad(np.array([2.0, 2, 2]), np.array([0.0, -2, 0]), np.array([0, 0, -2.0]), painting(random, (700, 700))),
    ]
    surfaces = [Surface.of(wall, wall.texture) for wall in walls]
    poses = [look_at([0.2 + 0.15 * i, 0.1, 1 + 0.05 * (i % 2)], [1.5, 1.6, 1]) for i in range(6)]
    return [take(surfaces, Station(f"p{i}", CAMERA, pose)) for i, pose in enumerate(poses)]


def shot(photo: Photo) -> Shot:
    return Shot(photo.name, photo.image, photo.camera, photo.world_from_camera)


def test_triangulation_finds_planted_points() -> None:
    random = np.random.default_rng(1)
    x = random.uniform([-1, -1, 3], [1, 1, 5], (40, 3))
    lens = RadialTangential(0.05, -0.08, 0.001, 0.0005)
    camera = Camera(640, 480, 500.0, 505.0, 318.0, 243.0, lens)
    blank: NDArray[np.uint8] = np.zeros((480, 640, 3), np.uint8)
    poses = [RigidTransform.identity(), RigidTransform(rotation_from_vector([0.02, -0.1, 0]), np.array([0.5, 0.1, 0]))]
    a, b = (Shot("", blank, camera, pose) for pose in poses)
    pixels = [camera.project(pose.inverse().apply(x)) for pose in poses]
    np.testing.assert_allclose(
        undistorted(camera, pixels[0]), camera.pinhole().project(x), atol=0.05, err_msg="OpenCV inverts the lens"
    )
    found, parallax_deg = triangulate(a, b, *pixels)
    np.testing.assert_allclose(found, x, atol=2e-3)
    assert (parallax_deg > 3).all()


def test_drawn_points_lie_on_the_walls_and_are_found_again(photos: list[Photo]) -> None:
    points = points_to_draw([shot(photo) for photo in photos[:3]])
    off_wall = np.abs(points.x_in_world[:, :2] - 2).min(axis=-1)
    assert len(off_wall) > 50
    assert np.median(off_wall) < 0.02
    indices, pixels = find_in(points, shot(photos[4]), 20)
    expected = CAMERA.project(photos[4].world_from_camera.inverse().apply(points.x_in_world[indices]))
    assert len(indices) > 20
    assert np.median(np.linalg.norm(pixels - expected, axis=-1)) < 1


class FakeClient(Client):
    """Answers with the truth moved by a known offset, and rejects the names in `rejected`."""

    offset_m = 0.01
    rejected: tuple[str, ...] = ()
    truth: dict[bytes, tuple[str, RigidTransform]]

    def create_scene(self, scene_id: str, **_: Any) -> Any:
        self.stored: list[str] = []

    def add_references(self, scene: str, references: Any, **_: Any) -> Any:
        self.stored += [reference.reference_id for reference in references]

    def localize(self, image: Any, camera: Camera, scene: str, *_: Any, **__: Any) -> LocalizationResult | Rejected:
        name, pose = self.truth[image]
        uses = tuple(ReferenceUse(f"scenes/{scene}/references/{n}", 50, 40) for n in self.stored)
        size = (camera.width_px, camera.height_px)
        diagnostics = Diagnostics("", "geometric", "", "sift", "best", 1, uses, None, {}, 0.0, 0.5, *size, "0")
        if name in self.rejected:
            return Rejected("LOW_OVERLAP", "nothing in common", diagnostics)
        moved = RigidTransform(pose.rotation, pose.translation + np.array([self.offset_m, 0, 0]))
        return LocalizationResult(moved, None, None, "REFINED", 40, 50, 0.6, diagnostics)


@pytest.fixture
def folder(photos: list[Photo], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_folder(tmp_path / "walls", photos, "a test")
    files = {photo.name: (tmp_path / "walls" / "images" / f"{photo.name}.jpg").read_bytes() for photo in photos}
    FakeClient.truth = {files[photo.name]: (photo.name, photo.world_from_camera) for photo in photos}

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


def test_half_of_a_folder_is_too_little(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeClient, "rejected", ("p1",))
    console = Console(record=True, width=140)
    assert not run.run_demo(folder, tmp_path / "out", console)
    assert "expected: more than half localized" in console.export_text()


@pytest.mark.parametrize(("offset_m", "good"), [(0.029, True), (0.031, False), (math.inf, False)])
def test_the_rendered_room_must_reach_its_limits(photos: list[Photo], offset_m: float, good: bool) -> None:
    queries = [run.Photograph(p.name, b"", p.camera, p.world_from_camera) for p in photos]
    place = run.Place("", [], queries, metric=True, seed=0)
    client = FakeClient("127.0.0.1:1")
    client.offset_m, client.stored, client.truth = offset_m, [], {b"": ("x", queries[0].world_from_camera)}
    client.rejected = () if math.isfinite(offset_m) else ("x",)
    outcomes = [run.judge(queries[0], client.localize(b"", CAMERA, "demo"))]
    assert run.summarize(Console(quiet=True), place, outcomes) == good
