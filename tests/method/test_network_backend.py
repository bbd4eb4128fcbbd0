"""A network as the coarse stage: what it is asked, what its output may be, and how it is made from its name."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="the networks' extra is not installed")
pytest.importorskip("PIL", reason="the networks' extra is not installed")

from safetensors.torch import save_file
from support.grey_network import OPTIONS, arrays_of, assert_same_bits
from support.images import textured
from support.programs import printed
from support.small_networks import (
    MAPANYTHING,
    PI3,
    photograph,
    references_of,
    small_network,
    small_request,
    small_runner,
    view_of,
)

from mapless_server.method.choices import NETWORKS
from mapless_server.method.coarse import Request, make, reconstruct_one
from mapless_server.method.coarse.device import DeviceReconstruction
from mapless_server.method.coarse.geometric import GeometricReconstructor
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.coarse.network import NetworkReconstructor
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.views import Reconstruction
from mapless_server.networks import mapanything, pi3
from mapless_server.networks.mapanything import MapAnything
from mapless_server.networks.pi3 import Pi3
from mapless_server.networks.runner import NetworkRunner
from mapless_server.networks.weights import CheckpointError, WeightsMissing, named

# What is asked of the network


@pytest.mark.parametrize("name", NETWORKS)
def test_maps_have_the_cameras_of_the_pictures(name: str) -> None:
    """Point maps are of the grid's size, confidence is 0 to 1, and both differ from reference to reference."""
    outcome = reconstruct_one(NetworkReconstructor(small_runner(name), OPTIONS), *small_request(3))
    assert isinstance(outcome, Reconstruction)
    for view in outcome.references:
        assert view.point_map.shape == (56, 70, 3)
        assert np.isfinite(view.point_map).all()
        assert (view.camera.width_px, view.camera.height_px) == (70, 56)
        assert 0 < view.confidence.min() < view.confidence.max() < 1
        np.testing.assert_allclose(
            view.local_from_camera.rotation @ view.local_from_camera.rotation.T, np.eye(3), atol=1e-5
        )
    assert np.abs(outcome.references[0].point_map - outcome.references[1].point_map).max() > 0.01


@pytest.mark.parametrize(("name", "sigma"), [("pi3", None), ("pi3x", 0.31), ("mapanything", 0.2)])
def test_the_unit_of_the_output_is_about_the_metre(name: str, sigma: float | None) -> None:
    """Where the network predicts metres and the scene is in metres; only then is one reference enough."""
    backend = NetworkReconstructor(small_runner(name), OPTIONS)
    request = Request(*small_request(1))
    outcomes = backend.reconstruct_many([request, replace(request, is_metric=False)])
    for outcome, expected in zip(outcomes, (sigma, None), strict=True):
        assert isinstance(outcome, Reconstruction)
        assert outcome.metre_sigma == expected


def test_confidence_is_zero_where_a_picture_is_filled() -> None:
    query, references = small_request(2)
    portrait = references_of([photograph(textured(72, 96, seed=i)) for i in range(3)])[2]
    outcome = reconstruct_one(NetworkReconstructor(small_runner("pi3"), OPTIONS), query, [*references, portrait])
    assert isinstance(outcome, Reconstruction)
    filled = outcome.references[2]
    assert (outcome.references[0].confidence > 0).all()
    assert (filled.confidence[:, :10] == 0).all()
    assert (filled.confidence[:, 30:40] > 0).all()
    corners = filled.camera.project(portrait.view.camera.rays(np.array([[-0.5, -0.5], [71.5, 95.5]])))
    np.testing.assert_allclose(corners, [[13.5, -0.5], [55.5, 55.5]], atol=0.51)


# Not a number


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("part", ["fc_t.bias", "2.bias"], ids=["poses", "maps"])
def test_output_that_is_not_finite_is_rejected(name: str, part: str, caplog: pytest.LogCaptureFixture) -> None:
    network = small_network(name)
    layers = ("fc_t.bias",) if part == "fc_t.bias" else ("conf_head.proj.bias", "output_block.0.2.bias", "conv2.2.bias")
    for key, parameter in network.named_parameters():
        if key.endswith(layers):
            parameter.data[:] = float("nan")
    runner = NetworkRunner(network, name, "sha", "cpu")
    outcome = reconstruct_one(NetworkReconstructor(runner, OPTIONS), *small_request(2))
    assert isinstance(outcome, Rejection)
    assert outcome.reason is RejectionReason.SCALE_UNRELIABLE
    assert name in outcome.message
    assert [record.message for record in caplog.records] == [f"{name}: the network's output is not finite"]
    kept = reconstruct_one(NetworkReconstructor(runner, replace(OPTIONS, keep_on_device=True)), *small_request(2))
    assert isinstance(kept, DeviceReconstruction)
    assert kept.local_from_camera.isnan().any() or kept.broken_pixels() > 0


