"""`mapless localize --depth`: sent with one photograph, refused with a folder, and without the depth it speaks of."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.depths import png
from support.servers import CAMERA, PHOTO, make_scene, serving

from mapless import Client
from mapless.__main__ import main
from mapless.cli.output import plain


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with serving(tmp_path_factory.mktemp("data")) as server:
        with Client(server.address) as client:
            make_scene(client)
        yield server.address


@pytest.fixture
def given(tmp_path: Path) -> list[str]:
    """The arguments of a photograph with depth."""
    (tmp_path / "photo.png").write_bytes(PHOTO)
    (tmp_path / "depth.png").write_bytes(png(np.full((CAMERA.height_px, CAMERA.width_px), 1500, np.uint16)))
    focal = {"focal_x_px": 80, "focal_y_px": 81, "principal_x_px": 47.5, "principal_y_px": 31.5}
    (tmp_path / "camera.json").write_text(json.dumps({"width_px": 96, "height_px": 64} | focal))
    return [str(tmp_path / "photo.png"), "--camera", str(tmp_path / "camera.json")]


def code_of(arguments: list[str]) -> object:
    with pytest.raises(SystemExit) as ended:
        main(["localize", "s", *arguments])
    return ended.value.code


def test_the_depth_is_sent(address: str, given: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    depth = str(Path(given[0]).with_name("depth.png"))
    code_of([*given, "--depth", depth, "--depth-sensor", "stereo", "--json", "--address", address])
    assert json.loads(capsys.readouterr().out)["diagnostics"]["depth_check"] is not None


@pytest.mark.parametrize("is_folder", [True, False])
def test_what_a_depth_is_not_of_is_said(
    address: str, given: list[str], is_folder: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(Path(given[0]).parent)
    wrong = [folder, *given[1:], "--depth", f"{folder}/depth.png"] if is_folder else [*given, "--depth-unit", "0.001"]
    assert code_of([*wrong, "--address", address]) != 0
    assert ("--depth is that of one photograph" if is_folder else "give --depth, too") in capsys.readouterr().err


@pytest.mark.parametrize("camera", ["lidar.json", None])
def test_a_depth_of_another_size_blames_its_own_camera(
    address: str, given: list[str], capsys: pytest.CaptureFixture[str], camera: str | None
) -> None:
    folder = Path(given[0]).parent
    (folder / "depth.png").write_bytes(png(np.full((40, 100), 1500, np.uint16)))
    (folder / "lidar.json").write_text(json.dumps(plain(CAMERA)))
    flags = [] if camera is None else ["--depth-camera", str(folder / camera)]
    assert code_of([*given, "--depth", str(folder / "depth.png"), *flags, "--address", address]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"mapless: {folder / (camera or 'depth.png')}: DEPTH_SIZE: ")
    assert error.endswith("; give --depth-camera\n") is (camera is None)
