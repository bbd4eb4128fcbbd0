"""EdgePoint2: the official network's own outputs; fused it computes the same; contrast and padding change nothing."""

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import random_for

torch = pytest.importorskip("torch", reason="the networks extra is not installed")

import torch.nn.functional as F  # noqa: E402, N812  its usual name
from safetensors.torch import save_file  # noqa: E402
from torch import Tensor  # noqa: E402

from mapless_server.kernels import edgepoint2 as kernel  # noqa: E402
from mapless_server.networks.edgepoint2 import EdgePoint2, TorchEdgePoint2, fuse  # noqa: E402
from mapless_server.networks.edgepoint2_sizes import VARIANTS  # noqa: E402
from mapless_server.networks.local_features import load_edgepoint2  # noqa: E402
from mapless_server.networks.weights import CheckpointError  # noqa: E402

FOLDER = Path(os.environ.get("TEST_EDGEPOINT2") or Path(__file__).parents[3] / "shared" / "weights" / "edgepoint2")
"""Where `fixture.npz` and the weights S64.safetensors and so on are: they are not part of the project."""


def outputs(network: EdgePoint2, image: Tensor) -> tuple[Tensor, Tensor]:
    """Logits, and descriptors of all pixels of the map."""
    logits, features = network(image)
    return logits, network.describe(features.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


def plain(network: EdgePoint2, image: Tensor) -> tuple[Tensor, Tensor]:
    """The same as the authors describe it, in their order."""

    def enlarged(x: Tensor, factor: int) -> Tensor:
        return F.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=False)

    height, width = image.shape[2:]
    half = network.block1(F.pad(F.instance_norm(image), (0, -width % 32, 0, -height % 32)))
    eighth = network.block2(F.avg_pool2d(F.avg_pool2d(half, 2), 2))
    last = network.block3(F.avg_pool2d(eighth, 4))
    scores = network.conv1(half) + enlarged(network.conv2(eighth), 4) + enlarged(network.conv3(last), 16)
    joined = torch.cat([F.avg_pool2d(half, 2), enlarged(eighth, 2), enlarged(last, 8)], dim=1)
    logits = F.pixel_shuffle(network.score_head(scores), 2)
    return logits[..., :height, :width], network.desc_head(joined)


@pytest.mark.parametrize("variant", VARIANTS)
def test_outputs_are_those_of_the_official_network(variant: str) -> None:
    name = variant.upper()
    if not (FOLDER / "fixture.npz").is_file():
        pytest.skip(f"needs {FOLDER}/fixture.npz (TEST_EDGEPOINT2 names another folder)")
    network, _ = load_edgepoint2(variant, FOLDER / f"{name}.safetensors")
    with np.load(FOLDER / "fixture.npz") as arrays, torch.inference_mode():
        for same in (network.eval(), fuse(network)):
            logits, descriptors = outputs(same, torch.from_numpy(arrays["image"])[None, None])
            np.testing.assert_allclose(logits[0, 0], arrays[f"{name}_score"], atol=1e-4, rtol=0)
            np.testing.assert_allclose(descriptors[0], arrays[f"{name}_desc"], atol=1e-4, rtol=0)


def random_network(variant: str) -> EdgePoint2:
    """A network with random weights, and with statistics that batch normalization could have learned."""
    torch.manual_seed(0)
    network = EdgePoint2(VARIANTS[variant]).eval()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            for values, low, high in (
                *((module.weight.data, 0.5, 2), (module.bias.data, -1, 1)),
                *((module.running_mean, -1, 1), (module.running_var, 0.5, 2)),
            ):
                values.uniform_(low, high)
    return network