@pytest.mark.parametrize("name", NETWORKS)
def test_a_reconstruction_on_the_device_equals_the_fetched_one(name: str) -> None:
    runner, request = small_runner(name), small_request(3)
    kept = reconstruct_one(NetworkReconstructor(runner, replace(OPTIONS, keep_on_device=True)), *request)
    assert isinstance(kept, DeviceReconstruction)
    assert kept.backend == name
    assert_same_bits(kept.fetch(), reconstruct_one(NetworkReconstructor(runner, OPTIONS), *request))


# Odd input


@pytest.mark.parametrize("name", NETWORKS)
def test_odd_shapes_and_intrinsics_are_reconstructed(name: str) -> None:
    """A panorama that fits no grid, references of mixed sizes, one whose focal length is thrice too long."""
    query = view_of(photograph(textured(400, 40, seed=9)))
    photos = [photograph(textured(*size, seed=i)) for i, size in enumerate([(96, 72), (72, 96), (640, 480)])]
    wrong = replace(photos[2].camera, focal_x_px=3 * photos[2].camera.focal_x_px)
    references = references_of([*photos[:2], replace(photos[2], camera=wrong)])
    outcome = reconstruct_one(NetworkReconstructor(small_runner(name), OPTIONS), query, references)
    assert all(np.isfinite(values).all() for values in arrays_of(outcome))


# From a name to a backend


def test_a_network_needs_its_weights(tmp_path: Path) -> None:
    with pytest.raises(WeightsMissing, match="mapless-server weights fetch pi3x"):
        make_reconstructor("pi3x", tmp_path)


def test_a_network_is_loaded_from_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pi3, "Pi3", lambda: Pi3(PI3))
    network = small_network("pi3", seed=4)
    save_file(network.state_dict(), tmp_path / "pi3.safetensors")
    made = make_reconstructor("pi3", tmp_path, "cpu", OPTIONS)
    assert made.name == "pi3"
    assert made.weights_sha256 == hashlib.sha256((tmp_path / "pi3.safetensors").read_bytes()).hexdigest()
    request = small_request(2)
    expected = reconstruct_one(NetworkReconstructor(NetworkRunner(network, "pi3", "sha", "cpu"), OPTIONS), *request)
    assert isinstance(made, NetworkReconstructor)
    assert_same_bits(reconstruct_one(made, *request), expected)
    with (tmp_path / "pi3.safetensors").open("r+b") as stream:
        stream.truncate(1000)
    with pytest.raises(CheckpointError):
        make_reconstructor("pi3", tmp_path, "cpu", OPTIONS)


def test_a_file_under_another_licence_does_not_serve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if it is put into the folder by hand: its tensors are those of the file that a company may use."""
    monkeypatch.setattr(mapanything, "MapAnything", lambda: MapAnything(MAPANYTHING))
    file = tmp_path / "mapanything.safetensors"
    save_file(small_network("mapanything").state_dict(), file)
    assert make_reconstructor("mapanything", tmp_path, "cpu", OPTIONS).name == "mapanything"
    known = named("mapanything")
    other = replace(known.look_alikes[0], sha256=hashlib.sha256(file.read_bytes()).hexdigest())
    monkeypatch.setattr(make, "named", lambda _: replace(known, look_alikes=(other,)))
    with pytest.raises(CheckpointError) as caught:
        make_reconstructor("mapanything", tmp_path, "cpu", OPTIONS)
    assert str(caught.value) == (
        f"{file} is the file of facebook/map-anything, whose licence is CC BY-NC 4.0, non-commercial. mapanything is "
        "the file of facebook/map-anything-apache, whose licence is Apache-2.0: "
        "`mapless-server weights fetch mapanything`"
    )


@pytest.mark.parametrize(("device", "reason"), [("cpu", "there is no CUDA device"), ("cuda", "weights fetch pi3`")])
def test_auto_falls_back_to_geometric_and_logs_the_reason(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, device: str, reason: str
) -> None:
    if device == "cpu":
        (tmp_path / "pi3.safetensors").touch()
    with caplog.at_level(logging.INFO):
        assert isinstance(make_reconstructor("auto", tmp_path, device), GeometricReconstructor)
    (record,) = caplog.records
    assert record.message.startswith("backend auto: geometric serves, not a network: ")
    assert reason in record.message


def test_geometric_does_not_import_torch() -> None:
    program = """if True:
        import sys; sys.modules['torch'] = sys.modules['PIL'] = None
        from pathlib import Path
        from mapless_server.method.coarse.make import make_reconstructor
        print(make_reconstructor('geometric', Path()).name, make_reconstructor('auto', Path()).name)
    """
    assert printed(program) == "geometric geometric\n"
