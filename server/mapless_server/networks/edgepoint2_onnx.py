"""EdgePoint2 as a graph of ONNX, computed by ONNX Runtime: without torch, which takes a second and 200 MB to load.

It is the network of `edgepoint2`, in whose docstrings is how, with batch normalizations moved into the convolutions. On
one core of a CPU both take the same time. Where the processor has AVX2, the last layers, which take two thirds of it,
are compiled code (`edgepoint2_heads`).
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from onnx.onnx_ml_pb2 import ModelProto, NodeProto
from safetensors.numpy import load

from mapless_server.kernels import edgepoint2 as kernel

from .edgepoint2_heads import TRUNK, CompiledHeads, fused, parts, sampled
from .edgepoint2_sizes import GROUP, MULTIPLE_PX, VARIANTS, Describe, Widths
from .weights.catalogue import CheckpointError
from .weights.safetensors_header import check_fit, opened, read_header

Float = NDArray[np.float32]
Shapes = Mapping[str, tuple[int, ...]]

CONTRAST_EPSILON = 1e-5
"""Added to the variance of a photograph, which may be of one colour."""

OPSET, IR_VERSION = 17, 8
"""Versions of ONNX, which ONNX Runtime reads since 1.12."""


class OnnxEdgePoint2:
    """EdgePoint2 "s64", "m64", "l64" or "e64" with the weights of a file; CheckpointError if they do not fit.

    Attributes:
        sha256: SHA-256 of the file, hexadecimal.
    """

    def __init__(self, variant: str, weights: Path) -> None:
        widths = VARIANTS[variant]
        arrays, self.sha256 = _read(weights, widths)
        self._last, self._last_bias = arrays["desc_head.2.weight"][:, :, 0, 0].T, arrays["desc_head.2.bias"]
        self._heads = CompiledHeads(widths, arrays) if kernel.is_available() else None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # several photographs are described at a time
        graph = trunk_of(widths, arrays) if self._heads else graph_of(widths, arrays)
        model = graph.SerializeToString()  # type: ignore[no-untyped-call]
        self._session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])

    def release_memory(self) -> None:
        """Frees the arena of ONNX Runtime, as large as the largest image has needed: 120 MB for 640x480."""
        options = onnxruntime.RunOptions()
        options.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")
        self._session.run(None, {"image": np.zeros((1, 1, MULTIPLE_PX, MULTIPLE_PX), np.float32)}, options)

    def maps(self, grey: NDArray[np.uint8]) -> tuple[Float, Describe]:
        """Logits (H, W) of a grey image (H, W), and what returns descriptors at keypoints; see `Describe`."""
        height, width = grey.shape
        mean, sigma = (float(it[0, 0]) for it in cv2.meanStdDev(grey))
        scale = 1 / math.sqrt(sigma**2 + 255**2 * CONTRAST_EPSILON)
        padded = np.zeros((height + -height % MULTIPLE_PX, width + -width % MULTIPLE_PX), np.float32)
        image = padded[:height, :width]
        np.multiply(grey, np.float32(scale), out=image)
        image -= np.float32(mean * scale)
        names = TRUNK if self._heads else ("logits", "features")
        found = [np.asarray(it)[0] for it in self._session.run(names, {"image": padded[None, None]})]
        logits = self._heads.logits(found) if self._heads else found[0][0]

        def describe(keypoints: NDArray[np.float64]) -> Float:
            samples = self._heads.samples(found, keypoints) if self._heads else sampled(found[1], keypoints)
            return np.asarray(samples @ self._last + self._last_bias)

        return logits[:height, :width], describe


def shapes_of(widths: Widths) -> Shapes:
    """The shapes of a file's tensors."""
    half, eighth, last, score = widths.half, widths.eighth, widths.last, widths.score
    joint = half + eighth + last
    shapes: dict[str, tuple[int, ...]] = {}

    def normalized(name: str, width: int) -> None:
        shapes.update({f"{name}.{it}": (width,) for it in ("weight", "bias", "running_mean", "running_var")})
        shapes[f"{name}.num_batches_tracked"] = ()

    def convolution(name: str, width_in: int, width: int, side: int) -> None:
        shapes[f"{name}.layer.0.weight"] = (width, width_in, side, side)
        normalized(f"{name}.layer.1", width)

    def plain(name: str, width_in: int, width: int, side: int) -> None:
        shapes.update({f"{name}.weight": (width, width_in, side, side), f"{name}.bias": (width,)})

    def residual(name: str, width_in: int, width: int) -> None:
        for layer, width_before in (0, width_in), (3, width):
            shapes[f"{name}.layer.{layer}.weight"] = (width, width_before, 3, 3)
            normalized(f"{name}.layer.{layer + 1}", width)
        if width_in != width:
            plain(f"{name}.skip", width_in, width, 1)

    convolution("block1.0", 1, widths.first, 4)
    convolution("block1.1", widths.first, half, 3)
    residual("block1.2", half, half)
    residual("block2", half, eighth)
    residual("block3", eighth, last)
    plain("desc_head.0", joint, joint, 1)
    convolution("desc_head.1", GROUP, joint, 3)
    plain("desc_head.2", joint, widths.descriptor, 1)
    for name, width in ("conv1", half), ("conv2", eighth), ("conv3", last):
        plain(name, width, score, 1)
    for layer, width in (0, score), (2, score), (4, 4):
        plain(f"score_head.{layer}", score, width, 3)
    return shapes


