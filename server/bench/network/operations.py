"""Counts the operations of a network on the meta device, where none is executed: they bound its time from below."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode


@dataclass(frozen=True)
class Peak:
    """The most operations per second of a device, those of a large bfloat16 product."""

    device: str
    flops: float

    def floor_ms(self, flop: int) -> float:
        """The least time for so many operations; no program is faster."""
        return 1e3 * flop / self.flops


H200 = Peak("NVIDIA H200", 790e12)
"""Once measured; floors are for it where there is no CUDA device."""


def count_flop(work: Callable[[], object]) -> int:
    """Counts the operations that `work` executes, a multiply-add as two; on the meta device nothing is computed."""
    # The plain attention consists of matrix products that are counted; of the other kernels not every one is.
    with torch.no_grad(), sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as flops:
        work()
    return int(flops.get_total_flops())


def compiled_graphs() -> int:
    """Number of graphs that torch has compiled in this process."""
    from torch._dynamo.utils import counters  # takes a second to import

    return int(counters["stats"]["unique_graphs"])
