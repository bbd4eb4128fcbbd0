"""A network as the coarse stage: what it is asked, what its output may be, and how it is made from its name."""

from __future__ import annotations

import hashlib
import logging
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch", reason="the networks' extra is not installed")
pytest.importorskip("PIL", reason="the networks' extra is not installed")

import torch
from safetensors.torch import save_file
from support.grey_network import (
    OPTIONS,
    GreyRunner,
    arrays_of,
    assert_close,
    assert_same_bits,
    grey_backend,
    grey_request,
)
from support.images import textured
from support.parity_rule import SMALL_MAPANYTHING, SMALL_PI3
from support.programs import printed
from support.small_networks import (
    photograph,
    references_of,
    small_network,
    small_request,
    small_runner,
    view_of,
)

from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.choices import NETWORKS
from mapless_server.method.coarse import Request, make, reconstruct_one
from mapless_server.method.coarse.geometric import GeometricReconstructor
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.coarse.network import NetworkReconstructor, condition_poses
from mapless_server.method.features.views import Reconstruction
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.networks import mapanything, pi3
from mapless_server.networks.conditions import normalize_poses
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
    monkeypatch.setattr(pi3, "Pi3", lambda: Pi3(SMALL_PI3))
    network = small_network("pi3")
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
    monkeypatch.setattr(mapanything, "MapAnything", lambda: MapAnything(SMALL_MAPANYTHING))
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
        import sys; sys.modules['torch'] = None
        from pathlib import Path
        from mapless_server.method.coarse.make import make_reconstructor
        print(make_reconstructor('geometric', Path()).name, make_reconstructor('auto', Path()).name)
    """
    assert printed(program) == "geometric geometric\n"


# Known poses (Pi3X)


def random_poses(count: int, offset_m: float = 0.0) -> list[RigidTransform]:
    random = np.random.default_rng(count)
    return [
        RigidTransform(rotation_from_vector(random.normal(0, 0.4, 3)), random.normal(0, 3.0, 3) + offset_m)
        for _ in range(count)
    ]


def normalized(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    stacked = torch.from_numpy(poses)[None]
    return normalize_poses(stacked)[0].numpy()


def test_the_querys_placeholder_does_not_change_the_scale() -> None:
    """The references' poses are normalized as without the query; a far placeholder would change them."""
    poses = random_poses(5, offset_m=20.0)
    alone = normalized(np.stack([pose.matrix() for pose in poses]))
    assert np.linalg.norm(alone[1:, :3, 3], axis=1).mean() == pytest.approx(1.0)
    conditions = condition_poses(poses)
    assert conditions.shape == (6, 4, 4)
    np.testing.assert_allclose(normalized(conditions)[:5], alone, atol=1e-6)
    for far in (np.eye(4), poses[0].shifted([30.0, 0.0, 0.0]).matrix()):
        shifted = normalized(np.stack([*(pose.matrix() for pose in poses), far]))[:5]
        assert np.abs(shifted - alone).max() > 0.3


def test_a_single_posed_view_has_no_effect() -> None:
    query, (reference,) = small_request(1)
    backend = NetworkReconstructor(small_runner("pi3x"), OPTIONS)
    moved = replace(reference, world_from_camera=random_poses(1)[0])
    assert_same_bits(reconstruct_one(backend, query, [reference]), reconstruct_one(backend, query, [moved]))


# Known poses (MapAnything)


def test_the_unit_of_poses_is_the_metre_as_the_scene_says() -> None:
    """Not where all are at one place: they have no size then."""
    runner = GreyRunner(conditioned=True)
    backend = grey_backend(runner)
    query, references = grey_request(1, 50, 60)
    same_place = [replace(it, world_from_camera=references[0].world_from_camera) for it in references]
    requests = [Request(query, references), Request(query, references, is_metric=False), Request(query, same_place)]
    backend.reconstruct_many(requests)
    (given,) = runner.given
    poses, posed, metric = given
    assert poses is not None
    assert metric is not None
    assert metric.tolist() == [[True] * 3, [False] * 3, [False] * 3]
    assert posed is not None
    assert posed.tolist() == [[True, True, False]] * 3
    assert torch.equal(poses[:, 0], torch.eye(4).expand(3, 4, 4))
    reconstruct_one(backend, query, references[:1])
    single = runner.given[-1][2]
    assert single is not None
    assert single.tolist() == [[False, False]]


def test_a_conditioned_network_gets_the_rays_of_every_view() -> None:
    runner = GreyRunner(conditioned=True)
    reconstruct_one(grey_backend(runner, OPTIONS), *grey_request(1, 50, 60))
    assert runner.has_rays == [True, True, True]


@pytest.mark.parametrize("name", ["pi3x", "mapanything"])
def test_poses_of_a_conditioned_network_have_an_effect(name: str) -> None:
    query, references = small_request(3)
    runner = small_runner(name)
    plain = reconstruct_one(NetworkReconstructor(runner, OPTIONS), query, references)
    turned = [replace(it, world_from_camera=pose) for it, pose in zip(references, random_poses(3), strict=True)]
    other_poses = reconstruct_one(NetworkReconstructor(runner, OPTIONS), query, turned)
    assert np.abs(arrays_of(other_poses)[0] - arrays_of(plain)[0]).max() > 1e-3


@pytest.mark.parametrize("name", ["pi3x", "mapanything"])
def test_a_rigid_motion_of_the_world_does_not_change_the_output(name: str) -> None:
    query, references = small_request(3)
    backend = NetworkReconstructor(small_runner(name), OPTIONS)
    motion = random_poses(1, offset_m=1e4)[0]
    moved = [replace(it, world_from_camera=motion.compose(it.world_from_camera)) for it in references]
    plain, same = (reconstruct_one(backend, query, it) for it in (references, moved))
    assert_close(same, plain, 1e-4)


PROGRAM = """
import resource, sys
sys.path[:0] = sys.argv[1:]
from support.parity_rule import ruled_network
from support.small_networks import photograph, references_of, view_of
from support.images import textured
from mapless_server.method.coarse.network import NetworkReconstructor
from mapless_server.method.coarse import reconstruct_one
from mapless_server.method.features.views import Reconstruction
from mapless_server.networks.runner import NetworkRunner

backend = NetworkReconstructor(NetworkRunner(ruled_network("pi3", small=False), "pi3", "rule"))
photos = [photograph(textured(640, 480, seed=seed)) for seed in range(2)]
made = reconstruct_one(backend, view_of(photos[0]), references_of(photos[1:]))
assert isinstance(made, Reconstruction), made
print(made.references[0].point_map.shape)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""

log = logging.getLogger(__name__)


@pytest.mark.nightly
@pytest.mark.timeout(900)
def test_a_full_network_reconstructs_photographs_within_16_gib() -> None:
    """In a process of its own, whose memory is the network's alone."""
    tests = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(tests)], capture_output=True, text=True, timeout=800)
    assert done.returncode == 0, done.stderr
    shape, peak_kib = done.stdout.splitlines()
    assert shape == "(392, 518, 3)"
    log.warning("peak memory %.1f GiB", int(peak_kib) / 2**20)
    assert int(peak_kib) < 16 * 2**20