def graph_of(widths: Widths, weights: Mapping[str, Float]) -> ModelProto:
    """The network's graph: "logits" (1, 1, H, W) and "features" (1, C, H / 4, W / 4) of "image" (1, 1, H, W).

    The image is normalized and padded.
    """
    graph = _Graph(weights)
    half, quarter, eighth, last = graph.trunk()
    scores = graph.plain(half, "conv1"), graph.plain(eighth, "conv2"), graph.plain(last, "conv3")
    score = graph.added(scores, (1, 4, 16))
    for layer in (0, 2):
        score = graph.node("Relu", graph.plain(score, f"score_head.{layer}"))
    score = graph.plain(score, "score_head.4")
    graph.node("DepthToSpace", score, name="logits", blocksize=2, mode="CRD")
    joined = graph.added(graph.parts([quarter, eighth, last], "desc_head.0", widths), (1, 2, 8))
    joint = widths.half + widths.eighth + widths.last
    graph.node("Identity", graph.convolution(joined, "desc_head.1", groups=joint // GROUP), name="features")
    return graph.model({"logits": 1, "features": joint})


def trunk_of(widths: Widths, weights: Mapping[str, Float]) -> ModelProto:
    """The graph of the maps that `CompiledHeads` take, each (1, C, H', W'), of "image" as in `graph_of`."""
    graph = _Graph(weights)
    maps = graph.trunk()
    _, _, eighth, last = maps
    for name, x in zip(TRUNK, (*maps, graph.plain(eighth, "conv2"), graph.plain(last, "conv3")), strict=True):
        graph.node("Identity", x, name=name)
    channels = widths.half, widths.half, widths.eighth, widths.last, widths.score, widths.score
    return graph.model(dict(zip(TRUNK, channels, strict=True)))


class _Graph:
    """A graph that grows by layers; a value is known by its name."""

    def __init__(self, weights: Mapping[str, Float]) -> None:
        self._weights = weights
        self._nodes: list[NodeProto] = []
        self._constants: list[TensorProto] = []

    def node(self, kind: str, *inputs: str, name: str = "", **attributes: int | str | Sequence[int]) -> str:
        name = name or f"value{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, inputs, [name], **attributes))  # type: ignore[arg-type]
        return name

    def constant(self, values: Float) -> str:
        name = f"constant{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def convolved(self, x: str, weight: Float, bias: Float | None, stride: int = 1, groups: int = 1) -> str:
        """Padded by one where the kernel is larger than a pixel."""
        constants = [self.constant(it) for it in (weight, bias) if it is not None]
        pads = [int(weight.shape[2] > 1)] * 4
        return self.node("Conv", x, *constants, strides=[stride, stride], pads=pads, group=groups)

    def plain(self, x: str, name: str) -> str:
        return self.convolved(x, self._weights[f"{name}.weight"], self._weights[f"{name}.bias"])

    def trunk(self) -> tuple[str, str, str, str]:
        """The maps at 1/2, 1/4, 1/8 and 1/32 of the image's size."""
        half = self.convolution(self.convolution("image", "block1.0", stride=2), "block1.1")
        half = self.residual(half, "block1.2")
        quarter = self.pooled(half, 2)
        eighth = self.residual(self.pooled(quarter, 2), "block2")
        return half, quarter, eighth, self.residual(self.pooled(eighth, 4), "block3")

    def normalized(self, x: str, name: str, layer: int, stride: int = 1, groups: int = 1) -> str:
        """A convolution and the batch normalization after it."""
        return self.convolved(x, *fused(self._weights, name, layer), stride, groups)

    def convolution(self, x: str, name: str, stride: int = 1, groups: int = 1) -> str:
        return self.node("Relu", self.normalized(x, name, 0, stride, groups))

    def residual(self, x: str, name: str) -> str:
        inner = self.normalized(self.node("Relu", self.normalized(x, name, 0)), name, 3)
        skipped = self.plain(x, f"{name}.skip") if f"{name}.skip.weight" in self._weights else x
        return self.node("Relu", self.node("Add", inner, skipped))

    def pooled(self, x: str, side: int) -> str:
        return self.node("AveragePool", x, kernel_shape=[side, side], strides=[side, side])

    def added(self, values: Sequence[str], factors: Sequence[int]) -> str:
        """The sum of maps, each enlarged by its factor."""
        total = ""
        for x, factor in zip(values, factors, strict=True):
            if factor > 1:
                scales = self.constant(np.array([1, 1, factor, factor], np.float32))
                x = self.node("Resize", x, "", scales, mode="linear")
            total = self.node("Add", total, x) if total else x
        return total

    def parts(self, values: Sequence[str], name: str, widths: Widths) -> list[str]:
        """A 1x1 convolution of joined maps, as one of each, whose results are added."""
        weights, biases = parts(self._weights[f"{name}.weight"], widths), (self._weights[f"{name}.bias"], None, None)
        return [self.convolved(*it) for it in zip(values, weights, biases, strict=True)]

    def model(self, outputs: Mapping[str, int]) -> ModelProto:
        """The model with these outputs, by name, each of so many channels."""
        values_in = [helper.make_tensor_value_info("image", TensorProto.FLOAT, (1, 1, "height", "width"))]
        values_out = [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, (1, channels, None, None))
            for name, channels in outputs.items()
        ]
        graph = helper.make_graph(self._nodes, "edgepoint2", values_in, values_out, self._constants)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)


def _read(file: Path, widths: Widths) -> tuple[Mapping[str, Float], str]:
    """The tensors of a file in single precision, and its SHA-256. CheckpointError if they do not fit the network."""
    expected = {name: (shape, not name.endswith("tracked")) for name, shape in shapes_of(widths).items()}
    check_fit(read_header(file), expected, (), (), f"{file} does not fit EdgePoint2")
    with opened(file) as stream:
        content = stream.read()
    arrays = {name: it.astype(np.float32) for name, it in load(content).items()}
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise CheckpointError(f"{file} holds numbers that are not finite, in {name}")
    return arrays, hashlib.sha256(content).hexdigest()
