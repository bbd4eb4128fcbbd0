"""A network loads a file of exactly its tensors, bit for bit; otherwise it is unchanged and the error lists why."""

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")
library = pytest.importorskip("safetensors.torch")

from mapless_server.networks.checkpoint import FileNames, expected_tensors, load_strictly  # noqa: E402
from mapless_server.networks.mapanything import canonical_name  # noqa: E402
from mapless_server.networks.weights import CATALOGUE, CheckpointError  # noqa: E402

Tensors = dict[str, Any]


class Network(torch.nn.Module):  # type: ignore[misc, name-defined]
    """A network with all that a state dict can hold: parameters, buffers, counters, a scalar, an empty tensor."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.BatchNorm1d(4))
        self.scale = torch.nn.Parameter(torch.zeros(()))
        self.nothing = torch.nn.Parameter(torch.zeros(0, 3))
        self.register_buffer("image_mean", torch.zeros(1, 3, 1, 1))
        self.register_buffer("image_std", torch.zeros(1, 3, 1, 1))
        self.register_buffer("table", torch.full((2,), 7.0), persistent=False)


def on_meta() -> Network:
    with torch.device("meta"):
        return Network()


@pytest.fixture
def tensors() -> Tensors:
    generator = torch.Generator().manual_seed(0)
    return {
        name: torch.rand(shape, generator=generator) if is_float else torch.tensor(5)
        for name, (shape, is_float) in expected_tensors(Network()).items()
    }


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "net.safetensors"


def load(tensors: Tensors, file: Path, network: Network | None = None, **options: Any) -> tuple[Network, str]:
    library.save_file(tensors, file)
    network = network or on_meta()
    return network, load_strictly(network, file, **options)


def test_loaded_tensors_equal_those_of_the_library(tensors: Tensors, file: Path) -> None:
    network, identity = load(tensors, file)
    state, read = network.state_dict(), library.load_file(file)
    assert list(state) == list(expected_tensors(Network()))
    assert set(read) == set(state)
    for name, tensor in read.items():
        assert torch.equal(state[name], tensor)
        assert state[name].dtype == tensor.dtype
    assert identity == hashlib.sha256(file.read_bytes()).hexdigest()
    assert all(parameter.requires_grad for parameter in network.parameters())


def test_a_module_on_a_device_keeps_its_other_buffers(tensors: Tensors, file: Path) -> None:
    network, _ = load(tensors, file, Network())
    assert torch.equal(network.scale, tensors["scale"])
    assert network.table.tolist() == [7.0, 7.0]


@pytest.mark.parametrize("stored", [torch.bfloat16, torch.float16, torch.float64])
@pytest.mark.parametrize("wanted", [torch.float32, torch.bfloat16])
def test_numbers_are_converted_to_the_modules_precision(tensors: Tensors, file: Path, stored: Any, wanted: Any) -> None:
    tensors = {name: t.to(stored) if t.is_floating_point() else t for name, t in tensors.items()}
    network, _ = load(tensors, file, on_meta().to(wanted))
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, tensors[name].to(tensor.dtype))
    assert network.scale.dtype == wanted
    assert network.layers[1].num_batches_tracked.dtype == torch.int64


def test_missing_constants_are_imagenets(tensors: Tensors, file: Path) -> None:
    del tensors["image_mean"], tensors["image_std"]
    network, _ = load(tensors, file)
    assert network.image_mean.flatten().tolist() == pytest.approx([0.485, 0.456, 0.406])
    assert network.image_std.shape == (1, 3, 1, 1)


def test_an_optional_tensor_keeps_the_modules_value(tensors: Tensors, file: Path) -> None:
    del tensors["scale"]
    network = Network()
    torch.nn.init.constant_(network.scale, 3.0)
    network, _ = load(tensors, file, network, optional={"scale": None})
    assert network.scale.item() == 3.0
    with pytest.raises(ValueError, match="scale is on the meta device"):
        load(tensors, file, on_meta(), optional={"scale": None})


def without(*names: str) -> Callable[[Tensors], Tensors]:
    return lambda tensors: {name: tensor for name, tensor in tensors.items() if name not in names}


def with_(**others: Any) -> Callable[[Tensors], Tensors]:
    return lambda tensors: tensors | {name.replace("__", "."): tensor for name, tensor in others.items()}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without("layers.0.weight"), "1 missing: layers.0.weight"),
        (with_(omega=torch.zeros(1)), "1 surplus: omega"),
        (with_(**{f"x{i}": torch.zeros(1) for i in range(9)}), "9 surplus: x0, x1, x2, and 6 more"),
        (with_(layers__0__weight=torch.zeros(4, 4)), "1 of another shape: layers.0.weight is (4, 4), not (4, 3)"),
        (with_(layers__0__weight=torch.zeros(3, 4)), "layers.0.weight is (3, 4), not (4, 3)"),
        (with_(scale=torch.zeros(1)), "scale is (1,), not ()"),
        (with_(layers__0__bias=torch.zeros(4, dtype=torch.int64)), "1 of another type: layers.0.bias is I64"),
        (with_(layers__1__num_batches_tracked=torch.tensor(5.0)), "layers.1.num_batches_tracked is F32"),
        (with_(layers__0__bias=torch.tensor([0, 0, math.nan, 0])), "not finite, in layers.0.bias"),
        (with_(scale=torch.tensor(-math.inf)), "not finite, in scale"),
        (with_(scale=torch.tensor(math.nan, dtype=torch.bfloat16)), "not finite, in scale"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_wrong_tensors_are_refused_and_the_module_is_unchanged(
    tensors: Tensors, file: Path, change: Callable[[Tensors], Tensors], words: str
) -> None:
    network = Network()
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    with pytest.raises(CheckpointError) as caught:
        load(change(tensors), file, network)
    assert words in str(caught.value)
    assert str(file) in str(caught.value)
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, before[name])


def test_tensors_with_unused_prefixes_are_skipped(
    tensors: Tensors, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Network, "file_names", FileNames(unused_prefixes=("omega", "flow_head.")), raising=False)
    surplus = {"omega": torch.tensor([math.nan]), "flow_head.weight": torch.zeros(3)}
    network, identity = load(tensors | surplus, file)
    assert torch.equal(network.scale, tensors["scale"])
    assert identity == hashlib.sha256(file.read_bytes()).hexdigest()


def test_files_of_other_formats_are_refused_unopened(tensors: Tensors, file: Path) -> None:
    torch.save(tensors, file)
    with pytest.raises(CheckpointError, match="it is a zip archive, as PyTorch's pickles are"):
        load_strictly(on_meta(), file)
    torch.save(tensors, file, _use_new_zipfile_serialization=False)
    with pytest.raises(CheckpointError, match="it is a pickle"):
        load_strictly(on_meta(), file)
    library.save_file(tensors, file)
    file.write_bytes(file.read_bytes()[:-4])
    with pytest.raises(CheckpointError, match="cut short"):
        load_strictly(on_meta(), file)


@pytest.mark.parametrize("name", ["pi3", "pi3x", "mapanything", "megaloc"])
def test_the_official_file_has_the_size_of_its_tensors(name: str) -> None:
    """The header of a float32 file, as the library writes it, and its data, to the byte.

    Pi3X's holds, besides ours, a second encoder for depths, of two channels; MapAnything's, as metadata, the other
    names of tensors that its modules share.
    """
    (weights,) = [weights for weights in CATALOGUE if weights.name == name]
    module, class_name = weights.network.split(":")
    with torch.device("meta"):
        network = getattr(pytest.importorskip(module), class_name)()
    shapes = {key: list(tensor.shape) for key, tensor in network.state_dict().items()}
    if name == "pi3x":
        shapes |= {f"depth_{key}": shape for key, shape in shapes.items() if key.startswith("encoder.")}
        shapes |= {"depth_encoder.patch_embed.proj.weight": [1024, 2, 14, 14], "depth_emb": [1, 1, 1024]}
    header: dict[str, Any] = {}
    if name == "mapanything":
        header["__metadata__"] = {alias: canonical_name(alias) for alias in mapanything_aliases(shapes)}
    end = 0
    for key, shape in sorted(shapes.items()):
        begin, end = end, end + 4 * math.prod(shape)
        header[key] = {"dtype": "F32", "shape": shape, "data_offsets": [begin, end]}
    length = len(json.dumps(header, separators=(",", ":")))
    assert weights.size_bytes == 8 + length + -length % 8 + end


def mapanything_aliases(names: Iterable[str]) -> Iterator[str]:
    """The 76 further names of tensors of the official network."""
    inputs, regression = "dense_head.0.", "dense_head.1."
    for name in names:
        if name.startswith(regression):
            yield "dpt_regressor_head." + name.removeprefix(regression)
        elif name.startswith(inputs):
            yield "dpt_feature_head." + name.removeprefix(inputs)
    for i in range(4):
        for head in (inputs, "dpt_feature_head."):
            yield f"{head}scratch.layer{i + 1}_rn.weight"
            yield f"{head}scratch.layer_rn.{i}.weight"
