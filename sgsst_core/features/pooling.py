"""2x2 max pooling of ReLU outputs, and a backward pass through both the pooling and the ReLU.

The backward pass recomputes the positions of maxima instead of storing them. One kernel, of Numba on a CPU and of
Triton on a GPU, recomputes them and distributes the gradient, since both need the ReLU's output.
`max_pool_backward_reference` is the reference.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.devices import on_device
from sgsst_core.scene.spherical_harmonics import triton_runs_on

#: Integer types by bytes per value.
_INTEGERS = {2: torch.int16, 4: torch.int32, 8: torch.int64}


def max_pool(source: Tensor) -> Tensor:
    """Return the maxima [1, c, h // 2, w // 2] of 2x2 windows of a ReLU output [1, c, h, w], both channels last."""
    if has_kernel(source):
        return fused_max_pool(source)
    if not _is_compiled_for(source):
        pooled: Tensor = F.max_pool2d(source, 2, return_indices=True)[0]
        return pooled
    from sgsst_core.compiled import kernel_threads
    from sgsst_core.features import pooling_kernels as kernels

    _, channels, height, width = source.shape
    out = source.new_empty((height // 2, width // 2, channels))
    with kernel_threads():
        cells = _integers(_cells(source))
        kernels.max_pool(cells, _all_but_sign(cells), _integers(out))
    return out.permute(2, 0, 1).unsqueeze(0)


def max_pool_backward(gradient: Tensor, source: Tensor) -> Tensor:
    """Return the gradient with respect to the ReLU's input, [1, c, h, w], channels last.

    Args:
        gradient: Gradient of the maxima, [1, c, h // 2, w // 2].
        source: ReLU output, [1, c, h, w]. If a window has several equal maxima, the first one gets the gradient.
    """
    if has_kernel(source):
        return fused_max_pool_backward(gradient, source)
    if not _is_compiled_for(source):
        return max_pool_backward_reference(gradient, source)
    from sgsst_core.compiled import kernel_threads
    from sgsst_core.features import pooling_kernels as kernels

    cells = _integers(_cells(source))
    out = source.new_empty(cells.shape)
    with kernel_threads():
        slopes, nothing = _integers(_cells(gradient)), cells.dtype.type(0)
        kernels.max_pool_backward(slopes, cells, nothing, _all_but_sign(cells), _integers(out))
    return out.permute(2, 0, 1).unsqueeze(0)


def fused_max_pool(source: Tensor) -> Tensor:
    """Compute `max_pool` in one launch of a Triton kernel. PyTorch also writes 8-byte indices of the maxima."""
    from sgsst_core.features import pooling_triton_kernels as kernels

    cells = _cells(source).view(_INTEGERS[source.element_size()])
    height, width, channels = cells.shape
    out, block = source.new_empty((height // 2, width // 2, channels)), kernels.BLOCK.value
    if out.numel():
        with on_device(source.device):
            kernels.max_pool[(-(-out.numel() // block),)](
                cells, out.view(cells.dtype), width, width // 2, out.numel() // channels,
                CHANNELS=channels, MASK=torch.iinfo(cells.dtype).max, BLOCK=block,
            )  # fmt: skip
    return out.permute(2, 0, 1).unsqueeze(0)


def fused_max_pool_backward(gradient: Tensor, source: Tensor) -> Tensor:
    """Compute `max_pool_backward` in one launch of a Triton kernel, which reads and writes each value once."""
    from sgsst_core.features import pooling_triton_kernels as kernels

    cells, slopes = (_cells(values).view(_INTEGERS[values.element_size()]) for values in (source, gradient))
    height, width, channels = cells.shape
    out, block = source.new_empty(cells.shape), kernels.BLOCK.value
    windows = -(-height // 2) * -(-width // 2)
    if windows:
        with on_device(source.device):
            kernels.max_pool_backward[(-(-windows * channels // block),)](
                slopes, cells, out.view(cells.dtype), height, width, windows,
                CHANNELS=channels, MASK=torch.iinfo(cells.dtype).max, BLOCK=block,
            )  # fmt: skip
    return out.permute(2, 0, 1).unsqueeze(0)


def has_kernel(source: Tensor) -> bool:
    """Return whether there are Triton kernels for a ReLU output."""
    return source.device.type == "cuda" and source.element_size() <= 4 and triton_runs_on(source.device)


def max_pool_backward_reference(gradient: Tensor, source: Tensor) -> Tensor:
    """Compute `max_pool_backward` with PyTorch operations, on any device."""
    spread: Tensor = torch.ops.aten.max_pool2d_with_indices_backward(
        gradient, source, [2, 2], [2, 2], [0, 0], [1, 1], False, max_positions(source)
    )
    return relu_backward(spread, source)


def max_positions(source: Tensor) -> Tensor:
    """Return the flat index within its plane of the first maximum of each window, [1, c, h // 2, w // 2] int64."""
    positions: Tensor = F.max_pool2d(source, 2, return_indices=True)[1]
    return positions


def relu_backward(gradient: Tensor, output: Tensor) -> Tensor:
    """Zero a gradient [1, c, h, w] where the ReLU's output is 0. Works in place on a CPU, to avoid an allocation."""
    if not _is_compiled_for(output):
        result: Tensor = torch.ops.aten.threshold_backward(gradient, output, 0)
        return result
    result = torch.ops.aten.threshold_backward.grad_input(gradient, output, 0, grad_input=gradient)
    return result


def _is_compiled_for(values: Tensor) -> bool:
    return values.device.type == "cpu"


def _cells(values: Tensor) -> Tensor:
    """Return [1, c, h, w] as [h, w, c]; a view if the memory layout is channels last."""
    return values[0].permute(1, 2, 0).contiguous()


def _integers(values: Tensor) -> Any:
    """Reinterpret a tensor as a NumPy array of integers with the same bits."""
    return values.view(_INTEGERS[values.element_size()]).numpy()


def _all_but_sign(values: Any) -> Any:
    """Return the integer of the same type with all bits set except the sign bit."""
    return values.dtype.type(np.iinfo(values.dtype).max)
