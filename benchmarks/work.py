"""Counts of the operations, memory traffic and kernel launches of PyTorch code, without executing it on a GPU."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


@dataclass(frozen=True)
class Work:
    """Work of one kernel launch.

    Attributes:
        operations: Number of operations on `unit`.
        bytes: Memory traffic in bytes, if every argument is read once and every result written once.
        unit: Hardware unit: "convolution", "matrix" (matrix products in the project's kernels, TF32 or float32),
            "lanes" (thread instructions) or "float64" (those in float64).
    """

    operations: float = 0.0
    bytes: float = 0.0
    unit: str = "convolution"

    def seconds(self, rates: Mapping[str, float]) -> float:
        """Return the roofline time: the maximum of compute and memory time, given operations and bytes per second."""
        return max(self.operations / rates[self.unit], self.bytes / rates["bytes"])


#: Operations that launch no kernel: they only allocate memory or read a value on the host.
_FREE = {"empty", "new_empty", "empty_like", "empty_strided", "lift_fresh", "_local_scalar_dense"}
#: cuDNN fuses a ReLU with the convolution before it (`features.vgg`).
_FUSED = {"relu_"}


class Counted(TorchDispatchMode):
    """Recorder of all kernel launches on tensors of the device "meta", which have shapes but no values.

    Attributes:
        works: Work of each launch, in order.
    """

    def __init__(self) -> None:
        super().__init__()
        self.works: list[Work] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        name = func._schema.name.removeprefix("aten::")
        if name not in _FREE | _FUSED and not _is_view(func):
            tensors = [leaf for leaf in tree_leaves((args, kwargs, result)) if isinstance(leaf, Tensor)]
            size = sum(tensor.numel() * tensor.element_size() for tensor in tensors if tensor.device.type == "meta")
            self.works.append(Work(_operations(name, args, result), size))
        return result


def _is_view(func: Any) -> bool:
    aliases = [returned.alias_info for returned in func._schema.returns]
    return bool(aliases) and all(alias is not None and not alias.is_write for alias in aliases)


def _operations(name: str, args: Any, result: Any) -> float:
    """Return the multiplications and additions of a convolution, or 0 for other kernels, which are memory-bound."""
    if name != "convolution":
        return 0.0
    weight: Tensor = args[1]
    return float(2 * result.numel() * weight[0].numel())


def meta(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return a meta tensor, which has a shape but no values."""
    return torch.empty(shape, dtype=dtype, device="meta")
