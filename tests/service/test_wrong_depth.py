"""A wrong depth through a server: warned of when the scene is asked for, and found by the audit in the same place."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.depths import png
from support.servers import serving_really

from mapless import Client, DepthImage, DepthSensor, LocalizationResult, NewReference
from mapless_tools.demo import depth_map_m, room

pytestmark = pytest.mark.nightly
"""A real server; the parts are tested in `method` and `scenes`."""

MISTAKE = "it is mirrored, left for right"


def depth_of(name: str) -> DepthImage:
    return DepthImage(png(np.rint(1000 * depth_map_m(name)).astype(np.uint16)), 0.001, sensor=DepthSensor.RENDERED)


def mirrored(depth: DepthImage) -> DepthImage:
    values = cv2.imdecode(np.frombuffer(depth.data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert values is not None
    return replace(depth, data=png(np.asarray(values[:, ::-1], np.uint16)))


def test_a_wrong_depth_is_warned_of_and_found_by_the_audit(tmp_path: Path) -> None:
    chosen = room().references[:4]
    depths = {it.name: depth_of(it.name) for it in chosen}
    depths[chosen[2].name] = mirrored(depths[chosen[2].name])
    with (
        serving_really(tmp_path, features="sift", background_matching=False) as server,
        Client(server.address) as client,
    ):
        client.create_scene("room")
        client.add_references(
            "room",
            [NewReference(it.name, it.data, it.camera, it.world_from_camera, depth=depths[it.name]) for it in chosen],
        )
        (warning,) = client.get_scene("room").warnings
        audits = {it.name.rpartition("/")[2]: it for it in client.audit_scene("room")}
        assert warning.startswith(f"the depth of reference {chosen[2].name!r}: {MISTAKE}")
        wrong = {name: it for name, it in audits.items() if it.verdict == "WRONG_DEPTH"}
        assert list(wrong) == [chosen[2].name]
        assert wrong[chosen[2].name].message.startswith(f"its depth: {MISTAKE}")
        client.delete_reference("room", chosen[2].name)
        assert client.get_scene("room").warnings == ()
        again = NewReference(chosen[2].name, chosen[2].data, chosen[2].camera, chosen[2].world_from_camera)
        client.add_reference("room", replace(again, depth=depths[chosen[2].name]))
        assert client.get_scene("room").warnings == (warning,)
        client.update_scene("room", arbitrary_unit=True)
        assert not any("depth" in it for it in client.get_scene("room").warnings)
        assert "WRONG_DEPTH" not in {it.verdict for it in client.audit_scene("room")}


def test_millimetres_taken_for_metres_are_named_by_their_median_and_accuse_nobody(tmp_path: Path) -> None:
    """They take no part in comparisons: the same is said of a reference alone, and nothing of its neighbours."""
    chosen = room().references[:4]
    depths = {it.name: replace(depth_of(it.name), sensor=DepthSensor.STRUCTURED_LIGHT) for it in chosen}
    wrong = chosen[2].name
    depths[wrong] = replace(depths[wrong], unit_m=1.0)
    new = [NewReference(it.name, it.data, it.camera, it.world_from_camera, depth=depths[it.name]) for it in chosen]
    with (
        serving_really(tmp_path, features="sift", background_matching=False) as server,
        Client(server.address) as client,
    ):
        for scene, references in (("room", new), ("alone", [new[2]])):
            client.create_scene(scene)
            client.add_references(scene, references)
            (warning,) = client.get_scene(scene).warnings
            assert warning.startswith(f"the depth of reference {wrong!r}: its median is ")
            assert "m, outside 0.05 to 200 m, so it is not used: is unit_m right" in warning
            found = {it.name.rpartition("/")[2]: it for it in client.audit_scene(scene)}
            assert [name for name, it in found.items() if it.verdict == "WRONG_DEPTH"] == [wrong]
            assert found[wrong].message.startswith("its depth: its median is ")
            assert not any("depth" in it.message for name, it in found.items() if name != wrong)


def test_a_depth_of_another_unit_gives_no_pose(tmp_path: Path) -> None:
    """One reference alone would place photographs a thousand times too far away."""
    reference = room().references[0]
    depth = replace(depth_of(reference.name), unit_m=1.0)
    with (
        serving_really(tmp_path, features="sift", background_matching=False) as server,
        Client(server.address) as client,
    ):
        client.create_scene("room")
        new = NewReference("one", reference.data, reference.camera, reference.world_from_camera, depth=depth)
        (warning,) = client.add_reference("room", new).warnings
        assert "so it is not used: is unit_m right" in warning
        answer = client.localize(reference.data, reference.camera, "room")
        assert not isinstance(answer, LocalizationResult)


def test_a_photographs_depth_says_that_it_gives_points_or_why_it_is_not_used(tmp_path: Path) -> None:
    reference, photograph = room().references[:2]
    depth = replace(depth_of(photograph.name), sensor=DepthSensor.UNKNOWN)
    with (
        serving_really(tmp_path, features="sift", background_matching=False) as server,
        Client(server.address) as client,
    ):
        client.create_scene("room")
        new = NewReference("one", reference.data, reference.camera, reference.world_from_camera)
        client.add_reference("room", new)
        found, refused = (
            client.localize(photograph.data, photograph.camera, "room", depth=it, include_debug=True)
            for it in (depth, replace(depth, unit_m=1.0))
        )
        assert isinstance(found, LocalizationResult)
        assert found.debug is not None
        check, other = found.diagnostics.depth_check, refused.diagnostics.depth_check
        assert check is not None
        assert other is not None
        assert (check.used, check.conflict) == (True, False)
        assert check.point_count == found.debug.inliers_by_source()["PHOTOGRAPH_DEPTH"] == found.inlier_count
        assert f"gives {check.point_count} of the points" in str(found)
        assert not isinstance(refused, LocalizationResult)
        assert (other.used, other.conflict) == (False, True)
        assert other.median == pytest.approx(1000 * check.median)
        assert "m, outside 0.05 to 200 m: not used; is unit_m right" in str(refused)
