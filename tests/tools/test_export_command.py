"""`mapless-server export`: folders can be read again, and images are those stored, bit for bit."""

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
from support.commands import run
from support.images import encode, textured
from support.layouts import CAMERA, assert_same_camera, assert_same_pose, by_name, truth
from support.servers import RunningServer, serving
from support.stores import damage

from mapless import (
    Accuracy,
    Client,
    Datum,
    DepthImage,
    DepthNoise,
    DepthSensor,
    NewReference,
    Provenance,
    RigidTransform,
    Scene,
    Voucher,
)
from mapless.geodesy import enu_from_y_up
from mapless.lenses import Fisheye, RadialTangential
from mapless_server.security import SceneKey
from mapless_server.store import Store
from mapless_tools.ingest.formats import read_dataset
from mapless_tools.ingest.formats.writing import LAYOUTS, PosedImage, cameras_files

LENSES = (None, RadialTangential(0.1, -0.2, 0.01, 0.02, 0.3), Fisheye(0.1, 0.2, 0.3, 0.4))
MASK = encode(".png", np.where(textured() > 90, 255, 0).astype(np.uint8))
PLACED = Provenance("PLACED", Accuracy(0.01, 0.02, 0.3, 0.4))
ENDINGS = (".png", ".jpg", ".webp")


@pytest.fixture
def filled(client: Client) -> Iterator[tuple[str, list[NewReference]]]:
    """A scene of three references: each another lens, another kind of file, ids with what ids may have."""
    scene = f"export-{time.monotonic_ns()}"
    references = [
        NewReference(
            f"r.{i}-_A",
            encode(ending, textured(seed=i)),
            replace(CAMERA, distortion=lens),
            truth().poses[i],
            MASK if i == 1 else None,
            PLACED if i == 1 else Provenance(),
        )
        for i, (lens, ending) in enumerate(zip(LENSES, ENDINGS, strict=True))
    ]
    client.create_scene(scene)
    client.add_references(scene, references)
    yield scene, references
    client.delete_scene(scene)


@pytest.mark.parametrize("layout", list(LAYOUTS))
def test_an_export_imports_as_the_same_scene(
    server: RunningServer, client: Client, filled: tuple[str, list[NewReference]], layout: str, tmp_path: Path
) -> None:
    scene, references = filled
    done = run("export", scene, tmp_path / "out", "--format", layout, "--address", server.address)
    assert done.exit_code == 0, done.output
    frames = by_name(read_dataset(tmp_path / "out"))
    for reference, ending in zip(references, ENDINGS, strict=True):
        frame = frames[reference.reference_id]
        assert frame.image_path.name == reference.reference_id + ending
        assert frame.image_path.read_bytes() == reference.image
        assert (frame.mask_path and frame.mask_path.read_bytes()) == reference.mask
        assert frame.provenance == (Provenance() if layout == "colmap" else reference.provenance)
        assert_same_camera(frame.camera, reference.camera, px=1e-12)
        assert_same_pose(frame.world_from_camera, reference.world_from_camera, 1e-12)
    # Its own importer agrees: there is nothing to add to the scene that it came from.
    again = run("import", tmp_path / "out", scene, "--skip-check", "--address", server.address)
    assert again.exit_code == 0, again.output
    assert "0 added, 3 skipped as duplicates, 0 refused" in again.stdout


def export_of(
    server: RunningServer, client: Client, filled: tuple[str, object], folder: Path, *flags: str
) -> list[str]:
    scene, _ = filled
    vouchers = (Voucher("r.0-_A", 30), Voucher("r.2-_A", 20))
    covariance = (np.diag([1e-4] * 3 + [1e-5] * 3) + 1e-6 * np.eye(6)[::-1]).tolist()
    provenance = Provenance("ADOPTED", Accuracy(0.01, 0.02, 0.3, 0.4), 0.75, vouchers, covariance)
    new = NewReference("kept", encode(".png", textured(seed=9)), CAMERA, truth().poses[2], provenance=provenance)
    client.add_reference(scene, new)
    done = run("export", scene, str(folder), *flags, "--address", server.address)
    assert done.exit_code == 0, done.output
    frames = read_dataset(folder).frames
    assert all(it.provenance == provenance for it in frames if it.name == "kept")
    return sorted(it.name for it in frames)


