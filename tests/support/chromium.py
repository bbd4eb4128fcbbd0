"""A real browser without a screen, controlled by its DevTools protocol: loads a page, takes a picture, and clicks.

`TEST_CHROMIUM=required` makes its absence a failure. WebGL is computed on the CPU, so machines without a GPU draw too.
"""

import base64
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

LIMIT_S = 60.0
_PROGRAMS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")


def program() -> str | None:
    """The browser; None where there is none."""
    return next(filter(None, map(shutil.which, _PROGRAMS)), None)


def needs_chromium() -> pytest.MarkDecorator:
    """Skips a test where there is no browser, unless it has to be there."""
    absent = program() is None and os.environ.get("TEST_CHROMIUM") != "required"
    return pytest.mark.skipif(absent, reason="needs a browser: apt-get install chromium-headless-shell")


class Page:
    """A page that is open in a browser."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._numbers = itertools.count(1)

    def call(self, method: str, **parameters: object) -> dict[str, Any]:
        """The answer to a command of the protocol."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=LIMIT_S))
            if message.get("id") == number:
                assert "error" not in message, message
                result: dict[str, Any] = message["result"]
                return result

    def evaluate(self, script: str) -> Any:
        """A script's value."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    @property
    def text(self) -> str:
        """The visible text."""
        return str(self.evaluate("document.body ? document.body.innerText : ''"))

    def screenshot(self) -> NDArray[np.uint8]:
        """The page as a picture, (H, W, 3) RGB."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        return np.asarray(picture[..., ::-1], np.uint8)

    def click(self, x: float, y: float) -> None:
        """Presses and releases the mouse there."""
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def until(self, condition: Callable[[], Any], limit_s: float = LIMIT_S) -> Any:
        """Waits for something that is true, and gives it."""
        end_s = time.monotonic() + limit_s
        while not (found := condition()):
            assert time.monotonic() < end_s, self.text
            time.sleep(0.3)  # drawing takes the same processor
        return found


@contextmanager
def browsing(url: str, width_px: int = 1180, height_px: int = 760) -> Iterator[Page]:
    """A page in a browser of its own, until the block is left."""
    from websockets.sync.client import connect

    browser = program()
    assert browser is not None, "there is no browser"
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        flags = [
            "--headless",
            "--no-sandbox",  # which root cannot have
            "--remote-debugging-port=0",
            f"--user-data-dir={profile}",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
            "--disable-dev-shm-usage",
            "--no-first-run",
            f"--window-size={width_px},{height_px}",
        ]
        # In a group of its own: what is on the path may be a script, whose end would not be the browser's.
        process = subprocess.Popen(
            [browser, *flags, "about:blank"], stderr=subprocess.PIPE, text=True, start_new_session=True
        )
        try:
            with connect(_page_address(process), max_size=None) as socket:
                page = Page(socket)
                page.call("Page.enable")
                size = {"width": width_px, "height": height_px, "deviceScaleFactor": 1, "mobile": False}
                page.call("Emulation.setDeviceMetricsOverride", **size)
                page.call("Page.navigate", url=url)
                yield page
        finally:
            _end_group(process)
            assert process.stderr is not None
            process.stderr.close()


def _end_group(process: subprocess.Popen[str]) -> None:
    """Ends a process and all that it started."""
    end_s = time.monotonic() + 30
    with suppress(ProcessLookupError):
        while True:
            os.killpg(process.pid, signal.SIGKILL)
            process.poll()  # a process stays in its group until its status is read
            assert time.monotonic() < end_s
            time.sleep(0.05)


def _page_address(process: subprocess.Popen[str]) -> str:
    assert process.stderr is not None
    for line in process.stderr:
        if found := re.search(r"listening on ws://(\S+?)/devtools", line):
            with urllib.request.urlopen(f"http://{found[1]}/json", timeout=LIMIT_S) as answer:
                pages = [it for it in json.load(answer) if it["type"] == "page"]
            return str(pages[0]["webSocketDebuggerUrl"])
    raise AssertionError(f"the browser ended: {process.wait()}")
