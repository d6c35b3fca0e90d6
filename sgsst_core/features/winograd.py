"""3x3 convolutions in float32 on a CPU, with a quarter of the multiplications.

Winograd's algorithm F(4x4, 3x3) (Lavin and Gray, "Fast Algorithms for Convolutional Neural Networks", CVPR 2016)
transforms windows of 6x6 values, multiplies them by the transformed weight (36 matrix products instead of 144
multiplications per value), and transforms the products into 4x4 results. Convolutions already reach the processor's
rate of matrix products, so that only fewer multiplications make them faster. Results differ from those of a direct
convolution by rounding.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

#: Transformation of a 3x3 weight, for interpolation at 0, 1, -1, 2, -2 and infinity.
_WEIGHT = torch.tensor(
    [
        [1 / 4, 0, 0],
        [-1 / 6, -1 / 6, -1 / 6],
        [-1 / 6, 1 / 6, -1 / 6],
        [1 / 24, 1 / 12, 1 / 6],
        [1 / 24, -1 / 12, 1 / 6],
        [0, 0, 1],
    ],
    dtype=torch.float64,
)
#: Side of the window of results.
_SIDE = 4
#: Most windows per matrix product: their transforms fit the caches, and the number does not depend on the threads, so
#: that the results do not either.
_WINDOWS = 128
#: Least channels on either side. Transforms take as long for each channel, matrix products longer the more there are.
_LEAST_CHANNELS = 64
#: Most computed results for each needed one. An image whose sides are no multiples of 4 is padded.
_MOST_COMPUTED = 1.5


def transform_weight(weight: Tensor) -> Tensor | None:
    """Return the transformed weight [36, in, out], float32, of a convolution [out, in, 3, 3]; None if too small."""
    if min(weight.shape[:2]) < _LEAST_CHANNELS:
        return None
    both = torch.kron(_WEIGHT, _WEIGHT)  # [36, 9]: in both directions
    transformed = both @ weight.double().permute(2, 3, 1, 0).reshape(9, -1)
    return transformed.float().view(36, weight.shape[1], weight.shape[0])


def pays_off(height: int, width: int) -> bool:
    """Return whether an image is large enough for its padding to be worth it."""
    return _rows(height) * _rows(width) * _SIDE**2 <= _MOST_COMPUTED * height * width


def convolve(x: Tensor, transformed: Tensor, bias: Tensor | None = None) -> Tensor:
    """Return a 3x3 convolution with padding 1; followed by bias and ReLU if there is a bias.

    The reference is `torch.nn.functional.conv2d` in float64.

    Args:
        x: [1, in, h, w], float32, channels last.
        transformed: Result of `transform_weight`.
        bias: [out].

    Returns:
        [1, out, h, w], channels last.
    """
    from sgsst_core.compiled import kernel_threads
    from sgsst_core.features import winograd_kernels as kernels

    cells: Any = x[0].permute(1, 2, 0).contiguous().numpy()
    height, width, channels = cells.shape
    out = torch.empty((height, width, int(transformed.shape[2])))
    added = torch.zeros(out.shape[2]) if bias is None else bias
    lowest = -torch.inf if bias is None else 0.0
    columns, windows = _rows(width), _rows(height) * _rows(width)
    together = -(-windows // -(-windows // _WINDOWS))
    sources = torch.empty(36 * together * channels)
    products = torch.empty(36 * together * out.shape[2])
    with kernel_threads():
        for first in range(0, windows, together):
            count = min(together, windows - first)
            source = sources[: 36 * count * channels].view(36, count, channels)
            product = products[: 36 * count * out.shape[2]].view(36, count, out.shape[2])
            kernels.transform_windows(cells, first, columns, source.numpy())
            torch.bmm(source, transformed, out=product)
            kernels.transform_products(product.numpy(), first, columns, added.numpy(), lowest, out.numpy())
    return out.permute(2, 0, 1).unsqueeze(0)


def _rows(side: int) -> int:
    """Return the number of windows of results that cover a side."""
    return -(-side // _SIDE)
