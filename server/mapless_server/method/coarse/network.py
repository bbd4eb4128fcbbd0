"""The coarse stage by a network: pi^3, the paper's, or Pi3X or MapAnything, which take intrinsics and known poses, too.

    photographs > pictures > tokens > network > Reconstruction
      (views)    (grids)  (cached for           (copied to
                           references)           the host)

The output of a network is known up to a similarity, also if it was given poses: the scale stage aligns it.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from mapless.geometry import Array, RigidTransform
from mapless_server.bounds import check_bounds
from mapless_server.networks.encoder import PATCH_PX
from mapless_server.networks.network import NetworkOutput
from mapless_server.networks.runner import NetworkRunner

from ..features.views import Photograph, PosedView, ReconstructedView, Reconstruction, View
from ..rejection import Rejection, RejectionReason
from . import Outcome, Request
from .grids import PIXEL_LIMIT, Grid, Layout, common_grid, lay_out
from .token_cache import TokenCache, TokenCacheOptions, TokenKey

log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True)
class NetworkOptions:
    """Options of a network's backend.

    Attributes:
        pixel_limit: largest number of pixels of a picture.
        cache: tokens of references.
    """

    pixel_limit: int = PIXEL_LIMIT
    cache: TokenCacheOptions = field(default_factory=TokenCacheOptions)

    def __post_init__(self) -> None:
        check_bounds(self, "pixel_limit", at_least=PATCH_PX**2)


class NetworkReconstructor:
    """A `Reconstructor`; safe to use from several threads.

    Attributes:
        cache: tokens of references; its counters are read by the metrics.
    """

    uses_correspondences = False
    is_batched = True

    def __init__(self, runner: NetworkRunner, options: NetworkOptions | None = None) -> None:
        self._runner = runner
        self._options = options or NetworkOptions()
        on_host = runner.device.type == "cpu"
        cache = self._options.cache
        self.cache = TokenCache(runner.device, replace(cache, host_bytes=0) if on_host else cache)

    @property
    def name(self) -> str:
        """Name of the network."""
        return self._runner.name

    @property
    def weights_sha256(self) -> str:
        """SHA-256 of the network's weights."""
        return self._runner.weights_sha256

    def close(self) -> None:
        """Ends the network's thread."""
        self._runner.close()

    def bucket(self, query: View, references: Sequence[PosedView]) -> str:
        """See Reconstructor.bucket."""
        grid = _Scene.of(Request(query, references), self._options).grid
        return f"{self.name}-{grid.rows}x{grid.columns}-{len(references)}"

    def reconstruct_many(self, requests: Sequence[Request]) -> list[Outcome | Exception]:
        """See Reconstructor.reconstruct_many: requests of the same grid and number of references are computed together.

        An outcome can be ValueError if a view has no photograph, torch.OutOfMemoryError if the memory does not suffice
        for this query alone, or RequestError if a reference's photograph cannot be read any more.
        torch.OutOfMemoryError is raised if the memory does not suffice for so many queries.
        """
        try:
            return self._reconstruct_many(requests)
        except torch.OutOfMemoryError as error:
            if len(requests) > 1:
                raise
            return [error]

    def _reconstruct_many(self, requests: Sequence[Request]) -> list[Outcome | Exception]:
        outcomes: list[Outcome | Exception | None] = [None] * len(requests)
        batches: dict[tuple[Grid, int], list[tuple[int, _Scene]]] = defaultdict(list)
        encoded: dict[TokenKey, Tensor] = {}
        for i, request in enumerate(requests):
            if not request.references:
                outcomes[i] = Rejection(RejectionReason.NO_USABLE_REFERENCES, "no references")
                continue
            try:
                scene = _Scene.of(request, self._options)
                tokens = self._with_room(partial(self._encode, scene, encoded))
            except torch.OutOfMemoryError:
                raise
            except Exception as error:  # an error of one request does not fail the others
                outcomes[i] = error
            else:
                batches[scene.grid, len(request.references)].append((i, replace(scene, tokens=tokens)))
        for batch in batches.values():
            indices, scenes = zip(*batch, strict=True)
            for i, outcome in zip(indices, self._with_room(partial(self._run, scenes)), strict=True):
                outcomes[i] = outcome
        return [outcome for outcome in outcomes if outcome is not None]

    def _with_room(self, work: Callable[[], T]) -> T:
        """Calls `work`; if the memory does not suffice, releases the cache's device memory and calls it again."""
        try:
            return work()
        except torch.OutOfMemoryError as error:
            log.warning("%s: tokens make room: %s", self.name, str(error))
        # Outside the handler nothing refers to the tensors of the failed attempt.
        self.cache.release_device()
        if self._runner.device.type == "cuda":
            torch.cuda.empty_cache()
        return work()

    def _run(self, scenes: Sequence[_Scene]) -> list[Outcome]:
        """Reconstructs encoded scenes that have the same grid and number of views."""
        grid, references = scenes[0].grid, scenes[0].references
        poses = posed = metric = None
        if self._runner.conditioned:
            known = np.stack([condition_poses([r.world_from_camera for r in it.references]) for it in scenes])
            poses = torch.from_numpy(known.astype(np.float32))
            posed = (torch.arange(len(references) + 1) < len(references)).repeat(len(scenes), 1)
            # Poses at one place have no size that could be in metres.
            metric = torch.tensor([it.is_metric for it in scenes]) & poses[:, 1:-1, :3, 3].any(-1).any(-1)
            metric = metric[:, None].expand_as(posed)
        tokens = torch.stack([of_view for it in scenes for of_view in it.tokens]).unflatten(0, (len(scenes), -1))
        output = self._runner.reconstruct(tokens, (grid.rows, grid.columns), len(references), poses, posed, metric)
        return [self._outcome(it, output, index) for index, it in enumerate(scenes)]

    def _encode(self, scene: _Scene, encoded: dict[TokenKey, Tensor]) -> tuple[Tensor, ...]:
        """Returns the tokens (T, C) of each of a scene's views, and adds those of views that are not in `encoded`."""
        keys = [self._key(view) for view in scene.views]
        for key, view in zip(keys, scene.views, strict=True):
            if key in encoded:
                continue
            is_query = view is scene.views[-1]
            tokens = None if is_query else self.cache.get(key)
            if tokens is None:
                tokens = self._encode_view(view)
                if not is_query:
                    self.cache.put(key, tokens)
            encoded[key] = tokens
        return tuple(encoded[key] for key in keys)

    def _encode_view(self, view: _LaidOut) -> Tensor:
        """Computes the tokens (T, C) of a view."""
        picture = torch.from_numpy(view.layout.picture(view.photograph.read()))
        intrinsics = None
        if self._runner.conditioned:
            intrinsics = torch.from_numpy(view.layout.intrinsics.astype(np.float32))[None]
        return self._runner.encode(_on_device(picture[None], self._runner.device), intrinsics)[0]

    def _key(self, view: _LaidOut) -> TokenKey:
        runner, layout, photograph = self._runner, view.layout, view.photograph
        return TokenKey(
            runner.name,
            runner.weights_sha256,
            runner.dtype,
            photograph.sha256,
            photograph.camera,
            layout.grid,
            layout.camera,
        )

    def _outcome(self, scene: _Scene, output: NetworkOutput, index: int) -> Outcome:
        tensors = output.local_points, output.confidence_logits, output.camera_poses
        points, logits, poses = (tensor[index].float() for tensor in tensors)
        *layouts, of_query = (view.layout for view in scene.views)
        parts = points, _without_filling(logits.sigmoid(), scene.views[:-1]), poses
        flat = torch.cat([part.reshape(-1) for part in parts]).cpu().numpy()  # in one transfer
        if not np.isfinite(flat).all():
            log.warning("%s: the network's output is not finite", self.name)
            return Rejection(RejectionReason.SCALE_UNRELIABLE, f"the output of the network {self.name} is not finite")
        ends = np.cumsum([part.numel() for part in parts])
        point_maps, confidence, matrices = (
            values.reshape(part.shape) for values, part in zip(np.split(flat, ends[:-1]), parts, strict=True)
        )
        local_from_camera = [RigidTransform(pose[:3, :3], pose[:3, 3]) for pose in matrices.astype(np.float64)]
        size = of_query.grid.height_px, of_query.grid.width_px
        unknown = np.full((*size, 3), np.nan, np.float32), np.zeros(size, np.float32)  # the query's maps
        views = zip(layouts, point_maps, confidence, local_from_camera[:-1], strict=True)
        return Reconstruction(
            ReconstructedView(of_query.camera, *unknown, local_from_camera[-1]),
            tuple(ReconstructedView(layout.camera, points, trust, pose) for layout, points, trust, pose in views),
            self._runner.metre_sigma if scene.is_metric else None,
        )


