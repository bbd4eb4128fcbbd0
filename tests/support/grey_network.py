"""A network of known output behind the real backend: a view's token is its mean grey; comparisons of results."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from mapless_server.method.coarse import Outcome
from mapless_server.method.coarse.network import NetworkOptions, NetworkReconstructor
from mapless_server.method.coarse.token_cache import TokenCacheOptions
from mapless_server.method.features.views import PosedView, Reconstruction, View
from mapless_server.networks.network import NetworkOutput
from mapless_server.networks.runner import NetworkRunner
from support.small_networks import PIXEL_LIMIT, photograph, references_of, view_of

torch.set_num_threads(1)  # its matrices are too small for more

OPTIONS = NetworkOptions(pixel_limit=PIXEL_LIMIT)
UNCACHED = NetworkOptions(pixel_limit=PIXEL_LIMIT, cache=TokenCacheOptions(0, 0))


@dataclass
class GreyRunner:
    """Stands in for a network: a view's token is its mean grey, and its pose lies there along x.

    Attributes:
        most_scenes: more at a time are out of memory.
        failing_batches: so many first calls of `reconstruct` are out of memory.
        failing_encodings: so many first calls of `encode` are out of memory.
        has_rays: whether each call of `encode` got intrinsics.
        given: poses, posed and metric of each call of `reconstruct`.
        encoded: views of each call of `encode`.
        batches: scenes of each call of `reconstruct`.
    """

    name: str = "grey"
    weights_sha256: str = "none"
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    dtype: torch.dtype = torch.float32
    conditioned: bool = False
    metre_sigma: float | None = None
    most_scenes: int = 100
    failing_batches: int = 0
    failing_encodings: int = 0
    has_rays: list[bool] = field(default_factory=list)
    given: list[tuple[torch.Tensor | None, ...]] = field(default_factory=list)
    encoded: list[int] = field(default_factory=list)
    batches: list[int] = field(default_factory=list)

    def encode(self, images: torch.Tensor, intrinsics: torch.Tensor | None = None) -> torch.Tensor:
        self.encoded.append(len(images))
        self.has_rays.append(intrinsics is not None)
        if len(self.encoded) <= self.failing_encodings:
            raise torch.OutOfMemoryError("no room to encode")
        return images.mean((1, 2, 3))[:, None, None]

    def reconstruct(self, tokens: torch.Tensor, grid: tuple[int, int], mapped: int, *given: Any) -> NetworkOutput:
        scenes, views = tokens.shape[:2]
        self.given.append(given)
        self.batches.append(scenes)
        if scenes > self.most_scenes or len(self.batches) <= self.failing_batches:
            raise torch.OutOfMemoryError("no room to reconstruct")
        poses = torch.eye(4).repeat(scenes, views, 1, 1)
        poses[:, :, 0, 3] = 255 * tokens[..., 0, 0]
        maps = (scenes, mapped, 14 * grid[0], 14 * grid[1])
        return NetworkOutput(torch.ones(*maps, 3) * poses[:, :mapped, 0, 3, None, None, None], torch.zeros(maps), poses)


def grey_request(*greys: int, size: tuple[int, int] = (96, 72)) -> tuple[View, tuple[PosedView, ...]]:
    """A query of the first grey, references of the others."""
    photos = [photograph(np.full((size[1], size[0], 3), grey, np.uint8)) for grey in greys]
    return view_of(photos[0]), references_of(photos[1:])


def grey_backend(runner: GreyRunner, options: NetworkOptions = OPTIONS) -> NetworkReconstructor:
    return NetworkReconstructor(cast(NetworkRunner, runner), options)


def greys_of(outcome: Outcome | Exception) -> list[int]:
    """The greys in the network's output: the query's, then the references'."""
    assert isinstance(outcome, Reconstruction)
    views = (outcome.query, *outcome.references)
    for view in outcome.references:
        np.testing.assert_allclose(view.point_map, view.local_from_camera.translation[0], atol=1e-3)
    return [round(view.local_from_camera.translation[0]) for view in views]


def arrays_of(outcome: Outcome | Exception) -> list[NDArray[np.floating]]:
    assert isinstance(outcome, Reconstruction)
    views = (*outcome.references, outcome.query)
    return [
        *(view.point_map for view in outcome.references),
        *(view.confidence for view in outcome.references),
        *(view.local_from_camera.matrix() for view in views),
    ]


def assert_same_bits(actual: Outcome | Exception, expected: Outcome | Exception) -> None:
    for one, other in zip(arrays_of(actual), arrays_of(expected), strict=True):
        np.testing.assert_array_equal(one, other)


def assert_close(actual: Outcome | Exception, expected: Outcome | Exception, relative: float = 2e-4) -> None:
    """To this part of the largest value of each array."""
    for one, other in zip(arrays_of(actual), arrays_of(expected), strict=True):
        np.testing.assert_allclose(one, other, atol=relative * float(np.abs(other).max()))