@pytest.mark.parametrize("layout", ["cameras", "kapture"])
def test_adopted_references_are_exported_apart(
    server: RunningServer, client: Client, filled: tuple[str, object], tmp_path: Path, layout: str
) -> None:
    surveyed = ["r.0-_A", "r.1-_A", "r.2-_A"]
    flags = "--format", layout, "--adopted"
    assert export_of(server, client, filled, tmp_path / "all", *flags, "with") == ["kept", *surveyed]
    client.delete_reference(filled[0], "kept")
    assert export_of(server, client, filled, tmp_path / "survey", *flags, "without") == surveyed
    client.delete_reference(filled[0], "kept")
    assert export_of(server, client, filled, tmp_path / "only", *flags, "only") == ["kept"]
    client.delete_reference(filled[0], "kept")
    empty = run("export", filled[0], str(tmp_path / "none"), *flags, "only", "--address", server.address)
    assert (empty.exit_code, "has no adopted references" in empty.output) == (2, True)


@pytest.mark.parametrize("layout", ["cameras", "kapture"])
def test_an_import_renews_no_age_of_adopted_ones(
    server: RunningServer, client: Client, filled: tuple[str, object], tmp_path: Path, layout: str
) -> None:
    export_of(server, client, filled, tmp_path / "out", "--format", layout)
    adopted = client.get_reference(filled[0], "kept").provenance.adopt_time
    assert adopted is not None
    copy = f"{filled[0]}-copy"
    done = run("import", tmp_path / "out", copy, "--skip-check", "--address", server.address)
    assert done.exit_code == 0, done.output
    assert client.get_reference(copy, "kept").provenance.adopt_time == adopted
    client.delete_scene(copy)


def test_what_nothing_vouches_for_or_is_too_old_is_not_imported(
    server: RunningServer, client: Client, filled: tuple[str, object], tmp_path: Path
) -> None:
    out, copy = tmp_path / "out", f"{filled[0]}-copy"
    export_of(server, client, filled, out, "--adopted", "only")
    done = run("import", out, copy, "--skip-check", "--address", server.address)
    assert done.exit_code == 1
    assert "are not in the scene: r.0-_A, r.2-_A" in " ".join(done.output.split())
    assert list(client.list_references(copy)) == []
    client.delete_scene(copy)
    file = out / "cameras.json"
    content = json.loads(file.read_text())
    content["frames"][0]["provenance"]["adopt_time"] = "2026-01-01T00:00:00+00:00"
    file.write_text(json.dumps(content))
    client.delete_reference(filled[0], "kept")
    done = run("import", out, filled[0], "--skip-check", "--address", server.address)
    assert done.exit_code == 1
    assert "is more than 24 h ago: older ones are deleted" in " ".join(done.output.split())
    assert "kept" not in {it.reference_id for it in client.list_references(filled[0])}


@pytest.mark.parametrize("layout", ["cameras", "kapture"])
def test_where_a_scene_is_on_the_earth_goes_along(
    server: RunningServer, client: Client, filled: tuple[str, list[NewReference]], layout: str, tmp_path: Path
) -> None:
    scene, _ = filled
    datum = Datum(47.1 / 3, 8.1 / 3, 400.1 / 3, enu_from_y_up(30))
    client.update_scene(scene, datum=datum, down_in_world=(0.01, -1.0, 0.02))
    exported = client.get_scene(scene)
    assert run("export", scene, tmp_path / "out", "--format", layout, "--address", server.address).exit_code == 0
    copy = f"{scene}-copy"
    done = run("import", tmp_path / "out", copy, "--skip-check", "--address", server.address)
    assert done.exit_code == 0, done.output
    found = client.get_scene(copy)
    assert (found.datum, found.down_in_world) == (datum, exported.down_in_world)
    # One that is there keeps what is known of it.
    client.update_scene(copy, datum=None)
    assert run("import", tmp_path / "out", copy, "--skip-check", "--address", server.address).exit_code == 0
    assert client.get_scene(copy).datum is None
    client.delete_scene(copy)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("datum", {"latitude_deg": 91, "longitude_deg": 0, "height_m": 0}),
        ("datum", {"latitude_deg": "47"}),
        ("datum", 1),
        ("down_in_world", [0, 0, 0]),
        ("down_in_world", [0, 1]),
        ("down_in_world", "down"),
    ],
)
def test_a_datum_or_down_that_is_none_is_refused_by_name(tmp_path: Path, field: str, value: object) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").write_bytes(encode(".png", textured()))
    image = PosedImage("a.png", CAMERA, truth().poses[0])
    scene = Scene("s", 1, 1, datetime.now(timezone.utc))
    ((name, text),) = cameras_files([image], "test", scene).items()
    (tmp_path / name).write_text(json.dumps(json.loads(text) | {field: value}))
    with pytest.raises(ValueError, match=rf"cameras\.json: {field}: "):
        read_dataset(tmp_path)


