"""LightGlue: the batch against each pair alone and against kornia's own forward; waiting, memory, misuse."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.scenes import CAMERA, random_for, unit_rows

from mapless.geometry import RigidTransform
from mapless_server.method.features.views import Features, PosedView, View
from mapless_server.method.pairs.make import make_matcher

torch = pytest.importorskip("torch", reason="the learned features' extra is not installed")
pytest.importorskip("kornia", reason="the learned features' extra is not installed")

from kornia.feature import LightGlue as KorniaLightGlue  # noqa: E402
from kornia.feature.lightglue import MatchAssignment  # noqa: E402
from safetensors.torch import save_file  # noqa: E402
from support.device import Watch  # noqa: E402
from torch import Tensor  # noqa: E402

from mapless_server.method.features.lightglue import LightGlueMatching, Padded  # noqa: E402
from mapless_server.method.features.lightglue_options import LightGlueOptions  # noqa: E402
from mapless_server.networks.lightglue import (  # noqa: E402
    LightGlue,
    load_lightglue,
    load_superpoint_lightglue,
)
from mapless_server.networks.weights import CheckpointError  # noqa: E402

DIMENSION = 32
COUNTS = (40, 7, 64, 1, 23)
"""Keypoints of the references; the query has 50."""


def view(count: int, common: np.ndarray, noise: float, seed: object) -> View:
    """A view of `count` of the common descriptors, somewhere in the image."""
    random = random_for("lightglue", seed)
    rows = random.permutation(len(common))[:count]
    descriptors = unit_rows(common[rows] + noise * random.standard_normal((count, common.shape[1])))
    keypoints = random.uniform([0, 0], [CAMERA.width_px, CAMERA.height_px], (count, 2))
    return View(
        CAMERA, Features(keypoints.astype(np.float32), descriptors.astype(np.float32), np.ones(count, np.float32))
    )


def reference(of: View, name: str) -> PosedView:
    return PosedView(name, name, of, RigidTransform.identity())


def network(seed: int = 0, layers: int = 3) -> LightGlue:
    """Random weights, sharp enough that some keypoints match: that every score is far from the threshold is chance."""
    torch.manual_seed(seed)
    made = LightGlue(DIMENSION, layers)
    with torch.no_grad():
        for head in made.log_assignment:
            assert isinstance(head, MatchAssignment)
            head.final_proj.weight.copy_(20 * torch.eye(head.dim))
            assert head.matchability.bias is not None
            head.matchability.bias.fill_(4.0)
    return made.eval()


@pytest.fixture(scope="module")
def views() -> tuple[View, list[View]]:
    common = unit_rows(random_for("common").standard_normal((64, DIMENSION)))
    return view(50, common, 0.05, "query"), [view(n, common, 0.05, n) for n in COUNTS]


def tensors(query: View, references: Sequence[View]) -> list[Tensor]:
    ours, theirs = Padded.of([query], 2048), Padded.of(references, 2048)
    arrays = ours.positions, ours.descriptors, theirs.positions, theirs.descriptors, theirs.mask
    return [torch.from_numpy(a) for a in arrays]


def test_it_pauses_between_layers(views: tuple[View, list[View]]) -> None:
    query, references = views
    made, inputs, pauses = network(), tensors(query, references[:1]), list[None]()
    with torch.inference_mode():
        made.match_one((inputs[0], inputs[1]), (inputs[2], inputs[3]), 1.0, 1.0, lambda: pauses.append(None))
    assert len(pauses) == len(made.transformers) - 1


@pytest.mark.parametrize(("depth", "width"), [(0.95, 0.99), (0.6, 0.9), (1.0, 0.95), (0.5, 1.0)])
def test_stopping_and_pruning_equal_kornias(views: tuple[View, list[View]], depth: float, width: float) -> None:
    query, references = views
    made = planted_confidence()
    twin = kornia_twin(made, depth, width)
    layers = []
    for other in references:
        inputs = tensors(query, [other])
        theirs = twin(kornia_input(query, other))
        with torch.inference_mode():
            index, score = made.match_one((inputs[0], inputs[1]), (inputs[2], inputs[3]), depth, width)
        torch.testing.assert_close(score, theirs["matching_scores0"][0], atol=1e-5, rtol=0)
        matched = theirs["matches0"][0] >= 0
        torch.testing.assert_close(index[matched], theirs["matches0"][0][matched])
        layers.append(int(theirs["stop"]))
    assert min(layers) < 6 or depth > 0.6, "no pair stopped early"


def planted_confidence() -> LightGlue:
    """Random weights whose keypoints become certain by and by, and of which some match nothing."""
    made = network(layers=6)
    with torch.no_grad():
        for number, confidence in enumerate(made.token_confidence):
            weight, bias = confidence.parameters()
            weight.mul_(8)
            bias.fill_(0.8 * number)
        for head in made.log_assignment:
            assert isinstance(head, MatchAssignment)
            weight, bias = head.matchability.parameters()
            weight.mul_(8)
            bias.fill_(0.0)
    return made


def test_a_pair_equals_kornias_own_forward(views: tuple[View, list[View]]) -> None:
    query, references = views
    made = network()
    twin = kornia_twin(made, -1, -1)
    for other in references:
        theirs = twin(kornia_input(query, other))
        with torch.inference_mode():
            index, score = made(*tensors(query, [other]))
        torch.testing.assert_close(score[0], theirs["matching_scores0"][0], atol=1e-5, rtol=0)
        matched = theirs["matches0"][0] >= 0
        torch.testing.assert_close(index[0][matched], theirs["matches0"][0][matched])


def kornia_twin(made: LightGlue, depth: float, width: float) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Kornia's own network with the same weights."""
    twin = KorniaLightGlue(
        None,  # type: ignore[arg-type]
        input_dim=DIMENSION,
        n_layers=len(made.transformers),
        depth_confidence=depth,
        width_confidence=width,
    )
    missing = twin.load_state_dict(made.state_dict(), strict=False)
    assert missing.missing_keys == ["confidence_thresholds"]
    assert not missing.unexpected_keys
    twin.eval()

    def forward(data: dict[str, Any]) -> dict[str, Any]:
        with torch.inference_mode():
            found: dict[str, Any] = twin(data)
        return found

    return forward