@dataclass(frozen=True, eq=False)
class _LaidOut:
    """A view's photograph, and its layout on the scene's grid."""

    photograph: Photograph
    layout: Layout


@dataclass(frozen=True, eq=False)
class _Scene:
    """One request: grid, references, all views with the query last, and whether the unit is the metre.

    `tokens` (T, C) of each view, once they are encoded, may be shared with other scenes of a batch.
    """

    grid: Grid
    references: Sequence[PosedView]
    views: tuple[_LaidOut, ...]
    is_metric: bool
    tokens: tuple[Tensor, ...] = ()

    @classmethod
    def of(cls, request: Request, options: NetworkOptions) -> _Scene:
        """Makes the scene of a request; raises ValueError if a view has no photograph."""
        references = [_photograph(reference.view, reference.name) for reference in request.references]
        query = _photograph(request.query, "the query")
        grid = common_grid([photograph.camera for photograph in references], options.pixel_limit)
        views = (
            _LaidOut(photograph, lay_out(photograph.camera, grid, options.pixel_limit))
            for photograph in (*references, query)
        )
        return cls(grid, request.references, tuple(views), request.is_metric)


def _photograph(view: View, name: str) -> Photograph:
    if view.photograph is None:
        raise ValueError(f"{name} has no photograph, which a network needs")
    return view.photograph