def test_poses_of_an_old_server_are_exported_without_a_source(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").write_bytes(encode(".png", textured()))
    image = PosedImage("a.png", CAMERA, truth().poses[0], provenance=Provenance("UNSPECIFIED"))
    ((name, text),) = cameras_files([image], "test").items()
    (tmp_path / name).write_text(text)
    (frame,) = read_dataset(tmp_path).frames
    assert frame.provenance == Provenance()


def test_a_changed_accuracy_is_no_duplicate(
    server: RunningServer, filled: tuple[str, list[NewReference]], tmp_path: Path
) -> None:
    assert run("export", filled[0], tmp_path / "out", "--address", server.address).exit_code == 0
    described = tmp_path / "out" / "cameras.json"
    described.write_text(described.read_text().replace('"rotation_95_deg": 0.4', '"rotation_95_deg": 0.5'))
    done = run("import", tmp_path / "out", filled[0], "--skip-check", "--address", server.address)
    assert "is there already, but its provenance differs" in done.output
    assert "2 skipped as duplicates, 1 refused" in done.stdout


def test_a_folder_with_something_in_it_is_not_written_to(
    server: RunningServer, filled: tuple[str, list[NewReference]], tmp_path: Path
) -> None:
    (tmp_path / "mine").write_text("precious")
    done = run("export", filled[0], tmp_path, "--address", server.address)
    assert done.exit_code == 2
    assert "is not empty" in done.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["mine"]


def test_absent_or_empty_scenes_and_unwritable_layouts(server: RunningServer, client: Client, tmp_path: Path) -> None:
    done = run("export", "no-such-scene", tmp_path / "a", "--address", server.address)
    assert done.exit_code == 1
    assert "no-such-scene" in done.stderr
    scene = f"empty-{time.monotonic_ns()}"
    client.create_scene(scene)
    done = run("export", scene, tmp_path / "b", "--address", server.address)
    assert (done.exit_code, "has no references" in done.stderr) == (2, True)
    done = run("export", scene, tmp_path / "c", "--format", "7scenes", "--address", server.address)
    assert (done.exit_code, "cameras, colmap, kapture, gltf" in done.stderr) == (2, True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("what", ["image", "pose"])
def test_damaged_references_are_named_and_the_rest_exported(tmp_path: Path, what: str) -> None:
    store = Store.open(tmp_path / "data")
    with serving(tmp_path / "data", store=store) as server, Client(server.address) as client:
        client.create_scene("s")
        client.add_references(
            "s", [NewReference(f"r{i}", encode(".png", textured(seed=i)), CAMERA, truth().poses[i]) for i in range(3)]
        )
        damage(store, SceneKey("s"), "r1", what)
        done = run("export", "s", tmp_path / "out", "--address", server.address)
        assert done.exit_code == 1
        assert "skipped: reference 'r1' is damaged" in done.stderr
        assert "2 of 3 written, 1 damaged" in done.stderr
        assert {file.name for file in (tmp_path / "out" / "images").iterdir()} == {"r0.png", "r2.png"}
        again = run("import", tmp_path / "out", "copy", "--skip-check", "--address", server.address)
        assert again.exit_code == 0, again.output
        assert "2 added" in again.stdout
        assert [it.reference_id for it in client.list_references("copy")] == ["r0", "r2"]


def test_where_all_are_damaged_no_folder_is_left_behind(tmp_path: Path) -> None:
    store = Store.open(tmp_path / "data")
    with serving(tmp_path / "data", store=store) as server, Client(server.address) as client:
        client.create_scene("s")
        client.add_reference("s", NewReference("r0", encode(".png", textured()), CAMERA, truth().poses[0]))
        damage(store, SceneKey("s"), "r0", "image")
        for _ in range(2):
            done = run("export", "s", tmp_path / "out", "--address", server.address)
            assert (done.exit_code, "0 of 1 written, 1 damaged" in done.stderr) == (1, True)


def test_a_scene_to_look_at_is_one_file(
    server: RunningServer, filled: tuple[str, list[NewReference]], tmp_path: Path
) -> None:
    trimesh = pytest.importorskip("trimesh")
    scene, references = filled
    done = run("export", scene, tmp_path / "out", "--format", "gltf", "--address", server.address)
    assert done.exit_code == 0, done.output
    (file,) = (tmp_path / "out").iterdir()
    assert file.name == f"{scene}.glb"
    names = {*trimesh.load(file).graph.nodes}
    assert {it.reference_id for it in references} | {f"photograph of {it.reference_id}" for it in references} <= names


def test_depths_come_back_bit_by_bit(server: RunningServer, client: Client, tmp_path: Path) -> None:
    """With whatever is said of them, as PNG and as float32; an import again finds nothing new."""
    scene, again = f"deep-{time.monotonic_ns()}", f"again-{time.monotonic_ns()}"
    size = CAMERA.height_px, CAMERA.width_px
    full = DepthImage(
        encode(".png", np.full((60, 80), 1500, np.uint16)),
        0.0002,
        None,
        DepthSensor.STRUCTURED_LIGHT,
        replace(CAMERA.resized(80, 60), distortion=Fisheye(0.1, 0.0, 0.0, 0.0)),
        RigidTransform(np.eye(3), np.array([-0.0225, -0.005, 0.0])),
        encode(".png", np.full((60, 80), 2, np.uint8)),
        2,
        DepthNoise(0.001, 0.002, 0.003, 0.004),
    )
    metres = DepthImage.of_metres(np.full(size, 1.5, np.float32), DepthSensor.RENDERED)
    depths = [full, metres, None]
    client.create_scene(scene)
    client.add_references(
        scene,
        [
            NewReference(f"r{i}", encode(".png", textured(seed=i)), CAMERA, truth().poses[i], depth=depth)
            for i, depth in enumerate(depths)
        ],
    )
    done = run("export", scene, tmp_path / "out", "--address", server.address)
    assert done.exit_code == 0, done.output
    for text in ("3 added", "3 skipped"):
        done = run("import", tmp_path / "out", again, "--skip-check", "--address", server.address)
        assert (done.exit_code, text in done.stdout) == (0, True), done.output
    hashes = [it.depth_sha256 for it in client.list_references(again)]
    assert hashes == [it.depth_sha256 for it in client.list_references(scene)] == [full.sha256, metres.sha256, ""]


def test_kapture_has_depths_in_metres_and_colmap_none(server: RunningServer, client: Client, tmp_path: Path) -> None:
    """Uncertain values are left out, the sensor's kind, camera and place kept; COLMAP's export says so."""
    scene = f"deep-{time.monotonic_ns()}"
    values, certain = np.full((60, 80), 1500, np.uint16), np.full((60, 80), 2, np.uint8)
    values[3, 4], certain[5, 6] = 65535, 1
    depth = DepthImage(
        encode(".png", values),
        0.0002,
        None,
        DepthSensor.STEREO,
        CAMERA.resized(80, 60),
        RigidTransform(np.eye(3), np.array([-0.0225, -0.005, 0.0])),
        encode(".png", certain),
        2,
    )
    client.create_scene(scene)
    new = [encode(".png", textured(seed=i)) for i in range(2)]
    client.add_reference(scene, NewReference("r0", new[0], CAMERA, truth().poses[0], depth=depth))
    client.add_reference(scene, NewReference("r1", new[1], CAMERA, truth().poses[1]))
    done = run("export", scene, tmp_path / "kapture", "--format", "kapture", "--address", server.address)
    assert (done.exit_code, "note" in done.stderr) == (0, False), done.output
    found, without = (frame.depth for frame in read_dataset(tmp_path / "kapture").frames)
    assert (without, found is not None) == (None, True)
    assert found is not None
    metres = np.frombuffer(found.read().data, "<f4").reshape(60, 80)
    expected = np.full((60, 80), 0.3, np.float32)
    expected[3, 4] = expected[5, 6] = 0
    np.testing.assert_allclose(metres, expected)
    assert found.sensor is DepthSensor.STEREO
    assert found.camera is not None
    np.testing.assert_allclose(found.camera.matrix(), CAMERA.resized(80, 60).matrix(), atol=1e-9)
    assert found.camera_from_depth_camera is not None
    np.testing.assert_allclose(found.camera_from_depth_camera.translation, [-0.0225, -0.005, 0.0], atol=1e-9)
    done = run("export", scene, tmp_path / "colmap", "--format", "colmap", "--address", server.address)
    assert "colmap has no depth, that of 1 references is not written" in done.stderr
    assert not list((tmp_path / "colmap").rglob("*depth*"))
