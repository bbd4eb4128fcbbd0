"""`mapless-server extend`: photographs are placed where they were taken, among references that stay as they are."""

import errno
import json
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from support.commands import run
from support.images import encode
from support.servers import RunningServer
from typer.testing import Result

from mapless import Accuracy, Client, Provenance, Scene, Voucher
from mapless.geometry import RigidTransform, rotation_angle_deg
from mapless_server.images import ANY_SIZE, decode_image
from mapless_tools.demo.photographs import Photograph, room
from mapless_tools.extend import session
from mapless_tools.extend.accuracy import (
    USUAL_POSITION,
    USUAL_ROTATION,
    Factors,
    _factors,
    accuracy_of,
    measured_factors,
)
from mapless_tools.extend.model import Estimate, Fixed
from mapless_tools.extend.options import ExtendOptions
from mapless_tools.extend.placing import Placement, _uncertainty
from mapless_tools.extend.report import lines, went_well
from mapless_tools.extend.run import ALREADY, Extension
from mapless_tools.reconstruct.pictures import Omitted

UNIT = 2.0
"""Units of the scene per metre: its unit is arbitrary."""


def half(it: Photograph, negative: bool = False) -> Photograph:
    """The photograph at half its size, in the scene's unit; its negative shows another room."""
    image = cv2.resize(decode_image(it.data, ANY_SIZE), (480, 360), interpolation=cv2.INTER_AREA)
    data = encode(".png", np.asarray(255 - image if negative else image, np.uint8))
    pose = RigidTransform(it.world_from_camera.rotation, UNIT * it.world_from_camera.translation)
    return Photograph(it.name, data, it.camera.resized(480, 360), pose)


REFERENCES = room().references[:9]
NEW, OTHER = REFERENCES[1:8:2], room().references[9]
"""Photographs to place, and one whose negative fits nothing."""


@pytest.fixture
def scene(client: Client) -> Iterator[str]:
    """References 0, 2, 4, 6 and 8 of the rendered room."""
    name = f"extend-{time.monotonic_ns()}"
    client.create_scene(name, arbitrary_unit=True)
    client.add_references(name, [half(it).reference() for it in REFERENCES[::2]])
    yield name
    client.delete_scene(name)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("extend") / "photos"
    folder.mkdir()
    for it in NEW:
        (folder / f"{it.name}.png").write_bytes(half(it).data)
    (folder / "elsewhere.png").write_bytes(half(OTHER, negative=True).data)
    return folder


def extended(server: RunningServer, scene: str, photos: Path, *flags: object) -> Result:
    work = ["--work", photos.parent / "work", "--features", "sift"]
    return run("extend", scene, photos, *work, *flags, "--address", server.address)


def poses(client: Client, scene: str) -> dict[str, bytes]:
    return {it.reference_id: it.world_from_camera.matrix().tobytes() for it in client.list_references(scene)}


def test_photographs_are_placed_where_they_were_taken(
    server: RunningServer, client: Client, scene: str, photos: Path, tmp_path: Path
) -> None:
    before = poses(client, scene)
    done = extended(server, scene, photos, "--report", tmp_path / "report.json")
    assert done.exit_code == 0, done.output
    assert f"{len(NEW)} of {len(NEW) + 1} photographs are placed in scene {scene}" in done.stdout
    assert "elsewhere: not placed, too few matches" in done.stdout
    stored = {it.reference_id: it for it in client.list_references(scene)}
    assert set(stored) == set(before) | {it.name for it in NEW}
    for it in map(half, NEW):
        found = stored[it.name]
        assert found.provenance.source == "PLACED"
        accuracy = found.provenance.accuracy
        assert accuracy is not None
        off = np.linalg.norm(found.world_from_camera.translation - it.world_from_camera.translation)
        assert off <= accuracy.position_95_m <= 0.05 * UNIT * 5
        turned = rotation_angle_deg(found.world_from_camera.rotation.T @ it.world_from_camera.rotation)
        assert turned <= accuracy.rotation_95_deg <= 2
    assert {name: pose for name, pose in poses(client, scene).items() if name in before} == before
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["stored"], report["arbitrary_unit"]) == ([it.name for it in NEW], True)
    again = extended(server, scene, photos)
    assert f"{NEW[0].name}: it is in the scene already, as reference {NEW[0].name}" in again.stdout
    assert "0 of 1 photographs are placed" in again.stdout
    assert len(poses(client, scene)) == len(stored)


def test_a_dry_run_stores_nothing(server: RunningServer, client: Client, scene: str, photos: Path) -> None:
    before = poses(client, scene)
    done = extended(server, scene, photos, "--dry-run")
    assert done.exit_code == 0, done.output
    assert f"{NEW[0].name}: placed, position within" in done.stdout
    assert poses(client, scene) == before