def _without_filling(confidence: Tensor, views: Sequence[_LaidOut]) -> Tensor:
    """Confidence (K, H, W), set to 0 at pixels that do not show the photograph, or that its mask ignores."""
    parts = [it.layout.shown_without(it.photograph.read_ignored()) for it in views]
    if all(part is None for part in parts):
        return confidence
    everywhere = np.ones(confidence.shape[1:], bool)
    shown = np.stack([everywhere if part is None else part for part in parts])
    return torch.where(_on_device(torch.from_numpy(shown), confidence.device), confidence, 0.0)


def _on_device(tensor: Tensor, device: torch.device) -> Tensor:
    """Moves a tensor to the device; copies from pinned memory, so that the host does not wait."""
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor


def condition_poses(world_from_references: Sequence[RigidTransform]) -> Array:
    """Poses (K + 1, 4, 4) of the K references, at least one, and of a placeholder for the query, relative to the first.

    Pi3X normalizes by the mean distance of all views from the first, whether their poses are used or not: the
    placeholder, in an arbitrary direction at the mean distance of the other references, does not change that mean.
    Differences of world coordinates, which may be large, are taken here, in double precision.
    """
    first = world_from_references[0]
    # Differences first: references at one place are exactly there, which MapAnything's scale depends on.
    relative = [
        RigidTransform(first.rotation.T @ it.rotation, first.rotation.T @ (it.translation - first.translation))
        for it in world_from_references
    ]
    distances_m = [float(np.linalg.norm(pose.translation)) for pose in relative[1:]]
    neutral_m = float(np.mean(distances_m)) if distances_m else 0.0
    placeholder = RigidTransform(np.eye(3), np.array([neutral_m, 0.0, 0.0]))
    return np.stack([pose.matrix() for pose in (*relative, placeholder)])
