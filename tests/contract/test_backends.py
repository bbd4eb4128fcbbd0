"""The page about further backends is true: its classes run as they stand there, and are all that is needed."""

import re
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch", reason="the networks' extra is not installed")

from support.images import textured

from mapless.geometry import Camera, RigidTransform
from mapless_server.method.coarse.network import NetworkOptions, NetworkReconstructor
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.features.views import Photograph, PosedView, View
from mapless_server.method.judge.answer import Localization
from mapless_server.method.localize import localize
from mapless_server.method.options import LocalizeOptions, Variant
from mapless_server.method.pipeline import Pipeline
from mapless_server.networks.runner import NetworkRunner

PAGE = Path(__file__).parents[2] / "docs" / "architecture" / "backends.md"
CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
DISTANCE_M = 3.0
WALL = textured(800, 240, seed=8)


def on_the_page(name: str) -> Any:
    """The class of this name, from the page's code."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (block,) = (it for it in blocks if f"class {name}" in it)
    names: dict[str, Any] = {}
    exec(block, names)
    return names[name]


def view_at(x_m: float) -> View:
    start = round(x_m * CAMERA.focal_x_px / DISTANCE_M)
    pixels = np.ascontiguousarray(WALL[:, start : start + CAMERA.width_px])
    view = SiftExtractor().extract(pixels, CAMERA)
    return View(view.camera, view.features, Photograph(lambda: f"at {x_m}", CAMERA, lambda: pixels))


def references() -> tuple[PosedView, ...]:
    return tuple(
        PosedView(
            f"key-{i}", f"scenes/wall/references/r{i}", view_at(x_m), RigidTransform(np.eye(3), np.array([x_m, 0, 0]))
        )
        for i, x_m in enumerate((0.0, 0.5, 1.0, 1.5))
    )


def position(backend: Any, variant: Variant) -> NDArray[np.float64]:
    answer = localize(view_at(0.6), references(), Pipeline(backend), LocalizeOptions(variant=variant))
    assert isinstance(answer.outcome, Localization), answer.outcome
    return answer.outcome.world_from_camera.translation


def test_the_pages_network_localizes() -> None:
    """It takes the pose of a reference; the rest of the method finds where between them the photograph was taken."""
    runner = NetworkRunner(on_the_page("MostAlike")(), "most-alike", "", "cpu")
    options = NetworkOptions(pixel_limit=20 * 14**2)
    with closing(NetworkReconstructor(runner, options)) as backend:
        coarse = position(backend, Variant.COARSE)
        assert min(abs(coarse[0] - it.world_from_camera.translation[0]) for it in references()) < 0.01
        assert position(backend, Variant.BEST) == pytest.approx([0.6, 0, 0], abs=0.01)
        assert backend.cache.counters.device_hits == 4, "the references' tokens were kept"


def test_the_pages_reconstructor_localizes() -> None:
    backend = on_the_page("WhereTheFirstIs")()
    assert position(backend, Variant.COARSE) == pytest.approx([0, 0, 0], abs=0.01)
    assert position(backend, Variant.BEST) == pytest.approx([0.6, 0, 0], abs=0.01)
