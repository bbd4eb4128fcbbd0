"""Learned features on real photographs: they localize what cheap features lose, and are used only then."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mapless_server.engine.query import Tier
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.judge.hypothesis import doubts_of
from mapless_server.method.ladder import STRENGTHENED
from mapless_server.method.localize import localize
from mapless_server.method.options import DoubtOptions, LocalizeOptions
from mapless_server.serve.features import make_tiers
from mapless_server.settings import Settings
from mapless_tools.dataset import Dataset

pytestmark = [pytest.mark.realdata, pytest.mark.timeout(300)]

WHITE_WALLS = "meeting-room"
SCENE = "7scenes-redkitchen-seq01-first600"
REFERENCES = (0, 200, 399, 599)
QUERIES = (18, 125, 99)
"""With four references SIFT is sure of the first of these, in doubt at the second, and loses the third."""


@pytest.fixture(scope="module")
def tiers(tmp_path_factory: pytest.TempPathFactory) -> tuple[Tier, ...]:
    pytest.importorskip("torch")
    weights = Path(os.environ.get("TEST_WEIGHTS", "nowhere"))
    if not (weights / "aliked-n16.safetensors").is_file():
        pytest.skip(f"needs `mapless-server weights fetch aliked`; {weights} has none (TEST_WEIGHTS names the folder)")
    # Without those of EdgePoint2, which would be the cheap ones.
    folder = tmp_path_factory.mktemp("data")
    (folder / "aliked-n16.safetensors").symlink_to(weights / "aliked-n16.safetensors")
    settings = Settings(features="auto", device="cpu", weights_dir=folder, data_dir=folder)
    return make_tiers(settings)


def test_strong_features_localize_what_cheap_ones_reject(
    photographs: Callable[[str], Dataset], tiers: tuple[Tier, ...]
) -> None:
    cheap, strong = (answers(photographs(SCENE), tier) for tier in tiers)
    doubtful = [bool(doubts_of(answer, DoubtOptions()) & STRENGTHENED) for answer in cheap]
    assert doubtful == [False, True, True]
    assert not isinstance(cheap[2].outcome, Localization)
    assert [error_m(photographs(SCENE), *pair) < 0.05 for pair in zip(QUERIES, strong, strict=True)] == [True] * 3


def test_light_glue_localizes_what_nearest_neighbours_reject(
    photographs: Callable[[str], Dataset], tmp_path: Path
) -> None:
    """Five photographs of a room with white walls; from one of the others next to no matches pass the ratio test."""
    pytest.importorskip("kornia")
    weights = Path(os.environ.get("TEST_WEIGHTS", "nowhere"))
    for name in ("aliked-n16", "aliked-lightglue"):
        if not (weights / f"{name}.safetensors").is_file():
            pytest.skip(f"needs `mapless-server weights fetch aliked aliked-lightglue`; {weights} has no {name}")
        (tmp_path / f"{name}.safetensors").symlink_to(weights / f"{name}.safetensors")
    dataset = photographs(WHITE_WALLS)
    with_light_glue = make_tiers(Settings(device="cpu", weights_dir=tmp_path, data_dir=tmp_path))[-1]
    (tmp_path / "aliked-lightglue.safetensors").unlink()
    without = make_tiers(Settings(device="cpu", weights_dir=tmp_path, data_dir=tmp_path))[-1]
    references = [posed(dataset, i, without) for i in (0, 10, 20, 29, 39)]
    query = view(dataset, 27, without)
    first, second = (localize(query, references, it.pipeline, LocalizeOptions()) for it in (without, with_light_glue))
    assert not isinstance(first.outcome, Localization)
    assert isinstance(second.outcome, Localization)
    true = dataset.frames[27].world_from_camera
    distance = np.linalg.norm(true.translation - dataset.frames[20].world_from_camera.translation)
    assert error_m(dataset, 27, second) < 0.05 * distance


def posed(dataset: Dataset, index: int, tier: Tier) -> PosedView:
    frame = dataset.frames[index]
    return PosedView(frame.name, frame.name, view(dataset, index, tier), frame.world_from_camera)


def answers(dataset: Dataset, tier: Tier) -> list[Answer]:
    """One tier's answer to each query, given all references."""
    references = [posed(dataset, i, tier) for i in REFERENCES]
    return [localize(view(dataset, i, tier), references, tier.pipeline, LocalizeOptions()) for i in QUERIES]


def view(dataset: Dataset, index: int, tier: Tier) -> View:
    frame = dataset.frames[index]
    return tier.extractor.extract(decode_image(frame.image_path.read_bytes(), ImageLimits()), frame.camera)


def error_m(dataset: Dataset, index: int, answer: Answer) -> float:
    """How far a pose is off; infinite without one."""
    if not isinstance(answer.outcome, Localization):
        return float("inf")
    true = dataset.frames[index].world_from_camera.translation
    return float(np.linalg.norm(answer.outcome.world_from_camera.translation - true))
