"""Counts the operations of a network on the meta device, where none is executed, and predicts its time from them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

MATRIX_EFFICIENCY = 0.75
"""Share of the measured peak that the linear layers' products are assumed to reach: theirs are smaller than its."""
ATTENTION_EFFICIENCY = 0.42
"""The same of flash attention with heads of 64 channels: as many exponentials as with 128, for half the products."""
TF32_RATE, FLOAT32_RATE = 0.5, 0.07
"""Rates of the device's other two kinds of product, as shares of bfloat16's: torch takes the first for convolutions in
float32, the second for linear layers in float32."""
COPY_EFFICIENCY = 0.8
"""Share of the copying rate that kernels between the products are assumed to reach."""

PRODUCTS: frozenset[Any] = frozenset(
    {F.linear, F.conv2d, F.conv_transpose2d, torch.conv2d, torch.conv_transpose2d, F.scaled_dot_product_attention}
)
"""What stays a kernel of its own when the rest is fused."""


@dataclass(frozen=True)
class Rates:
    """The limits of a device.

    They are operations per second of a large bfloat16 product, bytes read plus bytes written per second of a large
    copy, and the host's time to launch a kernel.
    """

    device: str
    matrix_flops: float
    copy_bytes: float
    launch_s: float = 6e-6
    measured: bool = False


H200 = Rates("NVIDIA H200", 790e12, 4.3e12)
"""Its two ceilings, once measured; predictions are for it where there is no CUDA device."""


@dataclass(frozen=True)
class Operations:
    """What a computation executes: operations (a multiply-add counts as two), kernels, and bytes between the products.

    Of `flop`, attention itself (q k^T and the weighted sum of v) has `attention_flop`, convolutions and linear layers
    in float32 the other two. `eager_bytes` are read and written if every operation is a kernel. `fused_bytes`, if all
    operations between two products are one kernel, which reads the output of one product and writes the input of the
    next; the residual stream is read and written at each addition.
    """

    flop: int = 0
    attention_flop: int = 0
    tf32_flop: int = 0
    float32_flop: int = 0
    kernels: int = 0
    eager_bytes: int = 0
    fused_bytes: int = 0

    def __add__(self, other: "Operations") -> "Operations":
        return Operations(*(a + b for a, b in zip(vars(self).values(), vars(other).values(), strict=True)))

    def floor_s(self, rates: Rates) -> float:
        """The least time; no program is faster."""
        return self.flop / rates.matrix_flops

    def predicted_s(self, rates: Rates, compiled: bool) -> float:
        """Time of products, attention and other operations in sequence; of kernel launches, if these take longer."""
        slower = self.tf32_flop * (1 / TF32_RATE - 1) + self.float32_flop * (1 / FLOAT32_RATE - 1)
        products = (self.flop - self.attention_flop + slower) / (MATRIX_EFFICIENCY * rates.matrix_flops)
        attention = self.attention_flop / (ATTENTION_EFFICIENCY * rates.matrix_flops)
        between = (self.fused_bytes if compiled else self.eager_bytes) / (COPY_EFFICIENCY * rates.copy_bytes)
        busy_s = products + attention + between
        return busy_s if compiled else max(busy_s, self.kernels * rates.launch_s)


def count_operations(work: Callable[[], object]) -> Operations:
    """Counts what `work` executes; on the meta device nothing is computed."""
    # The plain attention consists of matrix products that are counted; of the other kernels not every one is.
    with torch.no_grad(), sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as flops, _Traffic() as traffic:
        work()
    flop: int = flops.get_total_flops()
    counted: Operations = traffic.counted
    return replace(counted, flop=flop)


class _Traffic(TorchFunctionMode):
    """Observes torch's functions, and counts all but `Operations.flop`."""

    def __init__(self) -> None:
        super().__init__()
        self.counted = Operations()

    def __torch_function__(
        self, func: Any, _: Any, args: Sequence[Any] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        inputs = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        outputs = [leaf for leaf in tree_leaves(result) if isinstance(leaf, Tensor)]
        # What a product gives may be a view of what it computed.
        new = [it for it in outputs if not it._is_view() and all(it is not given for given in inputs)]
        made = outputs if func in PRODUCTS else new
        if made:
            self.counted += _counted(func, inputs, made)
        return result


def _counted(func: Any, inputs: Sequence[Tensor], made: Sequence[Tensor]) -> Operations:
    """Counts what one function that makes tensors executes."""
    written = sum(tensor.nbytes for tensor in made)
    if func not in PRODUCTS:
        adds = func in (Tensor.add, Tensor.__add__, torch.add)
        moved = sum(tensor.nbytes for tensor in inputs) + written
        return Operations(kernels=1, eager_bytes=moved, fused_bytes=2 * written if adds else 0)
    if func is F.scaled_dot_product_attention:
        q, k, _ = inputs
        passed = sum(tensor.nbytes for tensor in inputs) + written
        return Operations(attention_flop=4 * prod(q.shape) * k.shape[-2], kernels=1, fused_bytes=passed)
    x, weight = inputs[:2]
    operations = Operations(kernels=1, fused_bytes=x.nbytes + written)
    if x.dtype is not torch.float32:
        return operations
    if func is F.linear:
        return replace(operations, float32_flop=2 * made[0].numel() * weight.shape[1])
    positions = x.numel() if func in (F.conv_transpose2d, torch.conv_transpose2d) else made[0].numel()
    return replace(operations, tf32_flop=2 * positions * prod(weight.shape[1:]))


def compiled_graphs() -> int:
    """Number of graphs that torch has compiled in this process."""
    from torch._dynamo.utils import counters  # takes a second to import

    return int(counters["stats"]["unique_graphs"])
