"""2x2 max pooling of ReLU outputs, and its backward pass together with the ReLU's.

Positions of maxima are not kept but found again: on a CPU in the same pass that spreads the gradient, which reads the
ReLU's output anyway. `max_pool_backward_reference` is the plain twin.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

#: Of as many bits.
_INTEGERS = {2: torch.int16, 4: torch.int32, 8: torch.int64}


def max_pool(source: Tensor) -> Tensor:
    """Maxima [1, c, h // 2, w // 2] of 2x2 windows of a ReLU's output [1, c, h, w], both channels last."""
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
    """Gradient of what went into the ReLU, [1, c, h, w], channels last.

    Args:
        gradient: of the pool's maxima, [1, c, h // 2, w // 2].
        source: the ReLU's output, [1, c, h, w]. The gradient goes to the first of equal maxima in each window.
    """
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


def max_pool_backward_reference(gradient: Tensor, source: Tensor) -> Tensor:
    """The same in operations of PyTorch, on any device."""
    spread: Tensor = torch.ops.aten.max_pool2d_with_indices_backward(
        gradient, source, [2, 2], [2, 2], [0, 0], [1, 1], False, max_positions(source)
    )
    return relu_backward(spread, source)


def max_positions(source: Tensor) -> Tensor:
    """Place of the first of each window's maxima in its plane, [1, c, h // 2, w // 2] int64."""
    positions: Tensor = F.max_pool2d(source, 2, return_indices=True)[1]
    return positions


def relu_backward(gradient: Tensor, output: Tensor) -> Tensor:
    """A gradient [1, c, h, w], made 0 where a ReLU's output is; on a CPU in place, which needs no new memory."""
    if not _is_compiled_for(output):
        result: Tensor = torch.ops.aten.threshold_backward(gradient, output, 0)
        return result
    result = torch.ops.aten.threshold_backward.grad_input(gradient, output, 0, grad_input=gradient)
    return result


def _is_compiled_for(values: Tensor) -> bool:
    return values.device.type == "cpu"


def _cells(values: Tensor) -> Tensor:
    """[h, w, c] of [1, c, h, w]: a view where channels lie last in memory."""
    return values[0].permute(1, 2, 0).contiguous()


def _integers(values: Tensor) -> Any:
    """A NumPy array of the same bits."""
    return values.view(_INTEGERS[values.element_size()]).numpy()


def _all_but_sign(values: Any) -> Any:
    """All bits but the sign's, in the type of some integers."""
    return values.dtype.type(np.iinfo(values.dtype).max)
