"""`mapless.localize` in one line, against a real server."""

import subprocess
import sys
from pathlib import Path

import pytest
from support.servers import CAMERA, PHOTO, RunningServer, make_scene, serving

import mapless
from mapless import Client, ConnectOptions, LocalizationResult, shortcut

CALL = """
import mapless, sys
camera = mapless.Camera(96, 64, 80.0, 81.0, 47.5, 31.5)
for _ in range(2):
    answer = mapless.localize(sys.argv[1], camera)
    print(answer.world_from_camera.translation)
"""


@pytest.fixture
def photo(tmp_path: Path) -> str:
    (tmp_path / "photo.png").write_bytes(PHOTO)
    return str(tmp_path / "photo.png")


def test_one_line_is_enough_where_there_is_one_scene(
    tmp_path: Path, photo: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with serving(tmp_path / "data") as server, Client(server.address) as client:
        monkeypatch.setenv("MAPLESS_ADDRESS", server.address)
        with pytest.raises(ValueError, match="the server has none"):
            mapless.localize(photo, CAMERA)
        make_scene(client, "hall", 2)
        assert isinstance(mapless.localize(photo, CAMERA), LocalizationResult)
        client.create_scene("other")
        with pytest.raises(ValueError, match="there are hall, other"):
            mapless.localize(photo, CAMERA)
        assert isinstance(mapless.localize(photo, CAMERA, "hall"), LocalizationResult)
        monkeypatch.setenv("MAPLESS_SCENE", "hall")
        assert isinstance(mapless.localize(photo, CAMERA), LocalizationResult)
        shortcut._close()


def test_one_connection_serves_all_calls_of_the_program(
    server: RunningServer, scene: str, photo: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(2):
        mapless.localize(PHOTO, CAMERA, scene, address=server.address)
    (made,) = shortcut._clients.values()
    mapless.localize(PHOTO, CAMERA, scene, address=server.address, options=ConnectOptions(timeout_s=20))
    assert len(shortcut._clients) == 2
    assert made in shortcut._clients.values()
    shortcut._close()
    monkeypatch.setenv("MAPLESS_ADDRESS", server.address)
    monkeypatch.setenv("MAPLESS_SCENE", scene)
    done = subprocess.run([sys.executable, "-c", CALL, photo], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[ 0.  2. -1.]\n" * 2
    assert done.stderr == ""