def kornia_input(*pair: View) -> dict[str, Any]:
    """Two views as kornia wants them."""
    return {
        f"image{i}": {
            "keypoints": torch.from_numpy(v.features.keypoints)[None],
            "descriptors": torch.from_numpy(v.features.descriptors)[None],
            "image_size": torch.tensor([[CAMERA.width_px, CAMERA.height_px]]),
        }
        for i, v in enumerate(pair)
    }


def test_the_network_does_not_wait_for_the_device(views: tuple[View, list[View]]) -> None:
    made, inputs = network().to("meta"), [it.to("meta") for it in tensors(*views)]
    with Watch("meta"), torch.no_grad():
        made(*inputs)


@pytest.mark.parametrize("pairs_at_once", [1, 2, 32])
def test_matches_do_not_depend_on_the_batch(views: tuple[View, list[View]], pairs_at_once: int) -> None:
    query, references = views
    posed = [reference(v, str(i)) for i, v in enumerate(references)]
    checks: list[None] = []
    options = LightGlueOptions(pairs_at_once=pairs_at_once)
    found = LightGlueMatching(network(), options=options).match(query, posed, lambda: checks.append(None))
    assert len(checks) == -(-len(posed) // pairs_at_once)
    alone = LightGlueMatching(network(), options=LightGlueOptions(pairs_at_once=1))
    right = []
    for matches, other in zip(found, posed, strict=True):
        assert matches.dtype == np.int32
        np.testing.assert_array_equal(matches, alone.match(query, [other], lambda: None)[0])
        first, second = query.features.descriptors[matches[:, 0]], other.view.features.descriptors[matches[:, 1]]
        right.extend((first * second).sum(axis=1) > 0.8)  # the same descriptor, but for the noise
    assert len(right) > 50
    assert np.mean(right) > 0.8


def test_half_precision_finds_the_same_matches(views: tuple[View, list[View]]) -> None:
    query, references = views
    posed = [reference(v, "") for v in references]
    full = LightGlueMatching(network()).match(query, posed, lambda: None)
    half = LightGlueMatching(network(), options=LightGlueOptions(half=True)).match(query, posed, lambda: None)
    common = sum(len({*map(tuple, a.tolist())} & {*map(tuple, b.tolist())}) for a, b in zip(full, half, strict=True))
    assert common > 0.95 * max(sum(map(len, full)), sum(map(len, half)))


def test_only_keypoints_up_to_the_limit_are_matched(views: tuple[View, list[View]]) -> None:
    query, references = views
    options = LightGlueOptions(max_keypoints=20, min_score=0.0)
    for matches in LightGlueMatching(network(), options=options).match(
        query, [reference(v, "") for v in references], lambda: None
    ):
        assert len(matches)
        assert matches.max() < 20


def test_photographs_without_keypoints_have_no_matches(views: tuple[View, list[View]]) -> None:
    query, references = views
    blank = view(0, np.ones((1, DIMENSION)), 0.0, "blank")
    matching = LightGlueMatching(network())
    mixed = matching.match(query, [reference(v, "") for v in (blank, references[0], blank)], lambda: None)
    assert [len(m) for m in mixed][::2] == [0, 0]
    np.testing.assert_array_equal(mixed[1], matching.match(query, [reference(references[0], "")], lambda: None)[0])
    assert matching.match(blank, [reference(references[0], "")], lambda: None)[0].shape == (0, 2)
    assert not matching.match(query, [], lambda: None)


def test_out_of_memory_is_retried_in_halves(views: tuple[View, list[View]]) -> None:
    query, references = views
    posed = [reference(v, "") for v in references]
    whole = LightGlueMatching(network()).match(query, posed, lambda: None)

    class Small(LightGlueMatching):
        """A device whose memory holds three pairs."""

        def _match(self, query: View, references: Sequence[View]) -> list[np.ndarray]:
            if len(references) > 3:
                raise torch.OutOfMemoryError
            return super()._match(query, references)

    options = LightGlueOptions()
    for matches, expected in zip(
        Small(network(), options=options).match(query, posed, lambda: None), whole, strict=True
    ):
        np.testing.assert_array_equal(matches, expected)
    with pytest.raises(torch.OutOfMemoryError):
        Small(network(), options=options).match(query, posed * 2, lambda: None)  # halves hold five


def test_weights_are_exactly_those_of_the_checkpoint(tmp_path: Path) -> None:
    torch.manual_seed(1)
    state = {name: tensor.clone() for name, tensor in LightGlue(128).state_dict().items()}
    save_file(state, tmp_path / "good.safetensors")
    loaded = load_lightglue("aliked", tmp_path / "good.safetensors")[0].state_dict()
    assert loaded.keys() == state.keys()
    assert all(torch.equal(loaded[name], state[name]) for name in state)
    save_file({"posenc.Wr.weight": state["posenc.Wr.weight"]}, tmp_path / "short.safetensors")
    with pytest.raises(CheckpointError, match="missing"):
        make_matcher("aliked", weights=tmp_path / "short.safetensors")


@pytest.mark.parametrize("features", ["sift", "xfeat"])
def test_there_is_no_lightglue_for_other_features(features: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no LightGlue"):
        make_matcher(features, weights=tmp_path / "any.safetensors")


def test_superpoints_lightglue_equals_that_of_transformers(tmp_path: Path) -> None:
    """Random weights in transformers' network and, translated, in ours: the same scores for the same keypoints."""
    transformers = pytest.importorskip("transformers", reason="the superpoint extra is not installed")

    detector = transformers.SuperPointConfig(
        encoder_hidden_sizes=[4, 4, 4, 4], decoder_hidden_size=4, descriptor_decoder_dim=256
    )
    config = transformers.LightGlueConfig(
        keypoint_detector_config=detector, num_hidden_layers=2, depth_confidence=-1.0, width_confidence=-1.0
    )
    torch.manual_seed(2)
    theirs = transformers.LightGlueForKeypointMatching(config).eval()
    with torch.no_grad():
        for layer in theirs.transformer_layers:
            layer.cross_attention.k_proj.load_state_dict(layer.cross_attention.q_proj.state_dict())
        for parameter in theirs.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
        for layer in theirs.transformer_layers:
            layer.cross_attention.k_proj.load_state_dict(layer.cross_attention.q_proj.state_dict())
    save_file({k: v.contiguous().clone() for k, v in theirs.state_dict().items()}, tmp_path / "w.safetensors")
    ours = load_superpoint_lightglue(tmp_path / "w.safetensors", config)[0].eval()

    common = unit_rows(random_for("superpoint").standard_normal((64, 256)))
    pair = [view(30, common, 0.05, i) for i in range(2)]
    keypoints = torch.stack([torch.from_numpy(v.features.keypoints) for v in pair])[None]
    descriptors = torch.stack([torch.from_numpy(v.features.descriptors) for v in pair])[None]
    with torch.inference_mode():
        matches, scores, *_ = theirs._match_image_pair(
            keypoints, descriptors, CAMERA.height_px, CAMERA.width_px, torch.ones(1, 2, 30, dtype=torch.int)
        )
        index, score = ours(*tensors(pair[0], pair[1:]))
    torch.testing.assert_close(score[0], scores.reshape(2, -1)[0], atol=1e-5, rtol=0)
    matched = matches.reshape(2, -1)[0] >= 0
    torch.testing.assert_close(index[0][matched], matches.reshape(2, -1)[0][matched].to(index.dtype))
