"""The command `mapless` against a real server."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import json_format
from servers import CAMERA, PHOTO, RunningServer, pose

from mapless import wire
from mapless.__main__ import main


def run(server: RunningServer, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, Any, str]:
    """Exit code, what was printed (as JSON if it is), and what was complained about."""
    with pytest.raises(SystemExit) as caught:
        main(["--address", server.address, *arguments])
    printed = capsys.readouterr()
    try:
        output = json.loads(printed.out)
    except json.JSONDecodeError:
        output = printed.out
    return int(caught.value.code or 0), output, printed.err


@pytest.fixture
def camera_json(tmp_path: Path) -> str:
    path = tmp_path / "camera.json"
    path.write_text(json_format.MessageToJson(wire.camera_to_message(CAMERA), preserving_proto_field_name=True))
    return str(path)


def test_from_an_empty_server_to_a_pose(
    server: RunningServer, capsys: pytest.CaptureFixture[str], tmp_path: Path, camera_json: str
) -> None:
    photo = tmp_path / "view-1.png"
    photo.write_bytes(PHOTO)
    pose_json = json_format.MessageToJson(wire.transform_to_message(pose(1.0)))

    assert run(server, capsys, "health") == (0, "SERVING\n", "")
    assert run(server, capsys, "scene", "create", "kitchen")[1]["scene_id"] == "kitchen"
    localize = ("localize", "kitchen", str(photo), "--camera", camera_json)
    code, answer, _ = run(server, capsys, *localize)
    assert (code, answer["reason"]) == (3, "NO_USABLE_REFERENCES")
    code, reference, _ = run(
        server, capsys, "reference", "add", "kitchen", str(photo), "--camera", camera_json, "--pose", pose_json
    )
    assert (code, reference["reference_id"], reference["camera"]["width_px"]) == (0, "view-1", 96)
    code, answer, _ = run(server, capsys, *localize, "--reference", "view-1", "--near", "1", "2", "-1", "0.5")
    assert code == 0
    assert answer["world_from_camera"]["translation_m"] == {"x": 1.0, "y": 2.0, "z": -1.0}
    assert np.shape(answer["covariance"]) == (6, 6)
    assert [r["reference_id"] for r in run(server, capsys, "reference", "list", "kitchen")[1]] == ["view-1"]
    assert run(server, capsys, "reference", "delete", "kitchen", "view-1")[0] == 0
    assert run(server, capsys, "scene", "get", "kitchen")[1]["reference_count"] == 0
    assert run(server, capsys, "scene", "delete", "kitchen")[0] == 0
    assert run(server, capsys, "scene", "list")[1] == []


def test_complaints(
    server: RunningServer, capsys: pytest.CaptureFixture[str], tmp_path: Path, camera_json: str
) -> None:
    code, _, complaint = run(server, capsys, "scene", "get", "absent")
    assert code == 1
    assert complaint.startswith("mapless: NOT_FOUND: ")
    photo = str(tmp_path / "absent.jpg")
    code, _, complaint = run(server, capsys, "localize", "s", photo, "--camera", camera_json)
    assert (code, "absent.jpg" in complaint) == (2, True)
    code, _, complaint = run(server, capsys, "localize", "s", photo, "--camera", '{"width": 3}')
    assert (code, "width" in complaint) == (2, True)
    code, _, complaint = run(server, capsys, "localize", "s", photo, "--camera", '{"width_px": 3}')
    assert (code, "camera.width_px" in complaint) == (2, True)
