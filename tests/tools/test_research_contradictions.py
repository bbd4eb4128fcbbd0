"""The cases of contradicting poses, and the comparison of two runs of them."""

from typing import Any

import numpy as np

from mapless import Camera, RigidTransform
from mapless.geometry import rotation_from_vector
from research.contradictions.cases import quarter_turn
from research.contradictions.comparing import is_expected, report

X_IN_WORLD = np.array([0.3, -0.2, 4.0])


def row(name: str, outcome: str, expected: str = "right or rejected", **more: Any) -> dict[str, Any]:
    pose = {"pose": [0.0], "error": 0.01, "error_deg": 0.1, "distance_seen": 2.0, "trust": 0.5, "radii": None}
    pose |= {"inliers": 50, "matches": 60}
    given = {"kind": "kind", "name": name, "expected": expected, "outcome": outcome, "processor_s": 0.5}
    return given | (pose if outcome in ("right", "wrong") else {"message": "nothing in common"}) | more


def test_turned_camera_sees_points_at_turned_pixels() -> None:
    camera = Camera(60, 40, 50.0, 55.0, 28.0, 21.0)
    pose = RigidTransform(rotation_from_vector([0.1, 0.2, 0.3]), np.array([0.1, 0.0, 0.2]))
    pixel = camera.project(pose.inverse().apply(X_IN_WORLD))
    column, line = pixel.round().astype(int)
    image = np.zeros((40, 60))
    image[line, column] = 1
    for quarters in (1, 2, 3):
        camera, pose = quarter_turn(camera, pose)
        seen = camera.project(pose.inverse().apply(X_IN_WORLD))
        found = np.argwhere(np.rot90(image, quarters))[0][::-1]
        assert np.abs(seen - found).max() <= 0.5
        assert np.rot90(image, quarters).shape == (camera.height_px, camera.width_px)


def test_comparison_names_what_differs_and_the_ratio_of_errors() -> None:
    before = [row("a", "right"), row("b", "LOW_OVERLAP"), row("c", "right"), row("d", "wrong")]
    after = [row("a", "right", error=0.02), row("b", "wrong"), row("c", "right", error=0.005), row("d", "wrong")]
    lines = report(before, after)
    assert lines[2] == "| kind | 4 | 2 / 2 | 1 / 2 | 1 LOW_OVERLAP | 0 | 1.000 (2) | 2 / 2 |"
    assert lines[5] == "1 photographs whose outcome differs:"
    assert lines[7] == "- kind: b (expected right or rejected)"
    assert lines[8].startswith("  - before: LOW_OVERLAP: nothing in common")
    assert lines[9].startswith("  - after: wrong, off 0.01 / 0.1 deg at distance 2, trust 0.5")


def test_expected_answers_of_each_kind() -> None:
    both: list[dict[str, object]] = [{}, {}]
    assert is_expected(row("a", "AMBIGUOUS", "rejected as ambiguous", hypotheses=both))
    assert not is_expected(row("a", "AMBIGUOUS", "rejected as ambiguous", hypotheses=[]))
    assert not is_expected(row("a", "LOW_OVERLAP", "right"))
    assert is_expected(row("a", "LOW_OVERLAP", "rejected"))
    assert not is_expected(row("a", "wrong", "right or rejected"))
