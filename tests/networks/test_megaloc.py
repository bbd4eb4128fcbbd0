"""MegaLoc: the network against the published one, its parts against their equations, its reduction and its use.

The published weights are not here: those of the tests are made by a rule, small, and were given to the published code
as well.
"""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from support.images import textured
from support.parity_rule import images
from support.small_networks import SMALL_MEGALOC, photograph, ruled_megaloc, view_of
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from mapless_server.method.features.views import View
from mapless_server.networks.megaloc import signed_groups, transport
from mapless_server.networks.weights import CheckpointError, named
from mapless_server.networks.weights.install import add
from mapless_server.scenes.retrieval.index import GlobalDescriptor
from mapless_server.scenes.retrieval.megaloc import SIDE_PX, MegaLocDescriptor

PUBLISHED = {
    (140, 196): (
        *(0.0531425, 0.1005863, -0.0246275, 0.0733341, 0.0108711, -0.0649925, 0.0162236, 0.0524118),
        *(0.0270171, 0.1099585, 0.1004871, 0.0901774, -0.0266725, -0.2352324, 0.0142348, 0.0602001),
    ),
    (42, 56): (
        *(-0.0485626, 0.2263825, 0.0342704, 0.1724895, -0.0843703, -0.2031881, 0.0520563, 0.0262572),
        *(-0.1206225, 0.2054542, 0.1436262, 0.1271045, -0.1195485, -0.1476702, -0.0006776, 0.0127103),
    ),
}
"""By height and width of images, every twelfth number of two descriptors, by the published code with the weights of
`small_networks`. With twelve patches for eight clusters every patch has its say."""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "megaloc.safetensors"
    save_file(ruled_megaloc().state_dict(), path)
    return path


@pytest.fixture(scope="module")
def descriptor(file: Path) -> MegaLocDescriptor:
    return MegaLocDescriptor(file, sizes=SMALL_MEGALOC, dimension=24)


def some_views(count: int) -> list[View]:
    return [view_of(photograph(textured(80 + 8 * i, 60, seed=i))) for i in range(count)]


# ---- the network


@pytest.mark.parametrize("size", PUBLISHED)
def test_a_small_network_equals_the_published_code(size: tuple[int, int]) -> None:
    descriptors = ruled_megaloc()(torch.from_numpy(images("megaloc", (2, 3, *size))))
    assert descriptors.shape == (2, 96)
    np.testing.assert_allclose(descriptors[:, ::12].flatten(), PUBLISHED[size], rtol=0, atol=1e-6)


# ---- SALAD


def slow_transport(scores: NDArray[np.float64], dustbin_score: float) -> NDArray[np.float64]:
    """Sinkhorn's iteration number by number, on masses and not on their logarithms."""
    clusters, patches = scores.shape
    masses = np.exp(np.vstack([scores, np.full(patches, dustbin_score)]))
    takes = [1.0] * clusters + [patches - clusters]
    for _ in range(3):
        for i in range(clusters + 1):
            masses[i] *= takes[i] / masses[i].sum()
        for j in range(patches):
            masses[:, j] /= masses[:, j].sum()
    return np.asarray(masses[:-1])


@pytest.mark.parametrize(("clusters", "patches"), [(1, 2), (3, 4), (6, 35)])
def test_masses_equal_sinkhorns_iteration(clusters: int, patches: int) -> None:
    random = np.random.default_rng(clusters)
    scores = random.normal(0, 4, (2, clusters, patches))
    found = transport(torch.from_numpy(scores), torch.tensor(0.7))
    np.testing.assert_allclose(found, [slow_transport(part, 0.7) for part in scores], rtol=1e-9, atol=0)


def test_scores_far_apart_overflow_nothing() -> None:
    scores = torch.randn(1, 6, 35, generator=torch.Generator().manual_seed(0)) * 300
    masses = transport(scores, torch.tensor(1.0))
    assert torch.isfinite(masses).all()
    assert (masses.sum(1) <= 1 + 1e-4).all(), "no patch gives more than it has"


# ---- shortened


