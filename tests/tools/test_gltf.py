"""A scene as glTF, as trimesh reads it: cameras, points and photographs where they are, upright."""

import io
from dataclasses import replace
from datetime import datetime, timezone
from typing import Any

import numpy as np
import pygltflib
import pytest
from support.images import encode, textured
from support.layouts import CAMERA, truth

from mapless import Datum, Reference, Scene
from mapless.geometry import Array
from mapless_tools.depth_points import ColouredPoints
from mapless_tools.ingest.gltf import View, to_gltf

trimesh = pytest.importorskip("trimesh")

NOW = datetime.now(timezone.utc)
FAR = np.array([4.5e6, -2.0e5, 300.0])
"""As in projected coordinates, which single precision does not hold."""
DOWN = (0.0, 0.6, -0.8)


def views() -> list[View]:
    found = []
    for i, pose in enumerate(truth().poses):
        camera = CAMERA if i % 2 else replace(CAMERA, focal_x_px=90.0)
        reference = Reference("s", f"r{i}", camera, pose.shifted(FAR), "", 9, NOW)
        points = pose.shifted(FAR).apply(np.array([[0.0, 0.0, 2.0], [0.5, 0.25, 3.0]]))
        colours = np.array([[255, 0, 0], [0, 128, 255]], np.uint8)
        shared = ColouredPoints(points, colours)
        found.append(View(reference, encode(".jpg", textured(64, 48, seed=i)), shared))
    return found


def loaded(scene: Scene, given: list[View]) -> Any:
    return trimesh.load(io.BytesIO(to_gltf(scene, given)), file_type="glb")


def world_from_gltf(scene: Any) -> Array:
    matrix: Array = np.linalg.inv(scene.graph[("s")][0])
    return matrix


def test_cameras_and_points_are_where_they_are() -> None:
    scene = loaded(Scene("s", 1, 4, NOW, down_in_world=DOWN), views())
    origin = np.median([it.reference.world_from_camera.translation for it in views()], axis=0)
    back = world_from_gltf(scene)
    np.testing.assert_allclose(back[:3, :3] @ [0, -1, 0], DOWN, atol=1e-7)
    for view in views():
        found = back @ scene.graph[view.reference.reference_id][0]
        expected = view.reference.world_from_camera.shifted(-origin).matrix() @ np.diag([1, -1, -1, 1])
        np.testing.assert_allclose(found, expected, atol=1e-9)
    (points,) = (it for it in scene.geometry.values() if isinstance(it, trimesh.PointCloud))
    np.testing.assert_allclose(
        points.vertices, np.concatenate([it.points.points for it in views() if it.points]) - origin, atol=1e-5
    )
    np.testing.assert_array_equal(points.colors[:2], [[255, 0, 0, 255], [0, 56, 255, 255]])


def test_points_of_depth_are_nodes_of_their_own() -> None:
    """So viewers can hide them; their material is bluish, their colours are those of the photograph."""
    first, *others = views()
    assert first.points is not None
    given = [replace(first, by_depth=first.points, depth=first.points), *others]
    scene = loaded(Scene("s", 1, 4, NOW, down_in_world=DOWN), given)
    clouds = {name: it for name, it in scene.geometry.items() if isinstance(it, trimesh.PointCloud)}
    assert set(clouds) == {"points", "points by depth", f"depth of {first.reference.reference_id}"}
    for name in set(clouds) - {"points"}:
        np.testing.assert_array_equal(clouds[name].vertices, clouds["points"].vertices[:2])
    file = pygltflib.GLTF2.load_from_bytes(to_gltf(Scene("s", 1, 4, NOW), given))
    used = {mesh.name: file.materials[mesh.primitives[0].material].name for mesh in file.meshes}
    assert used["points"] == "points"
    assert used["points by depth"] == used[f"depth of {first.reference.reference_id}"] == "points by depth"


def test_a_frustum_meets_the_corners_of_the_photograph() -> None:
    """The lines' ends, projected with the reference's camera, are the raster's corners."""
    scene = loaded(Scene("s", 1, 4, NOW, down_in_world=DOWN), views())
    lines = [it for it in scene.geometry.values() if isinstance(it, trimesh.path.Path3D)]
    assert len(lines) == 2  # one for each camera, shared
    for it, focal_x_px in zip(lines, (90.0, 80.0), strict=True):
        ends = np.unique(it.vertices, axis=0)
        ends = ends[np.linalg.norm(ends, axis=1) > 0] @ np.diag([1, -1, -1])
        pixels = replace(CAMERA, focal_x_px=focal_x_px).project(ends)
        wanted = [[x, y] for x in (-0.5, 95.5) for y in (-0.5, 63.5)]
        np.testing.assert_allclose(sorted(pixels.tolist()), wanted, atol=1e-4)


def test_what_gltf_has_no_field_for_is_in_extras() -> None:
    datum = Datum(47.0, 8.0, 400.0)
    scene = loaded(Scene("s", 1, 4, NOW, datum=datum), views())
    about = scene.graph.transforms.edge_data[("world", "s")]["metadata"]
    assert about["datum"] == datum.to_json()
    of_reference = scene.graph.transforms.edge_data[("s", "r1")]["metadata"]
    assert of_reference["world_from_camera"] == views()[1].reference.world_from_camera.matrix().tolist()
    assert of_reference["camera"]["focal_x_px"] == CAMERA.focal_x_px
