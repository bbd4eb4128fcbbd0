"""The example pages in a real browser, against a real server: an emulated phone, and a photograph that is dropped."""

import base64
import json
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.chromium import Page, browsing, needs_chromium
from support.corner import CAMERA, make_corner, photograph, pose
from support.gateways import running_gateway
from support.users import registry_environment

from mapless import Client, ConnectOptions, LocalizationResult
from mapless.geometry import Array, Camera, Quaternion, RigidTransform, rotation_from_vector
from mapless_tools.child import child_server

pytest.importorskip("uvicorn", reason="needs the extra gateway")
pytest.importorskip("connectrpc", reason="needs connectrpc, which needs Python 3.11")

pytestmark = [pytest.mark.nightly("web pages"), needs_chromium()]

WEB = Path(__file__).parents[2] / "client" / "web"
PHONE = Camera(960, 720, 800.0, 800.0, 479.5, 359.5)
"""Its screen is as large as its image."""
TRUE = pose(3.0, height_m=-1.4, distance_m=3.0)
ANCHORS = np.array([[-0.3, -1.2, -0.3], [-1.0, -0.6, -0.2]])
CV_FROM_GL = np.diag([1.0, -1.0, -1.0])
START_M = np.array([0.0, 1.6, 0.0])
"""Where the emulated device is made, and with it the session's origin."""


@pytest.fixture(scope="module")
def pages() -> Path:
    """The folder of the built pages."""
    npm, environment = shutil.which("npm"), registry_environment()
    output: dict[str, Any] = {"capture_output": True, "text": True}
    if npm is None:
        pytest.skip("needs npm to build the pages")
    if not (WEB / "node_modules").is_dir():
        installed = subprocess.run([npm, "ci", "--no-audit", "--no-fund"], cwd=WEB, env=environment, **output)
        if installed.returncode:
            pytest.skip(f"npm could not install: {installed.stderr[-300:]}")
    built = subprocess.run([npm, "run", "build"], cwd=WEB, env=environment, **output)
    assert built.returncode == 0, built.stdout + built.stderr
    return WEB / "dist"