def random_image(*shape: int) -> Tensor:
    image: Tensor = torch.from_numpy(random_for("image", shape).random((1, 1, *shape), np.float32))
    return image


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_fused_network_computes_the_same(variant: str) -> None:
    network, image = random_network(variant), random_image(96, 130)
    with torch.inference_mode():
        expected = plain(network, image)
        found = outputs(network, image), outputs(fuse(network), image)
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in network.modules())
    for ours in found:
        torch.testing.assert_close(ours, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("is_compiled", [False, True])
@pytest.mark.parametrize("size", [(96, 130), (64, 320), (9, 7)])
@pytest.mark.parametrize("variant", VARIANTS)
def test_onnx_runtime_computes_the_same(
    variant: str, size: tuple[int, int], is_compiled: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its last layers by ONNX Runtime, and by compiled code; at keypoints beyond the outermost pixels, too."""
    if is_compiled and not kernel.is_available():
        pytest.skip("not compiled, or no AVX2")
    monkeypatch.setattr(kernel, "is_available", lambda: is_compiled)
    onnx = pytest.importorskip("mapless_server.networks.edgepoint2_onnx", reason="ONNX Runtime is not installed")
    file = tmp_path / "weights.safetensors"
    save_file(random_network(variant).state_dict(), file)
    grey = random_for("grey", size).integers(0, 256, size).astype(np.uint8)
    plain, ours = TorchEdgePoint2(variant, file), onnx.OnnxEdgePoint2(variant, file)
    assert plain.sha256 == ours.sha256
    (logits, describe), (our_logits, our_describe) = plain.maps(grey), ours.maps(grey)
    np.testing.assert_allclose(our_logits, logits, atol=1e-3, rtol=1e-4)
    keypoints = random_for("keypoints", size).uniform(-6, 6, (60, 2)) + random_for("at", size).uniform(
        0, size[::-1], (60, 2)
    )
    np.testing.assert_allclose(our_describe(keypoints), describe(keypoints), atol=1e-3, rtol=1e-4)
    assert our_describe(keypoints[:0]).shape == (0, 64)
    ours.release_memory()
    np.testing.assert_array_equal(ours.maps(grey)[0], our_logits)


@pytest.mark.skipif(not kernel.is_available(), reason="not compiled, or no AVX2")
def test_maps_of_another_size_are_errors() -> None:
    def zeros(*shape: int) -> NDArray[np.float32]:
        return np.zeros(shape, np.float32)

    first, layers = kernel.layer(zeros(8, 8, 1, 1), zeros(8)), [kernel.layer(zeros(8, 8, 3, 3), zeros(8))] * 3
    with pytest.raises(ValueError, match="do not fit"):
        kernel.scores(zeros(8, 16, 16), zeros(8, 4, 4), zeros(8, 1, 1), first, layers)
    quarter, group = kernel.layer(zeros(64, 8, 1, 1), zeros(64)), kernel.grouped(zeros(64, 16, 3, 3), zeros(64))
    with pytest.raises(ValueError, match="do not fit"):
        kernel.samples(zeros(8, 9, 8), zeros(4, 4, 64), zeros(1, 1, 64), quarter, group, np.zeros((1, 2)))


def test_onnx_names_the_weights_that_do_not_fit(tmp_path: Path) -> None:
    onnx = pytest.importorskip("mapless_server.networks.edgepoint2_onnx", reason="ONNX Runtime is not installed")
    state = dict(random_network("s64").state_dict())
    for change, words in (
        ({"conv1.bias": torch.zeros(9)}, "of another shape: conv1.bias is"),
        ({"another": torch.zeros(2)}, "1 surplus: another"),
        ({"conv1.bias": torch.full((8,), torch.nan)}, "not finite, in conv1.bias"),
    ):
        file = tmp_path / "changed.safetensors"
        save_file(state | change, file)
        with pytest.raises(CheckpointError, match=words):
            onnx.OnnxEdgePoint2("s64", file)
    with pytest.raises(CheckpointError, match="does not fit EdgePoint2"):
        onnx.OnnxEdgePoint2("l64", file)


def test_contrast_and_brightness_do_not_change_a_padded_image() -> None:
    """So what is padded takes no part in the normalization."""
    network, image = random_network("s64"), random_image(70, 100)
    with torch.inference_mode():
        logits, descriptors = outputs(network, image)
        others = outputs(network, 0.3 * image + 0.5)
    assert (logits.shape, descriptors.shape) == ((1, 1, 70, 100), (1, 64, 24, 32))
    for ours, theirs in zip(others, (logits, descriptors), strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-2, rtol=1e-2)
