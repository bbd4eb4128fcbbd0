"""Learned extractors: planted score maps give keypoints where they are, through reduction and lens; random weights."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.images import textured
from support.scenes import random_for

from mapless.geometry import Array, Camera
from mapless.lenses import RadialTangential
from mapless_server.method.features.extractors import FeatureExtractor, make_extractor
from mapless_server.method.features.views import Features

torch = pytest.importorskip("torch", reason="the learned features' extra is not installed")
pytest.importorskip("kornia", reason="the learned features' extra is not installed")

from kornia.feature import ALIKED, XFeat  # noqa: E402
from safetensors.torch import save_file  # noqa: E402
from torch import Tensor, nn  # noqa: E402

from mapless_server.method.features.extractors.aliked import AlikedExtractor, Maps, describe, find_maps  # noqa: E402
from mapless_server.method.features.extractors.edgepoint2 import SIZE_OF_WIDTH, EdgePoint2Extractor  # noqa: E402
from mapless_server.method.features.extractors.network import image_tensor  # noqa: E402
from mapless_server.method.features.extractors.options import LearnedOptions  # noqa: E402
from mapless_server.method.features.extractors.xfeat import SHIFT_PX, XfeatExtractor  # noqa: E402
from mapless_server.method.features.masks import MARGIN_PX  # noqa: E402
from mapless_server.networks.edgepoint2 import EdgePoint2  # noqa: E402
from mapless_server.networks.edgepoint2_heads import sampled  # noqa: E402
from mapless_server.networks.edgepoint2_sizes import VARIANTS  # noqa: E402
from mapless_server.networks.weights import CheckpointError  # noqa: E402

CAMERA = Camera(320, 256, 300.0, 300.0, 159.5, 127.5)
LENS = RadialTangential(-0.25, 0.07, 0.001, -0.0015, -0.005)


def saved(network: nn.Module, file: Path, without: tuple[str, ...] = ()) -> Path:
    state = {k: v.contiguous().clone() for k, v in network.state_dict().items() if k not in without}
    save_file(state, file)
    return file


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Random ones, in files as the authors' are."""
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    return {
        "aliked": saved(ALIKED("aliked-n16"), folder / "aliked.safetensors", without=("dkd.hw_grid",)),
        "xfeat": saved(XFeat().net, folder / "xfeat.safetensors"),
        "edgepoint2-s64": saved(EdgePoint2(VARIANTS["s64"]), folder / "edgepoint2.safetensors"),
    }


@pytest.fixture(scope="module")
def aliked(weights: dict[str, Path]) -> AlikedExtractor:
    return AlikedExtractor(weights["aliked"], options=LearnedOptions(max_keypoints=300, min_score=0.0))


@pytest.fixture(scope="module")
def xfeat(weights: dict[str, Path]) -> XfeatExtractor:
    return XfeatExtractor(weights["xfeat"], options=LearnedOptions(max_keypoints=300, min_score=0.001))


@pytest.fixture(scope="module")
def edgepoint2(weights: dict[str, Path]) -> EdgePoint2Extractor:
    return EdgePoint2Extractor(
        "s64", weights["edgepoint2-s64"], options=LearnedOptions(max_keypoints=300, min_score=0.001)
    )


def assert_is_well_formed(features: Features, dimension: int) -> None:
    assert features.keypoints.dtype == features.sizes_px.dtype == np.float32
    assert features.descriptors.dtype == np.int8
    assert features.descriptors.shape == (len(features), dimension)
    assert np.isfinite(features.keypoints).all()
    assert (features.sizes_px > 0).all()
    np.testing.assert_allclose(np.linalg.norm(features.unit_descriptors(), axis=1), 1, atol=1e-5)


