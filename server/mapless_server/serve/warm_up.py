"""Localizes a photograph before the first call: detects failures at the start, and does what is slow the first time.

The photographs are rendered: two walls with random patterns, one before the other, from four camera centres.
"""

import asyncio
import hashlib
import logging
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera, RigidTransform
from mapless_server.engine.query import Caller, Photo, Query, SceneQuestion, Tier
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.views import Photograph, PosedView
from mapless_server.method.judge.answer import Localization
from mapless_server.method.options import LocalizeOptions, StageContext
from mapless_server.scenes import Choice, Narrowing, RankedReference
from mapless_server.scenes.library import Loaded
from mapless_server.scheduling import Flow
from mapless_server.security import SceneKey
from mapless_server.store import SceneAttributes, SceneState

from .deferred import Deferred
from .idle import until_idle

log = logging.getLogger(__name__)

ROUNDS = 2
"""The first loads what a query needs, with a small photograph, and its times are discarded; the second gives the queue
the usual time of a query."""

MAX_ERROR_M = 0.1
"""The scene is easy: a larger error means a failure."""

_LIMIT_S = 600.0  # networks may be compiled by the first photograph
_CAMERA = Camera(640, 480, 520.0, 520.0, 319.5, 239.5)
_SMALL_CAMERA = _CAMERA.resized(320, 240)
"""Camera of the references and the first query: describing these costs a quarter."""
_CENTRES_X_M = (-0.6, 0.0, 0.6)
_QUERY_X_M = 0.25
_WALLS = ((4.0, 4.0), (2.5, 0.8))
"""Distance and half the side of each, metres, the furthest first."""
_TEXTURE_PX = 512


class WarmUpFailed(Exception):
    """The localization gave no pose, or a wrong one."""


async def warm_up(engine: QueueEngine) -> None:
    """Localizes until the queue can predict the time of a query; raises WarmUpFailed if the answer is wrong."""
    # Outside the queue, because describing references is no part of a usual query.
    first = engine.tiers[0]
    references = await asyncio.to_thread(_RenderedReferences, first.extractor)
    query_pose = _pose(_QUERY_X_M)
    for number, camera in enumerate((_SMALL_CAMERA, _CAMERA)):
        query = Query(
            scene_key=SceneKey("warm-up"),
            reference_ids=tuple(f"r{i}" for i in range(len(_CENTRES_X_M))),
            photo=Photo(await asyncio.to_thread(_photograph, query_pose, camera), camera, "image"),
            narrowing=Narrowing(),
            reference_count=len(_CENTRES_X_M),
            options=LocalizeOptions(),
        )
        # Without a tenant, so that no quota is charged.
        caller = Caller(Flow("", "warm-up"), time.monotonic() + _LIMIT_S)
        result = await engine.run(engine.query_job(query, caller, references))
        outcome = result.answer.outcome
        if not isinstance(outcome, Localization):
            raise WarmUpFailed(f"an easy photograph was rejected: {outcome.message}")
        error_m = float(np.linalg.norm(outcome.world_from_camera.translation - query_pose.translation))
        if error_m > MAX_ERROR_M:
            raise WarmUpFailed(f"an easy photograph was placed {error_m:.2f} m off")
        if number == 0:
            engine.queue.forget_costs()
    if first.pipeline.matcher.pair_matching is not None:
        await _time_pair(first)


async def warm_up_stronger(engine: QueueEngine, quiet_s: float) -> None:
    """Uses the features of the later tiers once, when nothing was computed for `quiet_s`; raises what makes them fail.

    They answer only where the first tier is in doubt. Those that are deferred are left out: torch takes 340 MB, and as
    long to load as the whole start. The first photograph or work in the background that needs them loads them.
    """
    for tier in engine.tiers[1:]:
        await until_idle(engine.queue, quiet_s)
        if not isinstance(tier.extractor, Deferred):
            await _time_pair(tier)


async def _time_pair(tier: Tier) -> None:
    """Describes two references and measures the time of a pair, by which queries compute how many they have time for.

    The two are the farthest apart. In short steps, because a server that ends waits for the one that is computed.
    """
    matcher, numbers = tier.pipeline.matcher, (0, len(_CENTRES_X_M) - 1)
    first, second = [await asyncio.to_thread(_reference, tier.extractor, number) for number in numbers]
    for _ in range(ROUNDS if matcher.pair_matching is not None else 0):
        matcher.pair_s = None
        await asyncio.to_thread(matcher.rematch, first.view, second)


