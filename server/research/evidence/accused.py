"""How surely a photograph must contradict its intrinsics before they are accused: right intrinsics, and planted errors.

Photographs of all scenes are localized in this process, by the ladder, among all others of their scene and among ten of
them, with 3, 5 and 10 references, each with its right intrinsics or with a planted error. What the checks find is
recorded, so that one pass says at which bounds the intrinsics are accused.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np

from mapless.geometry import Camera
from mapless.lenses import RadialTangential
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method import significance
from mapless_server.method.bundle.intrinsics import ContradictionOptions
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.features.extractors import make_extractor
from mapless_server.method.features.matching import OPTIONS
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.judge import cameras
from mapless_server.method.judge.hints import hinted
from mapless_server.method.localize import localize
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pairs.make import make_matcher
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.rejection import IntrinsicsCheck, IntrinsicsParameter
from mapless_tools.dataset import Dataset
from mapless_tools.evaluate.plan import evenly_spread
from mapless_tools.evaluate.references import choose_references
from mapless_tools.ingest.formats.cameras import read_folder

from .page import Measurement, Row

SPARSE, KS, WINDOW = 10, (3, 5, 10), 40
"""References of a sparse scene; how many are used; frames around the query that are looked through in a dense one."""

EACH = {"right": 2, "planted": 1}
"""Photographs of each scene, each of which is asked in six forms."""


def _focal(factor: float) -> Callable[[Camera], Camera]:
    return lambda it: replace(it, focal_x_px=factor * it.focal_x_px, focal_y_px=factor * it.focal_y_px)


def _lens(k1: float) -> Callable[[Camera], Camera]:
    return lambda it: replace(it, distortion=(it.distortion or RadialTangential()).bent(k1))


def _sides(it: Camera) -> Camera:
    """The intrinsics of the photograph turned by a quarter."""
    fx, fy, x, y = it.focal_x_px, it.focal_y_px, it.principal_x_px, it.principal_y_px
    return replace(it, focal_x_px=fy, focal_y_px=fx, principal_x_px=y, principal_y_px=x)


def _size(factor: float) -> Callable[[Camera], Camera]:
    """The intrinsics of the photograph in another size."""

    def change(it: Camera) -> Camera:
        x, y = factor * (it.principal_x_px + 0.5) - 0.5, factor * (it.principal_y_px + 0.5) - 0.5
        return replace(_focal(factor)(it), principal_x_px=x, principal_y_px=y)

    return change


def _moved(share: float) -> Callable[[Camera], Camera]:
    return lambda it: replace(it, principal_x_px=it.principal_x_px + share * it.width_px)


RIGHT = "right"
PLANTED: dict[str, Callable[[Camera], Camera]] = {
    "focal 0.75": _focal(0.75),
    "focal 0.87": _focal(0.87),
    "focal 1.15": _focal(1.15),
    "focal 1.3": _focal(1.3),
    "k1 -0.2": _lens(-0.2),
    "k1 +0.2": _lens(0.2),
    "sides exchanged": _sides,
    "half the size": _size(0.5),
    "1.5 times the size": _size(1.5),
    "principal point off by 10 %": _moved(0.1),
}


class Asked(NamedTuple):
    """A photograph with the intrinsics that are planted, in a scene that is dense or sparse, with K references."""

    scene: str
    frame: int
    density: str
    k: int
    planted: str


class Scenes:
    """Photographs of the folders, with SIFT features."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.extractor = folder, make_extractor("sift")
        self.pipeline = Pipeline(make_reconstructor("geometric", Path()), make_matcher("sift"))
        self.view_of = cache(self._view_of)
        self.dataset = cache(self._dataset)

    @property
    def names(self) -> list[str]:
        """The folders with photographs that have poses."""
        return sorted(it.parent.name for it in self.folder.glob("*/cameras.json"))

    def _dataset(self, scene: str) -> Dataset:
        return read_folder(self.folder / scene)

    def _view_of(self, scene: str, index: int, planted: str = RIGHT) -> View:
        frame = self.dataset(scene).frames[index]
        camera = PLANTED[planted](frame.camera) if planted != RIGHT else frame.camera
        return self.extractor.extract(decode_image(frame.image_path.read_bytes(), ImageLimits()), camera)

    def references(self, asked: Asked) -> list[PosedView]:
        """The references that share most with a photograph as it is."""
        frames, most = self.dataset(asked.scene).frames, max(KS)
        if asked.density == "sparse":
            indices = [it for it in evenly_spread(range(len(frames)), SPARSE + 1) if it != asked.frame]
        else:
            near = range(max(0, asked.frame - WINDOW), min(len(frames), asked.frame + WINDOW + 1))
            indices = evenly_spread([it for it in near if it != asked.frame], 2 * most)
        posed = [self._posed(asked.scene, it) for it in indices]
        query = self.view_of(asked.scene, asked.frame)
        chosen = choose_references(query, posed, asked.k, ratio=OPTIONS["sift"].query_ratio)
        return [posed[it] for it in chosen]

    def _posed(self, scene: str, index: int) -> PosedView:
        pose = self.dataset(scene).frames[index].world_from_camera
        return PosedView(f"{scene}-{index}", f"scenes/{scene}/references/{index}", self.view_of(scene, index), pose)

    def least(self, asked: Asked) -> float:
        """The least log10 of the chance of all checks that could accuse the intrinsics of a photograph."""
        view, references = self.view_of(asked.scene, asked.frame, asked.planted), self.references(asked)
        found = list[float]()

        def recorded(compared: cameras.Comparison) -> bool:
            found.append(significance.log10_chance(compared.sigmas, compared.tested))
            return significance.is_significant(compared.sigmas, compared.tested)

        with patch.object(cameras.Comparison, "is_significant", property(recorded)):
            answer = hinted(localize(view, references, self.pipeline, LocalizeOptions()), view, references)
        checks = answer.outcome.intrinsics_checks
        if len(checks) == len(IntrinsicsParameter):  # of another camera only those that differ are named
            found += [_chance(it, view.camera.width_px) for it in checks]
        return min(found, default=0.0)


