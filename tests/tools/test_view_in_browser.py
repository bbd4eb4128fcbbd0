"""A scene in a real browser: references, points and a query are drawn, and a click on it opens its report."""

import json
from contextlib import AbstractContextManager
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.chromium import Page, browsing, needs_chromium
from support.corner import CAMERA, make_corner, photograph, pose
from support.gateways import running_command

from mapless import Client, ConnectOptions, LocalizationResult
from mapless_tools.child import child_server

pytest.importorskip("viser", reason="needs the extra view")

YELLOW = (255, 190, 60)
TOP_PX = 220


def view(address: str, scene: str) -> AbstractContextManager[str]:
    """The address of a viewer of its own."""
    return running_command("view", scene, "--address", address, "--no-open", "--seeds", "2")


def like(picture: NDArray[np.uint8], colour: tuple[int, int, int], within: int = 60) -> NDArray[np.bool_]:
    """The pixels that have about a colour."""
    return np.asarray(np.abs(picture.astype(int) - colour).max(axis=-1) < within)


def greenish(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """The pixels of matches that agree; their dots are so small that browsers mix them with what is around."""
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return np.asarray((green - red > 40) & (green - blue > 10))


def canvas(page: Page) -> NDArray[np.uint8]:
    """The drawing, without the panel to the right and viser's messages above."""
    return page.screenshot()[TOP_PX:, :830]


def drawn(page: Page) -> int:
    """How many pixels are not the background's."""
    picture = canvas(page)
    return int((~like(picture, tuple(picture[-1, 0].tolist()), within=12)).sum())


def switch(page: Page, label: str) -> None:
    """Clicks the box with a label."""
    script = f"""(() => {{
        const label = [...document.querySelectorAll("label")].find(it => it.innerText === {json.dumps(label)});
        (document.getElementById(label.htmlFor) || label).click();
    }})()"""
    page.evaluate(script)


@pytest.mark.nightly
@needs_chromium()
def test_what_is_seen_in_a_browser(tmp_path: Path) -> None:
    with (
        child_server(tmp_path / "data", environment={"MAPLESS_ALLOW_WATCHING": "true"}) as server,
        Client(server.address, ConnectOptions(timeout_s=120)) as client,
    ):
        make_corner(client, [pose(angle) for angle in (-25, -15, -5, 5, 15, 25)])
        with view(server.address, "corner") as url, browsing(url) as page:
            look(page, client, tmp_path)


def look(page: Page, client: Client, folder: Path) -> None:
    page.until(lambda: "6 references" in page.text and "Queries: live" in page.text)
    page.until(lambda: drawn(page) > 5000)
    page.until(lambda: page.evaluate("[...document.querySelectorAll('*')].some(it => it.innerText === '/points')"))
    save(page, folder / "references.png")
    assert like(canvas(page), YELLOW).sum() < 20
    everything = drawn(page)

    switch(page, "References")
    page.until(lambda: 300 < drawn(page) < 0.5 * everything)
    switch(page, "Points")
    page.until(lambda: drawn(page) < 100)

    true = pose(2.0, height_m=-1.4, distance_m=3.0)
    answer = client.localize(photograph(true), CAMERA, "corner")
    assert isinstance(answer, LocalizationResult)
    assert np.linalg.norm(answer.world_from_camera.translation - true.translation) < 0.02
    assert answer.debug is None
    page.until(lambda: "#1 localized" in page.text)
    page.until(lambda: like(canvas(page), YELLOW).sum() > 150)
    assert page.evaluate("[...document.querySelectorAll('button')].some(it => it.innerText.startsWith('#1'))")

    switch(page, "Matches of the selected query")
    page.until(lambda: like(canvas(page), (110, 200, 170), within=40).sum() < 200)
    rows, columns = np.nonzero(like(canvas(page), YELLOW))
    page.until(lambda: opened(page, float(np.median(columns)), TOP_PX + float(np.median(rows))))
    page.until(lambda: page.evaluate("!!document.querySelector('.mantine-Modal-content iframe')"))
    assert "agree with the pose" in page.evaluate("document.querySelector('.mantine-Modal-content iframe').srcdoc")
    size = page.evaluate(
        "(() => { const it = document.querySelector('.mantine-Modal-content iframe').getBoundingClientRect();"
        "return [it.x, it.y, it.width, it.height]; })()"
    )
    x, y, width, height = (round(value) for value in size)
    assert width > 450
    page.until(lambda: greenish(page.screenshot()[y : y + height, x : x + width]).sum() > 500)
    save(page, folder / "query.png")
    page.evaluate("[...document.querySelectorAll('button')].find(it => it.innerText === 'Close').click()")
    page.until(lambda: not page.evaluate("!!document.querySelector('.mantine-Modal-content iframe')"))


def opened(page: Page, x: float, y: float) -> bool:
    """Clicks until the dialogue is open: the first click may come before the frustum is ready for it."""
    page.click(x, y)
    return any(page.evaluate("!!document.querySelector('.mantine-Modal-content')") for _ in range(20))


def save(page: Page, file: Path) -> None:
    """Kept, to be looked at."""
    cv2.imwrite(str(file), page.screenshot()[..., ::-1])
    print(f"screenshot: {file}")