def planted(score_map: Tensor) -> Maps:
    """ALIKED's output with the same features everywhere."""
    height, width = score_map.shape[2:]
    levels = [torch.ones(1, 32, height // step, width // step) for step in (1, 2, 8, 32)]
    return Maps(score_map, levels, (0, 0))


FIND_MAPS = "mapless_server.method.features.extractors.aliked.find_maps"


def peaks(random: np.random.Generator, width: int, height: int, step_px: int = 20) -> Array:
    """Places between pixels, one in each square of a grid."""
    grid = np.meshgrid(np.arange(step_px, width - step_px, step_px), np.arange(step_px, height - step_px, step_px))
    centres = np.stack(grid, axis=-1).reshape(-1, 2)
    return np.asarray(centres + random.uniform(-4, 4, centres.shape))


def bumps(centres: Array, width: int, height: int, sigma_px: float) -> Tensor:
    """(1, 1, H, W): Gaussians of height 0.9; pixel (0, 0) is the centre of the top-left one."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    image = np.zeros((height, width))
    for cx, cy in centres:
        image = np.maximum(image, 0.9 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma_px**2)))
    planted: Tensor = torch.from_numpy(image[None, None].astype(np.float32))
    return planted


def largest_miss_px(keypoints: NDArray[np.floating], centres: Array) -> float:
    distance = np.linalg.norm(keypoints[None].astype(float) - centres[:, None], axis=2)
    assert len(keypoints) == len(centres)
    return float(distance.min(axis=1).max())


@pytest.mark.parametrize("max_side_px", [320, 256])
@pytest.mark.parametrize("lens", [None, LENS], ids=["pinhole", "lens"])
def test_aliked_keypoints_are_the_peaks_of_the_score_map(
    aliked: AlikedExtractor, monkeypatch: pytest.MonkeyPatch, lens: RadialTangential | None, max_side_px: int
) -> None:
    """The planted truth is in the reduced, distorted image; back to it through nothing but the two cameras."""
    camera = replace(CAMERA, distortion=lens)
    reduced = camera if max_side_px == 320 else camera.resized(256, 205)
    centres = peaks(random_for("aliked", lens, max_side_px), reduced.width_px, reduced.height_px)
    score_map = bumps(centres, reduced.width_px, reduced.height_px, sigma_px=1.5)
    monkeypatch.setattr(FIND_MAPS, lambda *_: planted(score_map))
    monkeypatch.setattr(aliked, "options", replace(aliked.options, max_side_px=max_side_px, min_score=0.3))
    view = aliked.extract(np.zeros((256, 320, 3), np.uint8), camera)
    assert view.camera == reduced.pinhole()
    # The soft maximum over five pixels is drawn to the middle one by up to a fifth of a pixel; a bias it has not.
    seen = reduced.project(view.camera.rays(view.features.keypoints))
    assert largest_miss_px(seen, centres) < 0.35
    nearest = centres[np.linalg.norm(seen[:, None] - centres, axis=2).argmin(axis=1)]
    assert np.abs((seen - nearest).mean(axis=0)).max() < 0.05


@pytest.mark.parametrize("size", [(160, 224), (97, 131), (7, 9)])
def test_aliked_scores_and_descriptors_are_those_of_kornia(aliked: AlikedExtractor, size: tuple[int, int]) -> None:
    """Offsets of the convolutions and of the samples reach several pixels, beyond the borders too."""
    network = deepcopy(aliked._network)
    for name, parameter in network.named_parameters():
        if "offset_conv" in name and "bias" in name:
            nn.init.normal_(parameter, 0, 3.0)
    image, keypoints = torch.rand(1, 3, *size), 2 * torch.rand(50, 2) - 1
    with torch.inference_mode():
        maps = find_maps(network, image)
        ours = maps.scores, describe(network.desc_head, maps, keypoints)
        features, scores = network.extract_dense_map(image)
        torch.testing.assert_close(ours, (scores, network.desc_head(features, [keypoints])[0][0]), rtol=0, atol=2e-5)


def test_xfeat_keypoints_are_the_peaks_of_the_keypoint_map(
    xfeat: XfeatExtractor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Gaussians are parabolas once their logarithm is taken, so the peaks come out exact."""
    centres = peaks(random_for("xfeat"), 320, 256)
    heat = bumps(centres, 320, 256, sigma_px=1.5) + 1e-6
    cells = torch.nn.functional.pixel_unshuffle(heat, 8)
    # 65 logits whose softmax is a hundredth of the map: the rest of a cell is "no keypoint".
    logits = torch.cat([cells, 100 - cells.sum(dim=1, keepdim=True)], dim=1).log()
    maps = (torch.ones(1, 64, 32, 40), logits, torch.ones(1, 1, 32, 40))
    monkeypatch.setattr(xfeat, "_network", lambda _: maps)
    view = xfeat.extract(np.zeros((256, 320, 3), np.uint8), CAMERA)
    assert view.camera == CAMERA
    assert largest_miss_px(view.features.keypoints, centres + SHIFT_PX) < 0.05


@pytest.fixture
def unrounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Descriptors as the network gives them."""
    monkeypatch.setattr("mapless_server.method.features.views.rounded_descriptors", lambda it: it)


@pytest.mark.usefixtures("unrounded")
def test_xfeat_finds_the_keypoints_that_kornia_finds(xfeat: XfeatExtractor) -> None:
    image = textured(320, 256, seed=3)
    twin = XFeat(top_k=300, detection_threshold=0.001)
    twin.net = xfeat._network
    theirs = twin.eval().detectAndCompute(image_tensor(image, torch.device("cpu")))[0]
    ours = xfeat.extract(image, CAMERA).features
    assert len(ours) > 50
    order = np.lexsort(theirs["keypoints"].numpy().T)
    ours_pixels = np.rint(ours.keypoints - SHIFT_PX)
    ours_order = np.lexsort(ours_pixels.T)
    np.testing.assert_array_equal(ours_pixels[ours_order], theirs["keypoints"].numpy()[order])
    np.testing.assert_allclose(ours.descriptors[ours_order], theirs["descriptors"].numpy()[order], atol=1e-5)


@pytest.mark.usefixtures("unrounded")
def test_edgepoint2_features_are_read_at_the_peaks_of_the_maps(
    edgepoint2: EdgePoint2Extractor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tops of parabolas come out exact, and so does a map of descriptors that are the places they are for."""
    centres = peaks(random_for("edgepoint2"), 320, 250)
    x, y = np.meshgrid(np.arange(320), np.arange(250))
    logits = np.full((250, 320), -20.0)
    for cx, cy in centres:
        logits = np.maximum(logits, 5 - 0.3 * ((x - cx) ** 2 + (y - cy) ** 2))
    # The middles of the 4x4 pixels that a descriptor is for: of an image that is padded to 320x256.
    column, row = np.meshgrid(np.arange(80) * 4 + 1.5, np.arange(64) * 4 + 1.5)
    feature_map = np.stack([column, row, np.full(column.shape, 200.0)]).astype(np.float32)
    maps = logits.astype(np.float32), partial(sampled, feature_map)
    monkeypatch.setattr(edgepoint2._network, "maps", lambda _: maps)
    camera = replace(CAMERA, height_px=250)
    view = edgepoint2.extract(np.zeros((250, 320, 3), np.uint8), camera)
    assert view.camera == camera
    assert largest_miss_px(view.features.keypoints, centres) < 1e-3
    # Each parabola's second derivative is 0.6.
    np.testing.assert_allclose(view.features.sizes_px, SIZE_OF_WIDTH / np.sqrt(0.6), rtol=1e-3)
    places = view.features.descriptors[:, :2] / view.features.descriptors[:, 2:] * 200
    np.testing.assert_allclose(places, view.features.keypoints, atol=0.01)


def test_edgepoint2_finds_nothing_at_the_border(edgepoint2: EdgePoint2Extractor) -> None:
    """Four pixels wide, that of a padded side too."""
    view = edgepoint2.extract(textured(330, 250, seed=3), Camera(330, 250, 300.0, 300.0, 164.5, 124.5))
    assert len(view.features) > 50
    assert (view.features.keypoints > 3.4).all()
    assert (view.features.keypoints < np.array([330, 250]) - 4.4).all()


@pytest.mark.parametrize(("name", "dimension"), [("aliked", 128), ("xfeat", 64), ("edgepoint2", 64)])
def test_any_photograph_gives_well_formed_features(name: str, dimension: int, request: pytest.FixtureRequest) -> None:
    extractor: FeatureExtractor = request.getfixturevalue(name)
    blank = np.full((64, 300, 3), 127, np.uint8)
    for image in (textured(200, 150, seed=1), blank, textured(40, 33, seed=2), textured(9, 7, seed=3)):
        height, width = image.shape[:2]
        camera = Camera(width, height, 300.0, 300.0, (width - 1) / 2, (height - 1) / 2, LENS)
        view = extractor.extract(image, camera)
        assert view.camera.distortion is None
        assert_is_well_formed(view.features, dimension)
        assert len(view.features) <= 300


@pytest.mark.parametrize("name", ["aliked", "xfeat", "edgepoint2"])
def test_a_mask_leaves_the_strongest_keypoints_beside_it(name: str, request: pytest.FixtureRequest) -> None:
    extractor: FeatureExtractor = request.getfixturevalue(name)
    image, camera = textured(320, 256, seed=4), replace(CAMERA, height_px=256)
    whole = extractor.extract(image, camera).features
    ignored = np.zeros((512, 640), bool)  # of the image before it was reduced
    ignored[:, :320] = True
    masked = extractor.extract(image, camera, ignored).features
    assert masked.keypoints[:, 0].min() > 159 + MARGIN_PX - 1
    beside = {tuple(it) for it in whole.keypoints if it[0] > 159 + MARGIN_PX + 1}
    assert len(beside) > 10
    assert beside.issubset({tuple(it) for it in masked.keypoints})
    nothing = extractor.extract(image, camera, np.ones((256, 320), bool)).features
    assert len(nothing) == 0


@pytest.mark.parametrize("extractor", [AlikedExtractor, XfeatExtractor])
def test_the_name_changes_with_weights_and_options(
    extractor: Callable[..., FeatureExtractor], weights: dict[str, Path], tmp_path: Path
) -> None:
    name = "aliked" if extractor is AlikedExtractor else "xfeat"
    changed = (LearnedOptions(), LearnedOptions(1000), LearnedOptions(max_side_px=800), LearnedOptions(min_score=0.2))
    names = {extractor(weights[name], options=options).name for options in changed}
    torch.manual_seed(1)
    network = ALIKED("aliked-n16") if name == "aliked" else XFeat().net
    other = saved(network, tmp_path / "other.safetensors", without=("dkd.hw_grid",))
    names.add(extractor(other, options=LearnedOptions()).name)
    assert len(names) == 5
    assert make_extractor(name, weights[name]).name == make_extractor(name, weights[name]).name
    assert all(n.startswith(name) for n in names)


def test_weights_that_do_not_fit_are_refused(weights: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="does not fit"):
        make_extractor("aliked", weights["xfeat"])
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(weights["xfeat"].read_bytes()[:-100])
    with pytest.raises(CheckpointError):
        make_extractor("xfeat", cut)
    with pytest.raises(ValueError, match="weights"):
        make_extractor("aliked")


def test_superpoint_keypoints_are_whole_pixels(tmp_path: Path) -> None:
    """A random network, against transformers' own output; relative coordinates are whole pixels again."""
    transformers = pytest.importorskip("transformers", reason="the superpoint extra is not installed")
    from mapless_server.method.features.extractors.superpoint import SuperPointExtractor

    def config() -> object:
        return transformers.SuperPointConfig(
            encoder_hidden_sizes=[4, 4, 8, 8], decoder_hidden_size=8, descriptor_decoder_dim=16
        )

    torch.manual_seed(0)
    network = transformers.SuperPointForKeypointDetection(config())
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.normal_(0, 0.3)
    file = saved(network, tmp_path / "superpoint.safetensors")
    extractor = SuperPointExtractor(file, options=LearnedOptions(200, 512, 0.0), config=config())
    view = extractor.extract(textured(320, 256, seed=4), CAMERA)
    assert view.camera == CAMERA
    assert 20 < len(view.features) <= 200
    assert_is_well_formed(view.features, 16)
    np.testing.assert_array_equal(view.features.keypoints, np.rint(view.features.keypoints))