def _chance(check: IntrinsicsCheck, width_px: int) -> float:
    """log10 of the chance of an estimated parameter; 0 if the photograph does not determine it."""
    options = ContradictionOptions()
    most = {
        IntrinsicsParameter.FOCAL_LENGTH: options.focal_share * check.given,
        IntrinsicsParameter.K1: options.k1,
    }.get(check.parameter, options.principal_share * width_px)
    if check.estimated_sigma >= most:
        return 0.0
    sigmas = abs(check.estimated - check.given) / float(np.hypot(check.estimated_sigma, check.given_sigma))
    return significance.log10_chance(sigmas / significance.HEAVY_TAIL, len(IntrinsicsParameter))


def asked_of(scenes: Scenes, each: int, planted: Sequence[str]) -> Iterator[Asked]:
    """So many photographs of each scene, evenly spread, in all forms; of planted errors one each."""
    for number, scene in enumerate(scenes.names):
        count = len(scenes.dataset(scene).frames)
        inner = [it for it in range(count) if it not in evenly_spread(range(count), SPARSE + 1)] or list(range(count))
        for j, frame in enumerate(evenly_spread(inner, each)):
            forms = [(density, k) for density in ("dense", "sparse") for k in KS]
            for i, (density, k) in enumerate(forms):
                kind = planted[(number * each * len(forms) + j * len(forms) + i) % len(planted)]
                yield Asked(scene, frame, density, k, kind)


BOUNDS = (-1.0, -2.0, -3.0, -3.5, -4.0, -4.5, -5.0, -6.0, -8.0, -10.0)


def _rows(folder: Path) -> Iterator[Row]:
    scenes = Scenes(folder)
    right, planted = (
        [scenes.least(it) for it in asked_of(scenes, each, kinds)]
        for each, kinds in zip(EACH.values(), ([RIGHT], list(PLANTED)), strict=True)
    )
    scenes.pipeline.matcher.close()
    for bound in BOUNDS:
        yield {
            "bound": f"**{bound:g}**" if bound == significance.MAX_LOG10_CHANCE else f"{bound:g}",
            f"of {len(right)} right: accused": sum(it <= bound for it in right),
            f"of {len(planted)} planted: named": sum(it <= bound for it in planted),
        }


MEASUREMENTS = {"accusation-chance": Measurement(_rows)}