def test_a_full_disk_is_named(server: RunningServer, scene: str, photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "no space left on device")

    monkeypatch.setattr(session, "extend", full)
    done = extended(server, scene, photos)
    assert done.exit_code != 0
    assert f"the disk of {photos.parent / 'work'} is full" in done.stderr


@pytest.mark.parametrize(
    ("count", "said"),
    [(0, "has no references: from fewer than 2"), (1, "has one reference: from fewer than 2"), (None, "no scene")],
    ids=["empty", "one", "absent"],
)
def test_a_scene_with_too_little_is_refused(
    server: RunningServer, client: Client, photos: Path, count: int | None, said: str
) -> None:
    name = f"little-{count}-{time.monotonic_ns()}"
    if count is not None:
        client.create_scene(name)
        for it in REFERENCES[:count]:
            client.add_reference(name, half(it).reference())
    done = extended(server, name, photos)
    assert done.exit_code in (1, 2)
    assert said in done.stderr


def test_adopted_references_place_nothing(server: RunningServer, client: Client, photos: Path) -> None:
    """One of two references is adopted, which leaves too few."""
    name = f"adopted-{time.monotonic_ns()}"
    client.create_scene(name)
    first, second = (half(it).reference() for it in REFERENCES[:2])
    client.add_reference(name, first)
    known = Provenance("ADOPTED", Accuracy(0.01, 0.02, 0.1, 0.2), 1.0, (Voucher(first.reference_id, 30),))
    client.add_reference(name, replace(second, provenance=known))
    assert "has one reference: from fewer than 2" in extended(server, name, photos).stderr


def test_factors_of_few_references_are_mostly_the_usual_ones() -> None:
    none = _factors([])
    assert (none.position, none.rotation, none.count) == pytest.approx((USUAL_POSITION, USUAL_ROTATION, 0))
    many = _factors([(1.5, 1.5)] * 5000)
    assert (many.position, many.rotation) == pytest.approx((1.5, 1.5), rel=0.05)


def test_errors_of_placed_references_are_added() -> None:
    estimate = Estimate(RigidTransform.identity(), np.diag([1e-4] * 3 + [1e-6] * 3))
    placed = Provenance("PLACED", Accuracy(0.3, 0.6, 1.0, 2.0))
    known = {"given": Provenance(), "placed": placed}
    alone = accuracy_of(estimate, Factors(2.0, 3.0, 9), {"given": 10, "placed": 0}, known)
    both = accuracy_of(estimate, Factors(2.0, 3.0, 9), {"given": 50, "placed": 50}, known)
    assert alone.position_68_m == pytest.approx(2 * 0.01 * 1.872, rel=0.01)
    assert both.position_68_m == pytest.approx(math.hypot(alone.position_68_m, 0.3 / math.sqrt(2)))
    apart = accuracy_of(estimate, Factors(2.0, 3.0, 9), {"given": 0, "placed": 0}, known)
    assert apart == both  # placed by other new photographs: as the references in the mean


@pytest.mark.parametrize(
    ("accuracy", "said"),
    [
        (Accuracy(500, 900, 1, 2), ""),
        (Accuracy(500, 1001, 1, 2), "above 1000 units"),
        (Accuracy(1, 2, 90, 181), "or 180 degrees"),
        (Accuracy(5e5, 9e5, 1, 2), "900 % of the distance"),
    ],
    ids=["good", "far", "turned", "against its depth"],
)
def test_what_a_reference_may_not_have_is_not_placed(accuracy: Accuracy, said: str) -> None:
    """In a scene whose unit is the millimetre, photographs of what is 100 m away."""
    reason = _uncertainty(accuracy, 1e5, ExtendOptions())
    assert said in reason
    assert bool(said) == bool(reason)


def test_no_reference_to_measure_by_leaves_the_usual_factors() -> None:
    found = measured_factors(pycolmap.Reconstruction(), Fixed({}, frozenset()), [], False, 1, lambda *_: None)
    assert (found.position, found.rotation, found.count) == pytest.approx((USUAL_POSITION, USUAL_ROTATION, 0))


@pytest.mark.parametrize(
    ("tried", "said", "is_well"),
    [((), "nothing to place", True), ((Omitted("new", "it is blurred"),), "0 of 1 photographs are placed", False)],
    ids=["all stored", "one refused"],
)
def test_only_tried_photographs_are_judged(tried: tuple[Omitted, ...], said: str, is_well: bool) -> None:
    frames, there = Omitted("walk.mp4", "others are sharper", 900), Omitted("old", f"{ALREADY}, as reference old")
    extension = Extension(
        Scene("hall", 1, 3, datetime.now(timezone.utc)), {}, Placement((), tried), (frames, there, *tried), ()
    )
    assert list(lines(extension))[-1].startswith(said)
    assert went_well(extension) == is_well
