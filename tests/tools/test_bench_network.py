"""The networks' benchmark: its counts are the published ones, its measurements true, and failures reported."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import typer
from support.parity_rule import SMALL_MAPANYTHING, SMALL_PI3, SMALL_PI3X
from support.small_networks import photograph as photograph_of
from support.small_networks import references_of, small_runner

from bench.network import command
from bench.network.command import bench_network
from bench.network.forward import Forward, max_difference
from bench.network.planted import UNITS_PER_METRE, PlantedReconstructor, Truth, true_points
from bench.network.report import Figure
from bench.network.subject import AnySizes, Work, flop_of, make_network
from bench.turns.command import main
from bench.turns.comparison import figures_of_turns, ratio_with_interval, table
from bench.turns.query import Measured, agreement, figures_of
from mapless.geometry import Camera
from mapless_server.choices import NETWORKS
from mapless_server.method.coarse import reconstruct_one
from mapless_server.method.coarse.network import NetworkReconstructor
from mapless_server.method.features.views import Features, Reconstruction, View

GRID = (3, 4)
SIZES = SMALL_PI3


@pytest.mark.nightly
def test_the_full_network_has_the_published_operation_count() -> None:
    """11 views of 392x294: the count of the official modules, 16.506794665636 TFLOP."""
    assert flop_of("pi3", Work(11, 11, grid=(21, 28))) == pytest.approx(16_506_794_665_636, rel=1e-5)


@pytest.mark.parametrize(("encoded", "mapped"), [(3, 3), (1, 2), (1, 0)])
def test_operations_follow_the_closed_formula(encoded: int, mapped: int) -> None:
    """24 C^2 a token and block, 4 T^2 C a sequence and block; and the layers outside of the blocks."""
    views, patches, width = 3, GRID[0] * GRID[1], SIZES.width
    tokens = patches + 5

    def block(sequences: int, length: int) -> int:
        return sequences * (24 * width**2 * length + 4 * length**2 * width)

    def head(width_out: int) -> int:
        return 2 * tokens * width * (2 * width + width_out) + SIZES.head_depth * block(1, tokens)

    encoding = 2 * patches * 3 * 14**2 * width + (SIZES.encoder_depth + 1) * block(1, tokens)
    decoding = 2 * block(1, views * tokens) + block(views, tokens)
    camera = 2 * SIZES.camera_width**2 * (2 * 3 * patches + 2) + 2 * SIZES.camera_width * 12
    maps = 2 * head(width) + 2 * patches * width * 4 * 14**2
    expected = encoded * encoding + decoding + views * (head(SIZES.camera_width) + camera) + mapped * maps
    rotations = views * 3 * 2 * 3**3  # the products of 3x3 matrices that find the nearest rotation, at most
    counted = flop_of("pi3", Work(encoded, mapped, views, GRID), SIZES)
    assert expected <= counted <= expected + rotations


@pytest.mark.parametrize("name", NETWORKS)
def test_a_random_network_is_nowhere_zero_and_finite(name: str) -> None:
    small: dict[str, AnySizes] = {"pi3": SMALL_PI3, "pi3x": SMALL_PI3X, "mapanything": SMALL_MAPANYTHING}
    network = make_network(name, small[name], seed=3)
    assert all(float((parameter != 0).float().mean()) > 0.99 for parameter in network.parameters())
    layout = network.layout((3, 4))
    output = network.reconstruct(network.encode(torch.rand(2, 3, 42, 56), layout)[None], layout, 2)
    for tensor in vars(output).values():
        assert bool(tensor.isfinite().all())
        assert float(tensor.std()) > 0.01


def test_forward_from_kept_tokens_is_the_forward_of_everything() -> None:
    """Where kernels round alike for any number of views, as here."""
    network = make_network("pi3", SIZES)
    forward = Forward(network, 3, GRID)
    everything = forward.run(Work(3, 2, 3, GRID))
    kept = forward.run(Work(1, 2, 3, GRID))
    forward.scene.images = forward.scene.images.flip(0)
    other = forward.run(Work(1, 2, 3, GRID))
    assert max_difference(kept, everything) <= 1e-6
    assert max_difference(other, everything) > 1e-2


def plane() -> Truth:
    """A tilted plane, 2 m away at the centre."""
    camera = Camera(96, 72, 80.0, 80.0, 47.5, 35.5)
    rows, columns = np.indices((72, 96))
    rays = camera.rays(np.stack([columns, rows], axis=-1))
    depth = (2.0 / (1.0 + 0.3 * rays[..., 0] - 0.2 * rays[..., 1])).astype(np.float32)
    pose = references_of([photograph_of(np.zeros((72, 96, 3), np.uint8))])[0].world_from_camera
    return Truth(camera, pose, depth)


def test_planted_points_lie_on_the_true_surface() -> None:
    points = true_points(plane()).astype(float) / UNITS_PER_METRE
    on_plane = points[..., 2] + 0.3 * points[..., 0] - 0.2 * points[..., 1]
    np.testing.assert_allclose(on_plane, 2.0, atol=0.01)  # depth is read at the nearest of coarser pixels


def test_planted_reconstruction_is_the_truth_up_to_scale() -> None:
    pictures = [photograph_of(np.full((72, 96, 3), 40 * i, np.uint8), plane().camera) for i in range(3)]
    references = references_of(pictures[1:])
    poses = [plane().world_from_camera, *(reference.world_from_camera for reference in references)]
    truth = {
        picture.sha256: replace(plane(), world_from_camera=pose) for picture, pose in zip(pictures, poses, strict=True)
    }
    nothing = Features(np.empty((0, 2), np.float32), np.empty((0, 4), np.float32), np.empty(0, np.float32))
    query = View(plane().camera, nothing, pictures[0])
    network = NetworkReconstructor(small_runner("pi3"))
    outcome = reconstruct_one(PlantedReconstructor(network, truth), query, references)
    network.close()
    assert isinstance(outcome, Reconstruction)
    anchor = poses[1].inverse()
    for view, pose in zip((*outcome.references, outcome.query), (*poses[1:], poses[0]), strict=True):
        expected = anchor.compose(pose)
        np.testing.assert_allclose(view.local_from_camera.rotation, expected.rotation, atol=1e-6)
        np.testing.assert_allclose(
            view.local_from_camera.translation / UNITS_PER_METRE, expected.translation, atol=1e-6
        )
    np.testing.assert_array_equal(outcome.references[0].point_map, true_points(plane()))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_part_that_fails_is_reported_and_the_rest_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "count_all", lambda *_: iter([Figure("operations", "of pi3", 26.3, "TFLOP")]))
    figures = bench_network(quick=True, only=["forward-pi3", "memory-pi3", "operations"], output=tmp_path)
    assert [(it.part, it.note) for it in figures[:2]] == [
        (part, "RuntimeError: there is no CUDA device") for part in ("forward-pi3", "memory-pi3")
    ]
    assert figures[2:] == [Figure("operations", "of pi3", 26.3, "TFLOP")]
    written = json.loads((tmp_path / "network.json").read_text())
    assert [it["value"] for it in written["figures"]] == [it.value for it in figures]
    assert (tmp_path / "network.md").read_text().count("not measured") == 2
    printed = capsys.readouterr().out
    assert "There is no CUDA device" in printed
    assert "forward-pi3: 0 figures, 1 not measured, " in printed
    assert printed.count("operations: 1 figures") == 1


def test_a_planted_ratio_lies_in_its_interval() -> None:
    random = np.random.default_rng(1)
    before = random.uniform(0.1, 0.3, 40)
    ratio, low, high = ratio_with_interval(np.stack([before, 0.8 * before * random.normal(1, 0.05, 40)], axis=1))
    assert low < 0.8 < high
    assert low < ratio < high
    assert high - low < 0.05


def test_a_rejected_photograph_counts_for_the_time_alone() -> None:
    times = np.array([[0.2, 0.2], [0.1, 0.1]])
    measured = [Measured(times, times, 1e-9), Measured(times, times, None)]
    assert "| warm query, processor time, ms | 200 | 100 | 0.500 | 0.500 to 0.500 |" in table(figures_of(measured))
    assert agreement(measured) == "Localized by both: 1, at most 1e-09 (unit of the scene) apart."


def test_turns_of_the_same_number_are_compared() -> None:
    first, second = figures_of_turns([("a", "s"), ("b", "")], [[[1, 10], [2, 20]], [[3, 30], [4, 40]]])
    assert (first.values.tolist(), second.values.tolist()) == ([[1, 3], [2, 4]], [[10, 30], [20, 40]])


def test_without_a_commit_nothing_is_measured(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit):
        main("")
    assert "BEFORE=commit" in capsys.readouterr().err
