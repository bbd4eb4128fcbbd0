"""The runner has the output of its network, in every way of running it."""

import threading
from collections.abc import Iterator
from functools import partial

import pytest
import torch
from support.parity_rule import images, mapanything_weights, ruled_network, weights
from torch import Tensor

from mapless_server.networks.blocks import Attention, flash_attention
from mapless_server.networks.mapanything import MapAnything, MapAnythingSizes
from mapless_server.networks.network import Network, NetworkOutput
from mapless_server.networks.pi3 import Pi3, Pi3X, Sizes
from mapless_server.networks.runner import CompiledShape, NetworkRunner, UnsuitableDevice

GRID = (2, 3)
nightly = partial(pytest.param, marks=pytest.mark.nightly)


def some_images(views: int, grid: tuple[int, int] = GRID) -> Tensor:
    return torch.from_numpy(images("runner", (views, 3, grid[0] * 14, grid[1] * 14)))


def intrinsics(views: int) -> Tensor:
    return torch.tensor([[40.0, 0.0, 21.0], [0.0, 40.0, 14.0], [0.0, 0.0, 1.0]]).repeat(views, 1, 1)


def line(views: int) -> Tensor:
    poses = torch.eye(4).repeat(1, views, 1, 1)
    poses[0, :, 0, 3] = torch.arange(views)
    return poses


def localize(runner: NetworkRunner, views: int, grid: tuple[int, int] = GRID) -> NetworkOutput:
    """As a backend calls it: the last view is the query."""
    if not runner.conditioned:
        return runner.reconstruct(runner.encode(some_images(views, grid))[None], grid, views - 1)
    tokens = runner.encode(some_images(views, grid), intrinsics(views))
    return runner.reconstruct(tokens[None], grid, views - 1, line(views), torch.arange(views)[None] < views - 1)


def shallow_network(name: str) -> Network:
    """Every kind of block once, for tracing is slow."""
    sizes = Sizes(32, 2, 1, 2, 1, 16, (16,), 4, metric_width=16, metric_heads=1, metric_depth=1)
    network: Network = Pi3(sizes) if name == "pi3" else Pi3X(sizes)
    rule = weights
    if name == "mapanything":
        network = MapAnything(MapAnythingSizes(32, 2, 1, 2, 4, (0, 1), (8, 8), (8, 8), (4, 4, 4, 4), 8, 8, 16, 8))
        rule = mapanything_weights
    state = {key: torch.from_numpy(rule(key, value.shape)) for key, value in network.state_dict().items()}
    network.load_state_dict(state)
    return network


@pytest.fixture(params=["pi3", "pi3x", nightly("mapanything")])
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def runner(name: str) -> Iterator[NetworkRunner]:
    runner = NetworkRunner(ruled_network(name), name, "sha")
    yield runner
    runner.close()


def test_the_runner_has_the_networks_output() -> None:
    network = ruled_network("pi3")
    runner = NetworkRunner(network, "pi3", "sha")
    layout = network.layout(GRID)
    expected = network.reconstruct(network.encode(some_images(4), layout)[None], layout, 4)
    found = localize(runner, 4)
    for field in ("camera_poses", "local_points", "confidence_logits"):
        values = vars(found)[field]
        torch.testing.assert_close(values, vars(expected)[field][:, : values.shape[1]], rtol=0, atol=2e-5)
    runner.close()


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["pi3", "pi3x", "mapanything"])
def test_a_compiled_runner_does_not_compile_again(name: str) -> None:
    """It compiles as a whole, so nothing in it waits for the device: that would break the graph."""
    plain = NetworkRunner(shallow_network(name), name, "sha")
    compiled = NetworkRunner(shallow_network(name), name, "sha", compile_backend="eager")
    compiled.warm_up([CompiledShape(GRID, 3), CompiledShape((3, 2), 3)])
    from torch._dynamo.utils import counters  # takes a second to import

    counters.clear()
    # The last one was not warmed up, and is run as it is.
    for views, grid in ((3, GRID), (3, (3, 2)), (3, GRID), (4, (3, 3))):
        expected, found = localize(plain, views, grid), localize(compiled, views, grid)
        for field, values in vars(expected).items():
            torch.testing.assert_close(vars(found)[field], values, rtol=0, atol=1e-5)
    assert dict(counters["stats"]) == {}
    assert dict(counters["recompiles"]) == {}
    plain.close()
    compiled.close()


def test_tokens_are_rounded_to_the_compute_type_always() -> None:
    runner = NetworkRunner(ruled_network("pi3"), "pi3", "sha", dtype=torch.bfloat16)
    tokens = runner.encode(some_images(3))
    assert tokens.dtype is torch.bfloat16
    kept = tokens.clone()
    first, second = (runner.reconstruct(t[None], GRID, 2) for t in (tokens, kept))
    for field, values in vars(first).items():
        assert values.dtype is torch.float32
        assert torch.equal(values, vars(second)[field])
    runner.close()


def test_threads_get_their_own_results(runner: NetworkRunner) -> None:
    expected = {views: localize(runner, views).camera_poses for views in (2, 3, 4)}
    found: dict[int, Tensor] = {}

    def work(views: int) -> None:
        for _ in range(3):
            found[views] = localize(runner, views).camera_poses

    threads = [threading.Thread(target=work, args=(views,)) for views in expected]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(torch.equal(found[views], expected[views]) for views in expected)


def test_a_device_without_flash_attention_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The CPU has no flash kernel, as a GPU may lack it; no other kernel is taken instead."""
    token = torch.ones(1, 1, 1, 64)
    with pytest.raises(NotImplementedError, match="flash"):
        flash_attention(token, token, token)
    monkeypatch.setattr(Attention, "attend", staticmethod(flash_attention))
    with pytest.raises(UnsuitableDevice, match="pi3 cannot run on cpu: no flash attention"):
        NetworkRunner(ruled_network("pi3"), "pi3", "sha")
