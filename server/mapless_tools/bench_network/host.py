"""Measurements without a CUDA device: operations, time of a block, effects of rounding and of kept tokens."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from torch import Tensor

from mapless_server.method.choices import NETWORKS
from mapless_server.networks.mapanything import MapAnythingSizes
from mapless_server.networks.network import Network, NetworkOutput
from mapless_server.networks.pi3 import PiNetwork, Sizes
from mapless_server.networks.runner import CompiledShape, NetworkRunner, RunnerOptions

from .device import CACHED, median_s
from .forward import max_difference
from .operations import H200, Operations, Rates, compiled_graphs, count_operations
from .report import Figure
from .subject import GRID, REFERENCES, AnySizes, Scene, Work, make_network, meta_network, operations_of

VIEWS = REFERENCES + 1
GRIDS = {"518x392": GRID, "504x378": (27, 36), "392x294": (21, 28)}
WORKS = {
    "everything": Work(VIEWS, VIEWS),
    "references mapped": Work(VIEWS, REFERENCES),
    "references' tokens kept, references mapped": Work(1, REFERENCES),
    "references' tokens kept, cameras only": Work(1, 0),
    "references' tokens kept, the query's camera only": Work(1, 0, query_only=True),
}
SMALL_PI = Sizes(64, 4, 3, 10, 2, 32, (64, 32, 16), 8, 32, 2, 2)
SMALL: dict[str, AnySizes] = {
    "pi3": SMALL_PI,
    "pi3x": SMALL_PI,
    "mapanything": MapAnythingSizes(64, 4, 3, 4, 6, (1, 3), (32, 32), (16, 32), (8, 8, 16, 16), 16, 8, 32, 16),
}
MEDIUM = Sizes(384, 6, encoder_depth=8, decoder_depth=12, head_depth=3, camera_width=128)


def count_all(rates: Rates, quick: bool) -> Iterator[Figure]:
    """Counts operations of forward passes and of the layers for each pixel, and bytes on the device."""
    yield from count_forward(rates, quick)
    yield from count_memory()
    yield from count_pixel_heads()


def count_forward(rates: Rates = H200, quick: bool = False) -> Iterator[Figure]:
    """Counts operations of forward passes of the official networks; yields the least and the predicted times."""
    for name in NETWORKS:
        for size, grid in GRIDS.items():
            if quick and grid is not GRID:
                continue
            part = f"{name}, {VIEWS} views of {size}; times are those of {rates.device}, compiled"
            for label, work in WORKS.items():
                if work.query_only and name != "mapanything":
                    continue
                operations = operations_of(name, replace(work, grid=grid))
                yield _counted(part, label, operations, rates)


def _counted(part: str, label: str, operations: Operations, rates: Rates) -> Figure:
    floor_ms, predicted_ms = 1e3 * operations.floor_s(rates), 1e3 * operations.predicted_s(rates, True)
    note = (
        f"eager {1e3 * operations.predicted_s(rates, False):.0f} ms; "
        f"attention {operations.attention_flop / 1e12:.2f} TFLOP, "
        f"in float32 {(operations.tf32_flop + operations.float32_flop) / 1e12:.2f}; "
        f"{operations.kernels} kernels, {operations.eager_bytes / 1e9:.0f} GB between products, "
        f"{operations.fused_bytes / 1e9:.0f} GB fused"
    )
    return Figure(part, label, operations.flop / 1e12, "TFLOP", None, floor_ms, predicted_ms, note=note)


def count_memory() -> Iterator[Figure]:
    """Counts bytes that remain on the device between queries."""
    for name in NETWORKS:
        network = meta_network(name)
        weights = sum(it.nbytes for it in network.parameters())
        tokens = CACHED * network.token_count(GRID) * network.width * torch.bfloat16.itemsize
        yield Figure(f"{name} memory", "weights, linear layers in bfloat16", weights / 1e9, "GB")
        yield Figure(f"{name} memory", f"tokens of {CACHED} references of 518x392", tokens / 1e9, "GB")


def count_pixel_heads() -> Iterator[Figure]:
    """The share of the layers after the last tokens: computing points only at keypoints could save no more."""
    for name in ("pi3", "pi3x"):
        network = meta_network(name)
        heads = [network.get_submodule(head) for head in ("point_head", "conf_head")]
        tokens = torch.empty(REFERENCES, GRID[0] * GRID[1], network.width, device="meta")
        operations = count_operations(lambda: [head(tokens, GRID) for head in heads])  # noqa: B023
        whole = operations_of(name, Work(1, REFERENCES))
        note = f"{operations.flop / 1e12:.3f} of {whole.flop / 1e12:.2f} TFLOP; tokens kept, {REFERENCES} mapped"
        yield Figure(f"{name} heads", "per-pixel layers' share", 100 * operations.flop / whole.flop, "%", note=note)


def measure_blocks(repeats: int) -> Iterator[Figure]:
    """Measures one block of each kind at full width, with three views of 266x196, on one thread."""
    views, grid, device = 3, (14, 19), torch.device("cpu")
    sizes = Sizes(encoder_depth=1, decoder_depth=2, head_depth=1)
    for dtype in (torch.float32, torch.bfloat16):
        network = make_network("pi3", sizes)
        assert isinstance(network, PiNetwork)
        network.set_compute_type(dtype)
        rope, count = network.layout(grid).rope, 5 + grid[0] * grid[1]
        x = torch.randn(views, count, sizes.width, generator=torch.Generator().manual_seed(1))
        decoded = torch.cat([x, x], dim=-1)
        scene = x.reshape(1, views * count, sizes.width)
        works: dict[str, Callable[[], object]] = {
            "encoder": lambda: network.encoder.blocks[0](x),  # noqa: B023
            "within views": lambda: network.decoder[0](x, rope),  # noqa: B023
            "over the scene": lambda: network.decoder[1](scene, rope),  # noqa: B023
            "of a head, with its two linear layers": lambda: network.point_decoder(decoded, rope),  # noqa: B023
        }
        for label, work in works.items():
            with torch.no_grad():
                first, second = median_s(work, device, repeats, warm_up=1)
            flop = count_operations(work).flop
            part = f"CPU, one block, {views} views of {14 * grid[1]}x{14 * grid[0]}, {str(dtype)[6:]}"
            note = f"{flop / 1e9:.1f} GFLOP, {flop / first / 1e9:.0f} GFLOP/s"
            yield Figure(part, label, 1e3 * first, "ms", 1e3 * second, note=note)


def compare_kept_tokens() -> Iterator[Figure]:
    """Compares outputs with and without kept tokens: equal if encoded one by one, nearly equal if together."""
    for name, label, sizes in (*((name, "small", SMALL[name]) for name in NETWORKS), ("pi3", "medium", MEDIUM)):
        for dtype in (torch.float32, torch.bfloat16):
            network = make_network(name, sizes)
            network.set_compute_type(dtype)
            scene = Scene(network, 4, (5, 7))
            kept = _one_by_one(network, scene, dtype)
            again = torch.cat([kept[:3], _one_by_one(network, scene, dtype)[3:]])
            together = _encoded(network, scene, slice(None), dtype)
            with torch.no_grad():
                fresh, cached, batched = (
                    scene.reconstruct(network, tokens[None], 4)
                    for tokens in (_one_by_one(network, scene, dtype), again, together)
                )
            part = f"{label} {name}, {str(dtype)[6:]}"
            yield Figure(part, "kept against fresh tokens, one by one", max_difference(cached, fresh), "", target=0)
            yield Figure(part, "encoded together against one by one", max_difference(batched, fresh), "")


def _one_by_one(network: Network, scene: Scene, dtype: torch.dtype) -> Tensor:
    return torch.cat([_encoded(network, scene, slice(i, i + 1), dtype) for i in range(len(scene.images))])


def _encoded(network: Network, scene: Scene, views: slice, dtype: torch.dtype) -> Tensor:
    with torch.no_grad():
        return scene.encode(network, views).to(dtype)


def compare_rounding() -> Iterator[Figure]:
    """The effect of bfloat16, and the part of it that is due to the rounding of kept tokens."""
    outputs: dict[tuple[torch.dtype, torch.dtype], NetworkOutput] = {}
    for compute in (torch.float32, torch.bfloat16):
        network = make_network("pi3", MEDIUM)
        network.set_compute_type(compute)
        scene = Scene(network, 4, (7, 9))
        with torch.no_grad():
            tokens = scene.encode(network, slice(None))
            for seam in (torch.float32, torch.bfloat16):
                outputs[compute, seam] = scene.reconstruct(network, tokens.to(seam)[None], 4)
    single, half = torch.float32, torch.bfloat16
    part = "medium pi3, largest relative difference of outputs"
    pairs = {
        "float32, tokens in bfloat16, against not": ((single, half), (single, single)),
        "bfloat16 with float32 tokens against float32": ((half, single), (single, single)),
        "bfloat16 with bfloat16 tokens against float32": ((half, half), (single, single)),
        "bfloat16, tokens rounded, against not": ((half, half), (half, single)),
    }
    for label, (left, right) in pairs.items():
        yield Figure(part, label, max_difference(outputs[left], outputs[right]), "")


def count_compilations() -> Iterator[Figure]:
    """Counts graphs that are compiled after the warm-up, for warm shapes and another one."""
    for name in NETWORKS:
        network = make_network(name, SMALL[name])
        runner = NetworkRunner(network, name, "random", "cpu", RunnerOptions(compile_backend="eager"))
        runner.warm_up([CompiledShape((3, 4), 3), CompiledShape((4, 3), 4)])
        before = compiled_graphs()
        for grid, views in (((3, 4), 3), ((4, 3), 4), ((3, 4), 3), ((2, 2), 3)):
            _run(runner, grid, views)
        runner.close()
        part, label = f"small {name}, compiled", "graphs compiled after the warm-up"
        yield Figure(part, label, compiled_graphs() - before, "", target=0, note=f"{before} before")


def _run(runner: NetworkRunner, grid: tuple[int, int], views: int) -> None:
    scene = Scene(runner.network, views, grid)
    tokens = torch.cat(
        [
            runner.encode(scene.images[i : i + 1], None if scene.intrinsics is None else scene.intrinsics[i : i + 1])
            for i in range(views)
        ]
    )
    runner.reconstruct(tokens[None], grid, views - 1, scene.poses, scene.posed)
