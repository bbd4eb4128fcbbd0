"""A loaded network on a device, run by one thread, in the precision and with the kernels that suit the device."""

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.torch_version import TorchVersion

from mapless_server.scheduling import count_helper

from .blocks import Attention
from .encoder import PATCH_PX
from .network import Network, NetworkOutput

T = TypeVar("T")


class UnsuitableDevice(ValueError):
    """The device cannot run a network; the message is for the operator."""


MAX_COMPILED_SHAPES = 64
"""Shapes after which torch stops compiling; grids and numbers of views make more than its default of eight."""


@dataclass(frozen=True)
class CompiledShape:
    """The shape of a batch for which a network is compiled before the first query.

    Attributes:
        grid: rows and columns of patches.
        views: number of views of a scene, the query included; all others are mapped.
        scenes: number of scenes that are reconstructed together.
    """

    grid: tuple[int, int]
    views: int
    scenes: int = 1


class NetworkRunner:
    """Runs a network. Safe to call from several threads; a thread of its own computes, in order of arrival.

    Attributes:
        name: one of `choices.NETWORKS`.
        weights_sha256: hash of the checkpoint.
        device: the device on which it computes.
        dtype: type of the computation in transformer blocks, and of tokens.
        conditioned: whether the network takes intrinsics and poses.
        metre_sigma: see Network.
    """

    def __init__(
        self,
        network: Network,
        name: str,
        weights_sha256: str,
        device: torch.device | str = "cpu",
        dtype: torch.dtype | None = None,
        compile_backend: str | None = None,
    ) -> None:
        """Makes a runner; raises UnsuitableDevice if the device lacks the kernels.

        Without `dtype` transformer blocks compute in bfloat16 on CUDA, as in the official code, else in float32. The
        shapes passed to `warm_up` are compiled by a backend of torch.compile, if any: "inductor" fuses the operations
        between matrix products, about a third of the time on a large GPU.
        """
        self.name = name
        self.weights_sha256 = weights_sha256
        self.device = torch.device(device)
        cuda = self.device.type == "cuda"
        self.dtype = dtype or (torch.bfloat16 if cuda else torch.float32)
        self.conditioned = network.conditioned
        self.metre_sigma = network.metre_sigma
        self.network = network.eval().requires_grad_(False)
        self.network.set_compute_type(self.dtype)
        self.network.to(self.device)
        self._warm: set[object] = set()
        self._layouts: dict[tuple[int, int], Any] = {}
        # CUDA graphs belong to the thread that recorded them.
        self._thread = ThreadPoolExecutor(1, f"network {name}", initializer=_keep_graphs_in_this_thread)
        self._check_kernels(name)
        self._encode, self._reconstruct = self._compiled(compile_backend)

    def _compiled(self, backend: str | None) -> tuple[Callable[..., Tensor], Callable[..., NetworkOutput]]:
        if backend is None:
            return self.network.encode, self.network.reconstruct
        # CUDA graphs spare the host the launches of kernels; other backends and devices have no such mode.
        graphs = backend == "inductor" and self.device.type == "cuda"
        compiled = partial(
            torch.compile,
            backend=backend,
            fullgraph=True,
            dynamic=False,
            options={"triton.cudagraphs": True} if graphs else None,
        )
        return compiled(self.network.encode), compiled(self.network.reconstruct)

    def _check_kernels(self, name: str) -> None:
        """Computes one tiny attention, so that a missing kernel fails now and not in every query."""
        token = torch.ones(1, 1, 1, 64, device=self.device, dtype=self.dtype)
        try:
            Attention.attend(token, token, token)
        except RuntimeError as error:
            raise UnsuitableDevice(f"{name} cannot run on {self.device}: no flash attention there ({error})") from error

    def close(self) -> None:
        """Ends the thread."""
        self._thread.shutdown()

    def warm_up(self, shapes: Sequence[CompiledShape]) -> None:
        """Compiles and runs these shapes; other shapes are run uncompiled."""
        for shape in shapes:
            self._thread.submit(self._warm_up, shape).result()

    def encode(self, images: Tensor, intrinsics: Tensor | None = None) -> Tensor:
        """Tokens of views, each computed alone, so that they can be cached.

        Args:
            images: (V, 3, H, W) float32 in [0, 1].
            intrinsics: (V, 3, 3) in pixels of the images, (0.5, 0.5) the centre of the top-left one; None for a network
                that is not conditioned.

        Returns:
            (V, T, C) on the device, in the compute type. Tokens are rounded here and not only in a cache, so cached and
            new tokens are equal. Views are encoded one at a time: kernels round differently for batches of another
            size, and a thousand tokens fill a device.
        """
        return self._run(self._encode_views, images, intrinsics)

    def reconstruct(
        self,
        tokens: Tensor,
        grid: tuple[int, int],
        mapped: int,
        poses: Tensor | None = None,
        posed: Tensor | None = None,
        metric: Tensor | None = None,
    ) -> NetworkOutput:
        """Computes poses of all views of each scene, and maps of the first ``mapped`` ones.

        Args:
            tokens: (B, N, T, C) from `encode`.
            grid: rows and columns of patches.
            mapped: M; see Network.reconstruct.
            poses: (B, N, 4, 4) world_from_camera, for a conditioned network, whose `conditions` says how it treats the
                unit and views without a pose.
            posed: (B, N) bool on the CPU, whether a view has a pose.
            metric: (B, N) bool on the CPU, whether its unit is the metre; None if all are.

        Raises:
            ValueError: the network cannot take poses of such views.
        """
        return self._run(self._reconstruct_scenes, tokens, grid, mapped, poses, posed, metric)

    def _run(self, work: Callable[..., T], *arguments: Any) -> T:
        result, seconds = self._thread.submit(self._timed, work, *arguments).result()
        count_helper(seconds)
        return result

    def _timed(self, work: Callable[..., T], *arguments: Any) -> tuple[T, float]:
        begin_s = time.thread_time()
        return self._without_gradients(work, *arguments), time.thread_time() - begin_s

    def _without_gradients(self, work: Callable[..., T], *arguments: Any) -> T:
        # Not inference_mode: for its tensors torch.compile would compile everything a second time.
        with torch.no_grad():
            return work(*arguments)

    def _layout(self, grid: tuple[int, int]) -> Any:
        if grid not in self._layouts:
            self._layouts[grid] = self.network.layout(grid)
        return self._layouts[grid]

    def _encode_views(self, images: Tensor, intrinsics: Tensor | None) -> Tensor:
        images = images.to(self.device, non_blocking=True)
        if intrinsics is not None:
            intrinsics = intrinsics.to(self.device, torch.float32, non_blocking=True)
        grid = (images.shape[2] // PATCH_PX, images.shape[3] // PATCH_PX)
        is_warm = ("encode", grid, intrinsics is not None) in self._warm
        encode = self._encode if is_warm else self.network.encode
        parts = []
        for view in range(len(images)):
            of_view = None if intrinsics is None else intrinsics[view : view + 1]
            tokens = encode(images[view : view + 1], self._layout(grid), of_view)
            # A recorded graph reuses its output's memory, and `to` alone copies only if the type changes.
            parts.append(tokens.to(self.dtype, copy=True))
        return torch.cat(parts)

    def _reconstruct_scenes(
        self,
        tokens: Tensor,
        grid: tuple[int, int],
        mapped: int,
        poses: Tensor | None,
        posed: Tensor | None,
        metric: Tensor | None,
    ) -> NetworkOutput:
        tokens = tokens.to(self.device, non_blocking=True)
        conditions = self._conditions(poses, posed, metric)
        reconstruct = self.network.reconstruct
        if self._shape(tokens, grid, mapped, conditions) in self._warm:
            reconstruct = self._reconstruct
        output = reconstruct(tokens, self._layout(grid), mapped, *conditions)
        return NetworkOutput(*(tensor.clone() for tensor in vars(output).values()))

    def _conditions(self, poses: Tensor | None, posed: Tensor | None, metric: Tensor | None) -> tuple[Tensor, ...]:
        """The network's conditions from the poses, on the device; empty if the poses are of no use to it."""
        if poses is None or posed is None:
            return ()
        metric = torch.ones_like(posed) if metric is None else metric
        poses = poses.to(self.device, torch.float32, non_blocking=True)
        conditions = self.network.conditions(poses, posed, metric) or ()
        return tuple(it.to(self.device, non_blocking=True) for it in conditions)

    @staticmethod
    def _shape(tokens: Tensor, grid: tuple[int, int], mapped: int, conditions: Sequence[Tensor]) -> object:
        """Everything that the compiled code depends on."""
        return ("reconstruct", grid, *tokens.shape[:2], mapped, *(it.shape for it in conditions))

    def _warm_up(self, shape: CompiledShape) -> None:
        height, width = (side * PATCH_PX for side in shape.grid)
        self._warm.add(("encode", shape.grid, self.conditioned))
        references = shape.views - 1
        posed = poses = None
        if self.conditioned:
            posed = torch.arange(shape.views).expand(shape.scenes, -1) < references
            poses = torch.eye(4).repeat(shape.scenes, shape.views, 1, 1)
            poses[..., 0, 3] = torch.arange(shape.views)
        with torch._dynamo.config.patch(recompile_limit=MAX_COMPILED_SHAPES):
            for _ in range(3):  # compiles, records, replays
                intrinsics = torch.eye(3)[None] if self.conditioned else None
                tokens = self._without_gradients(self._encode_views, torch.rand(1, 3, height, width), intrinsics)
                tokens = tokens.expand(shape.scenes, shape.views, -1, -1).contiguous()
                conditions = self._conditions(poses, posed, None)
                self._warm.add(self._shape(tokens, shape.grid, references, conditions))
                arguments = (tokens, shape.grid, references, poses, posed, None)
                self._without_gradients(self._reconstruct_scenes, *arguments)


def _keep_graphs_in_this_thread() -> None:
    """Reserves CUDA graphs for this thread: before torch 2.13 only the thread that first imports them can use them."""
    if TorchVersion(torch.__version__) < "2.13" and torch.cuda.is_available():
        from torch._inductor.cudagraph_trees import local

        local.tree_manager_containers, local.tree_manager_locks = {}, defaultdict(threading.Lock)