@pytest.fixture(scope="module")
def gateway(pages: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a gateway with the pages, in front of a server with a scene."""
    with child_server(tmp_path_factory.mktemp("data")) as server:
        with Client(server.address, ConnectOptions(timeout_s=120)) as client:
            make_corner(client, [pose(angle) for angle in (-25, -15, -5, 5, 15, 25)])
            client.update_scene("corner", down_in_world=(0.0, 1.0, 0.0))
            assert isinstance(client.localize(photograph(TRUE), CAMERA, "corner"), LocalizationResult)
        with running_gateway(server.address, "--pages", str(pages)) as url:
            yield url


def session_from_camera() -> RigidTransform:
    """Where the phone tracks itself, in WebXR's axes: x right, y up, z backward."""
    return RigidTransform(rotation_from_vector([0.2, 0.5, -0.1]), np.array([0.4, -0.1, -0.3]))


@contextmanager
def emulated(url: str) -> Iterator[Page]:
    """A page on a phone whose camera sees the corner from the true pose."""
    tracked = session_from_camera()
    turn = Quaternion.from_matrix(tracked.rotation)
    picture = base64.b64encode(photograph(TRUE, PHONE)).decode()
    emulation = {
        "photo": f"data:image/png;base64,{picture}",
        "width": PHONE.width_px,
        "height": PHONE.height_px,
        "fovy": float(2 * np.arctan(PHONE.height_px / 2 / PHONE.focal_y_px)),
        "position": (tracked.translation + START_M).tolist(),
        "orientation": [turn.x, turn.y, turn.z, turn.w],
    }
    script = f"globalThis.emulation = {json.dumps(emulation)};\n{(WEB / 'build' / 'emulated.js').read_text()}"
    with browsing("about:blank", PHONE.width_px, PHONE.height_px) as page:
        page.call("Page.addScriptToEvaluateOnNewDocument", source=script)
        page.call("Page.navigate", url=url)
        page.until(lambda: status(page) == "Ready.")
        yield page


def status(page: Page) -> str:
    return str(page.evaluate("globalThis.mapless?.status ?? ''"))


def seen(page: Page, name: str) -> Any:
    return page.evaluate(f"mapless.{name}")


def save(page: Page, file: Path) -> NDArray[np.uint8]:
    """Kept, to be looked at."""
    picture = page.screenshot()
    cv2.imwrite(str(file), picture[..., ::-1])
    print(f"screenshot: {file}")
    return picture


def test_an_anchor_appears_where_it_is(gateway: str, tmp_path: Path) -> None:
    anchors = ";".join(",".join(map(str, it)) for it in ANCHORS.tolist())
    with emulated(f"{gateway}/webxr.html?scene=corner&anchors={anchors}") as page:
        page.evaluate("document.getElementById('start').click()")
        page.until(lambda: seen(page, "finalPoseMs") or "Failed" in status(page) or "Cannot" in status(page))
        assert status(page).startswith("Localized: within"), status(page)
        frames = seen(page, "frames")
        page.until(lambda: seen(page, "frames") > frames + 2)
        picture = save(page, tmp_path / "webxr.png")
        found = np.array(seen(page, "worldFromSession")).reshape(4, 4).T
        print(f"first pose after {seen(page, 'firstPoseMs')} ms")
    world_from_camera = TRUE.rotation @ CV_FROM_GL
    tracked = session_from_camera()
    rotation = world_from_camera @ tracked.rotation.T
    assert np.allclose(found[:3, :3], rotation, atol=0.005)
    assert np.allclose(found[:3, 3], TRUE.translation - rotation @ tracked.translation, atol=0.02)
    for anchor in ANCHORS:
        assert np.linalg.norm(cross_centre(picture, anchor) - pixel_of(anchor)) < 6, anchor


def pixel_of(x_in_world: Array) -> Array:
    """Where the phone's screen shows a place."""
    x, y, z = TRUE.rotation.T @ (x_in_world - TRUE.translation)
    return np.array([800 * x / z + 479.5, 800 * y / z + 359.5])


def cross_centre(picture: NDArray[np.uint8], anchor: Array) -> Array:
    """Where a cross's red, green and blue lines begin: the mean of the coloured pixels nearest to one another."""
    expected = pixel_of(anchor)
    tips = [pixel_of(anchor + 0.3 * axis) for axis in np.eye(3)]
    reach = max(np.linalg.norm(tip - expected) for tip in tips)
    lines = []
    for channel in range(3):
        others = [it for it in range(3) if it != channel]
        rows, columns = np.nonzero((picture[..., channel] > 200) & (picture[..., others].max(axis=-1) < 90))
        near = np.stack([columns, rows], axis=-1).astype(float)
        near = near[np.linalg.norm(near - expected, axis=-1) < reach]
        assert len(near) > 10, (anchor, channel)
        lines.append(near)
    first = lines[0][:, None]
    distances = sum(np.linalg.norm(first - line[None], axis=-1).min(axis=1) for line in lines[1:])
    return np.asarray(lines[0][np.asarray(distances).argmin()])


def test_intrinsics_of_a_projection_matrix_are_the_cameras(gateway: str) -> None:
    """Points of any view, projected by its matrix and by the intrinsics, meet."""
    random = np.random.default_rng(3)
    with emulated(f"{gateway}/webxr.html") as page:
        for _ in range(5):
            matrix = np.zeros((4, 4))
            matrix[0, 0], matrix[1, 1] = random.uniform(0.7, 3, 2)
            matrix[:2, 2] = random.uniform(-0.4, 0.4, 2)
            matrix[2:, 2:] = np.array([[-1.002, -0.2], [-1, 0]])
            width, height = (int(it) for it in random.integers(200, 2000, 2))
            given = page.evaluate(f"mapless.intrinsicsOf({matrix.T.ravel().tolist()}, {width}, {height})")
            camera = Camera(
                given["widthPx"],
                given["heightPx"],
                given["focalXPx"],
                given["focalYPx"],
                given["principalXPx"],
                given["principalYPx"],
            )
            x_in_camera = np.array([*random.uniform(-1, 1, 2), random.uniform(1, 5)])
            x, y, _, w = matrix @ np.append(CV_FROM_GL @ x_in_camera, 1)
            corner = np.array([(1 + x / w) / 2 * width, (1 - y / w) / 2 * height])  # (0, 0) is the corner
            assert np.allclose(camera.project(x_in_camera[None])[0], corner - 0.5)


def test_a_dropped_photograph_appears_on_the_plan(gateway: str, tmp_path: Path) -> None:
    picture = base64.b64encode(photograph(TRUE, PHONE)).decode()
    drop = f"""(async () => {{
        const bytes = await (await fetch("data:image/png;base64,{picture}")).blob();
        const data = new DataTransfer();
        data.items.add(new File([bytes], "a.png", {{ type: "image/png" }}));
        document.getElementById("drop").dispatchEvent(new DragEvent("drop", {{ dataTransfer: data, bubbles: true }}));
    }})()"""
    with browsing(f"{gateway}/photo.html?scene=corner&focal_px=800", 1100, 1000) as page:
        page.until(lambda: status(page) == "Ready.")
        page.evaluate(drop)
        page.until(lambda: seen(page, "finalMs") or "Failed" in status(page))
        assert status(page).startswith("Localized: within"), status(page)
        save(page, tmp_path / "photo.png")
        kinds = page.evaluate("[...document.querySelectorAll('#plan [class]')].map(it => it.getAttribute('class'))")
        found = np.array(seen(page, "worldFromCamera"))
        page.evaluate("document.getElementById('scene').value = 'absent'")
        page.evaluate(drop)
        page.until(lambda: "Failed" in status(page))
        assert "there is no scene 'absent'" in status(page)
    assert np.linalg.norm(found[:3] - TRUE.translation) < 0.05
    assert kinds.count("reference") + kinds.count("used") == 6
    assert kinds.count("answer") == 2
    assert kinds.count("point") > 50


def test_a_server_elsewhere_is_closed_to_this_page(gateway: str) -> None:
    """A gateway that does not list this page's origin: the browser keeps its answers from the page."""
    other = gateway.replace("127.0.0.1", "localhost")
    with browsing(f"{gateway}/photo.html?scene=corner", 800, 600) as page:
        page.until(lambda: status(page) == "Ready.")
        found = page.evaluate(
            f"fetch('{other}/geopose', {{method: 'POST', body: 'x'}}).then(it => it.status, it => String(it))"
        )
    assert "TypeError" in str(found)
