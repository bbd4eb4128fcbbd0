"""Transfer between host and device: arrays up without waiting, results down in one piece."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

Record = TypeVar("Record")


def upload(record: Record, device: torch.device) -> Record:
    """Copies a dataclass, with every NumPy array in it, to the device.

    Returns at once: on CUDA the arrays are copied from pinned memory, and the host does not wait for the network.
    """

    def up(array: Any) -> Tensor:
        tensor = torch.from_numpy(np.require(array, requirements=("C", "W")))  # torch warns of read-only arrays
        return (tensor.pin_memory() if device.type == "cuda" else tensor).to(device, non_blocking=True)

    return _changed(record, np.ndarray, up)


def fetch(record: Record) -> Record:
    """Copies a dataclass, with every tensor in it as a NumPy array, to the host in one transfer.

    Values are transferred as float64, which represents every index and flag exactly.
    """
    tensors: list[Tensor] = []
    _changed(record, Tensor, tensors.append)
    flat = torch.cat([tensor.double().reshape(-1) for tensor in tensors]).cpu().numpy()
    parts = iter(np.split(flat, np.cumsum([tensor.numel() for tensor in tensors])[:-1]))
    return _changed(record, Tensor, lambda tensor: next(parts).reshape(tensor.shape))


def _changed(record: Record, kind: type, change: Callable[[Any], object]) -> Record:
    """Returns the dataclass with `change` applied to every value of this kind in it, at any depth."""
    values: dict[str, Any] = {field.name: getattr(record, field.name) for field in fields(record)}  # type: ignore[arg-type]
    changes = {name: change(value) for name, value in values.items() if isinstance(value, kind)}
    changes |= {name: _changed(value, kind, change) for name, value in values.items() if is_dataclass(value)}
    return replace(record, **changes)  # type: ignore[type-var]
