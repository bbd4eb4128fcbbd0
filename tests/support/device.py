"""Visible signs of work on a device."""

from collections import Counter
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class Watch(TorchDispatchMode):
    """Fails at any operation that reads or writes a tensor outside one device.

    On the meta device, whose tensors have shapes and no values, an operation that needs a value fails by itself: what
    runs there never waits for a value.

    Attributes:
        launched: how often each operation ran, but for mere views.
    """

    def __init__(self, device: str) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.device = torch.device(device)
        self.launched: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        for value in tree_leaves((args, kwargs, result)):
            if isinstance(value, Tensor) and value.device.type != self.device.type:
                raise AssertionError(f"{func} touches a tensor {tuple(value.shape)} on {value.device}")
        if not func.is_view:
            self.launched[str(func)] += 1
        return result
