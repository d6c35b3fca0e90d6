"""What a device would have to do: operations, bytes and launches, counted without computing anything."""

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
    """One launch.

    Attributes:
        operations: on the unit that does them.
        bytes: to and from memory, if every argument is read once and every result written once.
        unit: "convolution", "matrix" (products in kernels of the project, TF32 or float32) or "lanes" (instructions of
            single threads).
    """

    operations: float = 0.0
    bytes: float = 0.0
    unit: str = "convolution"

    def seconds(self, rates: Mapping[str, float]) -> float:
        """By the roofline: what takes longer, the unit or the memory ("bytes" in the rates, a second each)."""
        return max(self.operations / rates[self.unit], self.bytes / rates["bytes"])


#: Without a launch: memory is reserved, or a value of the host is looked at.
_FREE = {"empty", "new_empty", "empty_like", "empty_strided", "lift_fresh", "_local_scalar_dense"}
#: cuDNN computes a ReLU with the convolution before it (`features.vgg`).
_FUSED = {"relu_"}


class Counted(TorchDispatchMode):
    """Notes every launch in its block, of tensors on the device "meta", which have sizes but no values.

    Attributes:
        works: in order.
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
    """Multiplications and additions of a convolution; what else there is in PyTorch's kernels is bound by bytes."""
    if name != "convolution":
        return 0.0
    weight: Tensor = args[1]
    return float(2 * result.numel() * weight[0].numel())


def meta(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """A tensor that has a size only."""
    return torch.empty(shape, dtype=dtype, device="meta")