def test_a_reduced_descriptor_has_signed_sums_of_the_full_one() -> None:
    pictures = torch.from_numpy(images("reduced", (2, 3, 70, 70)))
    whole, reduced = ruled_megaloc(), ruled_megaloc()
    reduced.reduce(24)
    order, signs = signed_groups(96)
    given = whole(pictures)
    expected = torch.stack([given[:, i] * sign for i, sign in zip(order, signs, strict=True)], dim=1)
    expected = normalize(expected.unflatten(1, (24, 4)).sum(2), dim=1)
    assert reduced.length == 24
    torch.testing.assert_close(reduced(pictures), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("similarity", [0.0, 0.6, 0.95])
def test_reduction_keeps_similarities(similarity: float) -> None:
    """Estimates for pairs of random directions of this similarity have no bias, and the stated deviation."""
    random, count = np.random.default_rng(7), 500
    a, b = (unit_rows(random.normal(size=(count, 8448))) for _ in range(2))
    b = unit_rows(b - (a * b).sum(1, keepdims=True) * a)
    b = similarity * a + math.sqrt(1 - similarity**2) * b
    order, signs = (part.numpy() for part in signed_groups(8448))
    a, b = (unit_rows((x[:, order] * signs).reshape(count, 1056, 8).sum(2)) for x in (a, b))
    error = (a * b).sum(1) - similarity
    promised = (1 - similarity**2) / math.sqrt(1056)
    assert abs(error.mean()) < 4 * promised / math.sqrt(count)
    assert 0.8 * promised < error.std() < 1.1 * promised


def unit_rows(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(x / np.linalg.norm(x, axis=1, keepdims=True))


def test_order_and_signs_have_their_known_values() -> None:
    """Stored vectors are compared with new ones for as long as a scene exists."""
    order, signs = signed_groups(8448)
    assert sorted(order.tolist()) == list(range(8448))
    assert order[:5].tolist() == [5627, 2868, 7628, 8365, 7175]
    assert signs[:8].tolist() == [-1, -1, 1, -1, -1, -1, 1, -1]
    assert abs(float(signs.sum())) < 4 * math.sqrt(8448)


# ---- the descriptor


def test_a_photograph_has_a_vector_of_unit_length(descriptor: MegaLocDescriptor) -> None:
    it: GlobalDescriptor = descriptor
    blank = view_of(photograph(np.full((60, 80, 3), 128, np.uint8)))
    for view in (*some_views(2), blank):
        vector = it.describe(view)
        assert vector.shape == (24,)
        assert vector.dtype == np.float32
        assert np.linalg.norm(vector) == pytest.approx(1, abs=1e-6)
    assert it.extractor is None


def test_the_name_has_weights_and_length(file: Path, tmp_path: Path) -> None:
    network = ruled_megaloc()
    network.aggregator.linear.bias.data[0] += 1
    save_file(network.state_dict(), tmp_path / "other")
    names = {
        MegaLocDescriptor(of, sizes=SMALL_MEGALOC, dimension=dimension).name
        for of in (file, tmp_path / "other")
        for dimension in (24, 96)
    }
    assert len(names) == 4
    assert all(name.startswith(("megaloc-24-322px-", "megaloc-96-322px-")) for name in names)


@pytest.mark.parametrize("size", [(640, 480), (90, 700), (322, 322), (1, 130)])
def test_photographs_are_resized_as_published(descriptor: MegaLocDescriptor, size: tuple[int, int]) -> None:
    image = textured(*size, seed=9)
    pixels = torch.from_numpy(image).permute(2, 0, 1)[None].float()
    given: list[Tensor] = []
    hook = descriptor._network.register_forward_pre_hook(lambda _, inputs: given.append(inputs[0]))
    descriptor.describe(view_of(photograph(image)))
    hook.remove()
    expected = interpolate(pixels / 255, (SIDE_PX, SIDE_PX), mode="bilinear", antialias=True)
    torch.testing.assert_close(given[0], expected, rtol=0, atol=1e-6)


def test_low_precision_changes_vectors_little(file: Path) -> None:
    views = some_views(4)
    exact, rough = (
        np.stack([MegaLocDescriptor(file, sizes=SMALL_MEGALOC, dimension=24, dtype=dtype).describe(it) for it in views])
        for dtype in (torch.float32, torch.bfloat16)
    )
    assert rough.dtype == np.float32
    assert not np.array_equal(exact, rough)
    spread = np.linalg.norm(exact[0] - exact[1])
    assert np.linalg.norm(exact - rough, axis=1).max() < 0.1 * spread


# ---- weights


def test_adding_another_networks_weights_lists_the_differences(file: Path, tmp_path: Path) -> None:
    """Weights of the small network: the entries are there, the shapes are not those of the published one."""
    with pytest.raises(CheckpointError, match=r"does not fit MegaLoc: of its tensors .* of another shape"):
        add(named("megaloc"), file, tmp_path, unofficial=True)
    assert list(tmp_path.iterdir()) == []
