"""A network loads a file of exactly its tensors, bit for bit; otherwise it is unchanged and the error lists why."""

import gzip
import hashlib
import io
import json
import math
import os
import pickle
import re
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.safetensors_files import entry, safetensors, with_header

from mapless_server.networks.weights import (
    CheckpointError,
)
from mapless_server.networks.weights.safetensors_header import Header, opened, read_header

torch = pytest.importorskip("torch")
library = pytest.importorskip("safetensors.torch")

from mapless_server.networks.checkpoint import FileNames, expected_tensors, load_strictly  # noqa: E402
from mapless_server.networks.mapanything import canonical_name  # noqa: E402
from mapless_server.networks.weights import CATALOGUE  # noqa: E402

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

    Those of Pi3X and MapAnything hold, besides ours, encoders of depths; MapAnything's, as metadata, the other names of
    tensors that its modules share.
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
        for ours, theirs in (
            ("ray_dirs_encoder.", "depth_encoder."),
            ("cam_trans_scale_encoder.", "depth_scale_encoder."),
        ):
            shapes |= {key.replace(ours, theirs): shape for key, shape in shapes.items() if key.startswith(ours)}
        shapes["depth_encoder.conv_in.weight"] = [588, 14 * 14, 3, 3]
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


# Headers


CONTENT = safetensors({"a.weight": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.zeros(2, np.float16)})


def header_of(content: bytes, folder: Path) -> Header:
    path = folder / "file.safetensors"
    path.write_bytes(content)
    return read_header(path)


def test_a_header_has_types_and_shapes_in_the_order_of_bytes(tmp_path: Path) -> None:
    header = header_of(CONTENT, tmp_path)
    assert [(name, it.dtype, it.shape) for name, it in header.entries.items()] == [
        ("a.weight", "F32", (2, 3)),
        ("b", "F16", (2,)),
    ]
    assert header.size_bytes == len(CONTENT) - 28


def test_a_header_length_like_a_pickles_magic_is_accepted(tmp_path: Path) -> None:
    content = with_header({"__metadata__": {"filler": "x" * (0x0280 - 30)}})
    assert content[:2] == b"\x80\x02"
    assert header_of(content, tmp_path).entries == {}


def zip_archive() -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("data.pkl", b"")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (zip_archive(), "not a safetensors file: it is a zip archive, as PyTorch's pickles are"),
        *((pickle.dumps([1] * 40, protocol), "it is a pickle") for protocol in (2, 3, 4, 5)),
        (b"<!doctype html><html>", "it is a web page"),
        (b"version https://git-lfs.github.com/spec/v1\n", "it is a Git LFS pointer"),
        (gzip.compress(CONTENT), "it is gzip"),
        (b"\x05", "not a safetensors file"),
        (b"\xff" * 7 + b"\x7f{", "header is damaged: header too large"),
        (CONTENT[:60], "cut short within its header"),
        (CONTENT[:-1], "cut short, or longer than its tensors"),
        (CONTENT + b"!", "cut short, or longer than its tensors"),
        (with_header(b'{"a":'), "damaged"),
        (with_header(b'{"a":' * 50_000), "damaged"),
        (with_header({"a": {"dtype": "F32", "shape": [2]}}), "header is damaged: .*data_offsets"),
        (with_header({"a": entry(shape=(-2,))}, bytes(8)), "header is damaged: .*-2"),
        (with_header({"a": entry(shape=(3,))}, bytes(8)), "header is damaged: invalid shape"),
        (with_header({"a": entry(begin=8, end=16)}, bytes(16)), "header is damaged: invalid offset for tensor `a`"),
        (with_header({"a": entry(), "b": entry(begin=4, end=12)}, bytes(12)), "invalid offset for tensor `b`"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_other_formats_are_refused_by_name(content: bytes, words: str, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError) as caught:
        header_of(content, tmp_path)
    assert re.search(words, str(caught.value))
    assert "file.safetensors" in str(caught.value)
    assert "\n" not in str(caught.value)


@given(position=st.integers(0, len(CONTENT) - 1), byte=st.integers(0, 255), length=st.integers(0, len(CONTENT)))
def test_a_damaged_file_is_read_or_raises_checkpoint_error(position: int, byte: int, length: int) -> None:
    content = (CONTENT[:position] + bytes([byte]) + CONTENT[position + 1 :])[:length]
    with tempfile.TemporaryDirectory() as folder:
        try:
            header = header_of(content, Path(folder))
        except CheckpointError:
            return
    item_bytes = {"F64": 8, "I64": 8, "F32": 4, "I32": 4, "F16": 2, "I16": 2, "U16": 2, "BF16": 2}
    data = sum(math.prod(it.shape) * item_bytes[it.dtype] for it in header.entries.values())
    assert header.size_bytes + data == len(content)


def test_an_unreadable_file_is_reported(tmp_path: Path) -> None:
    file = tmp_path / "file.safetensors"
    file.touch()
    file.chmod(0)
    user = os.geteuid()
    if user == 0:  # root may read everything
        os.seteuid(65534)
    try:
        with pytest.raises(CheckpointError, match="Permission denied"), opened(file):
            pass
    finally:
        os.seteuid(user)