class _RenderedReferences:
    """Rendered references in place of the store's."""

    def __init__(self, extractor: FeatureExtractor) -> None:
        self._views: dict[tuple[str, int], PosedView] = {}
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(partial(self._view, extractor), range(len(_CENTRES_X_M))))

    def load(
        self,
        scene_key: SceneKey,
        reference_ids: Sequence[str],
        extractor: FeatureExtractor,
        context: StageContext,
    ) -> Loaded:
        """See ReferenceSource."""
        return SceneState(1, 0, SceneAttributes), tuple(self._view(extractor, i) for i in range(len(_CENTRES_X_M)))

    def _view(self, extractor: FeatureExtractor, number: int) -> PosedView:
        key = extractor.name, number
        if key not in self._views:
            self._views[key] = _reference(extractor, number)
        return self._views[key]

    def contradiction(self, scene_key: SceneKey) -> str:
        """See ReferenceSource."""
        return ""

    def pending(self, scene_key: SceneKey) -> tuple[()]:
        """See ReferenceSource."""
        return ()

    def choose(self, *_: object) -> Choice:
        """See ReferenceSource."""
        raise NotImplementedError("the warm-up names its references")

    def choose_among(self, *_: object) -> Sequence[tuple[SceneQuestion, Sequence[RankedReference]]]:
        """See ReferenceSource."""
        raise NotImplementedError("the warm-up has one scene")

    def sample(self, *_: object) -> Sequence[str]:
        """See ReferenceSource."""
        raise NotImplementedError("the warm-up names its references")

    def report_damaged(self, *_: object) -> None:
        """See ReferenceSource."""
        raise NotImplementedError("what is rendered is not damaged")


def _photograph(world_from_camera: RigidTransform, camera: Camera) -> bytes:
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(_render(world_from_camera, camera), cv2.COLOR_RGB2BGR))
    return jpeg.tobytes()


def _reference(extractor: FeatureExtractor, number: int) -> PosedView:
    name, world_from_camera = f"r{number}", _pose(_CENTRES_X_M[number])
    pixels = _render(world_from_camera, _SMALL_CAMERA)
    photograph = Photograph(lambda: hashlib.sha256(pixels.tobytes()).hexdigest(), _SMALL_CAMERA, lambda: pixels)
    view = replace(extractor.extract(pixels, _SMALL_CAMERA), photograph=photograph)
    return PosedView(name, name, view, world_from_camera)


def _pose(x_m: float) -> RigidTransform:
    """Pose world_from_camera of a camera on a line along the walls, turned a little towards their middle."""
    rotation, _ = cv2.Rodrigues(np.array([0.0, -0.15 * x_m, 0.0]))
    return RigidTransform(np.asarray(rotation, np.float64), np.array([x_m, 0.1 * x_m, 0.0]))


def _render(world_from_camera: RigidTransform, camera: Camera) -> NDArray[np.uint8]:
    """The camera's image of the walls, (H, W, 3) RGB."""
    canvas = np.zeros((camera.height_px, camera.width_px, 3), np.uint8)
    camera_from_world = world_from_camera.inverse()
    for seed, (distance_m, half_side_m) in enumerate(_WALLS):
        texture = _texture(seed)
        corners = half_side_m * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) + [0, 0, distance_m]
        seen = camera.project(camera_from_world.apply(corners))
        end = _TEXTURE_PX - 1
        of_texture = np.array([[0, 0], [end, 0], [end, end], [0, end]], np.float32)
        homography = cv2.getPerspectiveTransform(of_texture, seen.astype(np.float32))
        size = (camera.width_px, camera.height_px)
        picture = cv2.warpPerspective(texture, homography, size, flags=cv2.INTER_LINEAR)
        covers = cv2.warpPerspective(np.full(texture.shape[:2], 255, np.uint8), homography, size) > 127
        canvas[covers] = picture[covers]
    return canvas


@cache
def _texture(seed: int) -> NDArray[np.uint8]:
    """Smooth noise at three scales, (512, 512, 3)."""
    random = np.random.default_rng(seed)
    layers = [
        cv2.resize(random.uniform(0, 255, (size, size, 3)), (_TEXTURE_PX, _TEXTURE_PX), interpolation=cv2.INTER_CUBIC)
        for size in (16, 64, 128)
    ]
    return np.asarray(np.clip(np.mean(layers, axis=0) * 1.5 - 64, 0, 255), np.uint8)
