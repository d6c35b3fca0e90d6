"""Layers of the feature network with kernels of their own: pooling, first convolution, Winograd's convolution.

The backward pass of 2x2 max pooling goes through the ReLU before it too, and recomputes the positions of maxima instead
of storing them. One kernel, of Numba on a CPU and of Triton on a GPU, recomputes them and distributes the gradient,
since both need the ReLU's output. `max_pool_backward_reference` is the reference. Kernels read ReLU outputs as integers
with the same bits: non-negative floats and their bit patterns have the same order, and integers can be compared and
selected with SIMD in any format, including bfloat16. The sign bit is masked out, because a ReLU passes on -0 and NaN of
either sign. A masked NaN is larger than all numbers, so it reaches the loss.

On a GPU with 16-bit features, one kernel each does the first convolution, its backward pass, and what surrounds them:
normalization, bias, ReLU, and the factor of the pixels. `FeatureNetwork` contains the references: it does the same with
PyTorch operations where there are no kernels.

On a CPU, convolutions in float32 take a quarter of the multiplications: Winograd's algorithm F(4x4, 3x3) (Lavin and
Gray, "Fast Algorithms for Convolutional Neural Networks", CVPR 2016) transforms windows of 6x6 values, multiplies them
by the transformed weight (36 matrix products instead of 144 multiplications per value), and transforms the products
into 4x4 results. Convolutions already reach the processor's rate of matrix products, so that only fewer multiplications
make them faster. Results differ from those of a direct convolution by rounding.
"""

# Arguments of kernels are untyped: Numba compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def"

from typing import Any

import numba
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.compiled import compiled, kernel_threads
from sgsst_core.devices import on_device
from sgsst_core.features.statistics import block_of_channels, has_kernels
from sgsst_core.scene.spherical_harmonics import triton_runs_on

#: Integer types by bytes per value.
_INTEGERS = {2: torch.int16, 4: torch.int32, 8: torch.int64}


def max_pool(source: Tensor) -> Tensor:
    """Return the maxima [1, c, h // 2, w // 2] of 2x2 windows of a ReLU output [1, c, h, w], both channels last."""
    if has_pooling_kernel(source):
        return fused_max_pool(source)
    if not _is_compiled_for(source):
        return F.max_pool2d(source, 2, return_indices=True)[0]
    _, channels, height, width = source.shape
    out = source.new_empty((height // 2, width // 2, channels))
    with kernel_threads():
        cells = _integers(_cells(source))
        _pool(cells, _all_but_sign(cells), _integers(out))
    return out.permute(2, 0, 1).unsqueeze(0)


def max_pool_backward(gradient: Tensor, source: Tensor) -> Tensor:
    """Return the gradient with respect to the ReLU's input, [1, c, h, w], channels last.

    Args:
        gradient: Gradient of the maxima, [1, c, h // 2, w // 2].
        source: ReLU output, [1, c, h, w]. If a window has several equal maxima, the first one gets the gradient.
    """
    if has_pooling_kernel(source):
        return fused_max_pool_backward(gradient, source)
    if not _is_compiled_for(source):
        return max_pool_backward_reference(gradient, source)
    cells = _integers(_cells(source))
    out = source.new_empty(cells.shape)
    with kernel_threads():
        slopes, nothing = _integers(_cells(gradient)), cells.dtype.type(0)
        _pool_backward(slopes, cells, nothing, _all_but_sign(cells), _integers(out))
    return out.permute(2, 0, 1).unsqueeze(0)


@compiled(parallel=True)
def _pool(source, mask, out):
    """Write the maxima of 2x2 windows of source [h, w, c] to out [h // 2, w // 2, c].

    `mask` has all bits of the type set except the sign bit.
    """
    rows, columns, channels = out.shape
    for i in numba.prange(rows):
        for j in range(columns):
            a, b = source[2 * i, 2 * j], source[2 * i, 2 * j + 1]
            c, d = source[2 * i + 1, 2 * j], source[2 * i + 1, 2 * j + 1]
            result = out[i, j]
            for k in range(channels):
                result[k] = max(max(a[k] & mask, b[k] & mask), max(c[k] & mask, d[k] & mask))


@compiled(parallel=True)
def _pool_backward(gradient, source, nothing, mask, out):
    """Write the gradient with respect to the ReLU's input to out [h, w, c].

    `gradient` [h // 2, w // 2, c] is the gradient of the maxima. In each window, the first maximum gets it if it is
    above 0; all other values get 0. `nothing` is the type's 0; `mask` is as in `_pool`.
    """
    rows, columns, channels = gradient.shape
    height, width = out.shape[0], out.shape[1]
    for i in numba.prange((height + 1) // 2):
        if i == rows:  # last row if the height is odd
            out[2 * i] = nothing
            continue
        if width % 2:
            out[2 * i, width - 1] = nothing
            out[2 * i + 1, width - 1] = nothing
        for j in range(columns):
            a, b = source[2 * i, 2 * j], source[2 * i, 2 * j + 1]
            c, d = source[2 * i + 1, 2 * j], source[2 * i + 1, 2 * j + 1]
            to_a, to_b = out[2 * i, 2 * j], out[2 * i, 2 * j + 1]
            to_c, to_d = out[2 * i + 1, 2 * j], out[2 * i + 1, 2 * j + 1]
            slope = gradient[i, j]
            for k in range(channels):
                at_a, at_b, at_c = a[k] & mask, b[k] & mask, c[k] & mask
                most = max(max(at_a, at_b), max(at_c, d[k] & mask))
                g = slope[k] if most > nothing else nothing
                is_a, is_b, is_c = at_a == most, at_b == most, at_c == most
                to_a[k] = g if is_a else nothing
                to_b[k] = g if is_b and not is_a else nothing
                to_c[k] = g if is_c and not (is_a or is_b) else nothing
                to_d[k] = nothing if is_a or is_b or is_c else g


def fused_max_pool(source: Tensor) -> Tensor:
    """Compute `max_pool` in one launch of a Triton kernel. PyTorch also writes 8-byte indices of the maxima."""
    from sgsst_core.features import triton_kernels as kernels

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
    from sgsst_core.features import triton_kernels as kernels

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


def has_pooling_kernel(source: Tensor) -> bool:
    """Return whether there are Triton kernels for a ReLU output."""
    return source.device.type == "cuda" and source.element_size() <= 4 and triton_runs_on(source.device)


def max_pool_backward_reference(gradient: Tensor, source: Tensor) -> Tensor:
    """Compute `max_pool_backward` with PyTorch operations, on any device."""
    positions = F.max_pool2d(source, 2, return_indices=True)[1]
    spread: Tensor = torch.ops.aten.max_pool2d_with_indices_backward(
        gradient, source, [2, 2], [2, 2], [0, 0], [1, 1], False, positions
    )
    return relu_backward(spread, source)


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


def has_pixel_kernels(weight: Tensor) -> bool:
    """Return whether there are kernels for weights [c, 3, 3, 3] of the first convolution, or their transpose."""
    channels = max(weight.shape[:2])
    return weight.element_size() == 2 and has_kernels(weight.device, channels)


def convolve_pixels(pixels: Tensor, weight: Tensor, bias: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
    """Return relu(convolution(scale * pixels + shift) + bias), [1, c, h, w], channels last.

    Args:
        pixels: [h, w, 3] float32.
        weight: [c, 3, 3, 3], channels last, bfloat16 or float16.
        scale, shift: [3] float32.
    """
    from sgsst_core.features import triton_kernels as kernels

    (height, width, _), channels, strip = pixels.shape, len(weight), kernels.P.value
    out = torch.empty((height, width, channels), dtype=weight.dtype, device=pixels.device)
    with on_device(pixels.device):
        kernels.convolve_pixels[(height * -(-width // strip),)](
            pixels.contiguous(), weight, bias, scale, shift, out, height, width,
            CHANNELS=channels, BLOCK=block_of_channels(channels), P=strip,
        )  # fmt: skip
    return out.permute(2, 0, 1).unsqueeze(0)


def pixel_gradient(gradient: Tensor, backward_weight: Tensor, scale: Tensor) -> Tensor:
    """Return the gradient of the pixels [h, w, 3] float32.

    Args:
        gradient: Gradient of the convolution's output before its ReLU, [1, c, h, w], channels last.
        backward_weight: Transposed and flipped weights [3, c, 3, 3], channels last.
        scale: [3] float32.
    """
    from sgsst_core.features import triton_kernels as kernels

    cells, strip = gradient[0].permute(1, 2, 0).contiguous(), kernels.P.value
    height, width, channels = cells.shape
    out = torch.empty((3, height, width, 3), device=cells.device)
    with on_device(cells.device):
        kernels.pixel_gradients[((height + 2) * -(-width // strip),)](
            cells, backward_weight, scale, out, height, width,
            CHANNELS=channels, BLOCK=block_of_channels(channels), P=strip,
        )  # fmt: skip
    return out.sum(dim=0)


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


def winograd_pays_off(height: int, width: int) -> bool:
    """Return whether an image is large enough for its padding to be worth it."""
    return _tile_rows(height) * _tile_rows(width) * _SIDE**2 <= _MOST_COMPUTED * height * width


def convolve_winograd(x: Tensor, transformed: Tensor, bias: Tensor | None = None) -> Tensor:
    """Return a 3x3 convolution with padding 1; followed by bias and ReLU if there is a bias.

    The reference is `torch.nn.functional.conv2d` in float64.

    Args:
        x: [1, in, h, w], float32, channels last.
        transformed: Result of `transform_weight`.
        bias: [out].

    Returns:
        [1, out, h, w], channels last.
    """
    cells: Any = x[0].permute(1, 2, 0).contiguous().numpy()
    height, width, channels = cells.shape
    out = torch.empty((height, width, int(transformed.shape[2])))
    added = torch.zeros(out.shape[2]) if bias is None else bias
    lowest = -torch.inf if bias is None else 0.0
    columns, windows = _tile_rows(width), _tile_rows(height) * _tile_rows(width)
    together = -(-windows // -(-windows // _WINDOWS))
    sources = torch.empty(36 * together * channels)
    products = torch.empty(36 * together * out.shape[2])
    with kernel_threads():
        for first in range(0, windows, together):
            count = min(together, windows - first)
            source = sources[: 36 * count * channels].view(36, count, channels)
            product = products[: 36 * count * out.shape[2]].view(36, count, out.shape[2])
            _transform_windows(cells, first, columns, source.numpy())
            torch.bmm(source, transformed, out=product)
            _transform_products(product.numpy(), first, columns, added.numpy(), lowest, out.numpy())
    return out.permute(2, 0, 1).unsqueeze(0)


def _tile_rows(side: int) -> int:
    """Return the number of windows of results that cover a side."""
    return -(-side // _SIDE)


#: Windows that a thread transforms with the same working memory.
_TOGETHER = 8
_TWO, _FOUR, _EIGHT = np.float32(2), np.float32(4), np.float32(8)


@compiled(parallel=True)
def _transform_windows(x, first, columns, out):
    """Write the transforms of 6x6 windows to out [36, n, c], beginning with window `first` of x [h, w, c].

    Windows are 4 cells apart, `columns` of them in a row; they begin one cell outside of x, which is 0 there.
    """
    count, channels = out.shape[1], out.shape[2]
    nothing = np.zeros(channels, np.float32)
    for part in numba.prange((count + _TOGETHER - 1) // _TOGETHER):
        half = np.empty((6, 6, channels), np.float32)
        for n in range(part * _TOGETHER, min(count, (part + 1) * _TOGETHER)):
            top, left = 4 * ((first + n) // columns) - 1, 4 * ((first + n) % columns) - 1
            for j in range(6):
                _transform_six(
                    _cell(x, top, left + j, nothing),
                    _cell(x, top + 1, left + j, nothing),
                    _cell(x, top + 2, left + j, nothing),
                    _cell(x, top + 3, left + j, nothing),
                    _cell(x, top + 4, left + j, nothing),
                    _cell(x, top + 5, left + j, nothing),
                    half[0, j], half[1, j], half[2, j], half[3, j], half[4, j], half[5, j],
                )  # fmt: skip
            for i in range(6):
                row = 6 * i
                _transform_six(
                    half[i, 0], half[i, 1], half[i, 2], half[i, 3], half[i, 4], half[i, 5],
                    out[row, n], out[row + 1, n], out[row + 2, n], out[row + 3, n], out[row + 4, n], out[row + 5, n],
                )  # fmt: skip


@compiled(parallel=True)
def _transform_products(products, first, columns, bias, lowest, out):
    """Write 4x4 results of products [36, n, c] to out [h, w, c], beginning with window `first`.

    Windows are 4 cells apart, `columns` of them in a row. Each result is the sum of its products and the bias [c], or
    `lowest` if that is less.
    """
    count, channels = products.shape[1], products.shape[2]
    height, width = out.shape[0], out.shape[1]
    nothing, floor = np.zeros(channels, np.float32), np.float32(lowest)
    for part in numba.prange((count + _TOGETHER - 1) // _TOGETHER):
        half = np.empty((4, 6, channels), np.float32)
        spare = np.empty((4, channels), np.float32)
        for n in range(part * _TOGETHER, min(count, (part + 1) * _TOGETHER)):
            top, left = 4 * ((first + n) // columns), 4 * ((first + n) % columns)
            for j in range(6):
                _transform_four(
                    products[j, n], products[6 + j, n], products[12 + j, n],
                    products[18 + j, n], products[24 + j, n], products[30 + j, n],
                    nothing, np.float32(-np.inf), half[0, j], half[1, j], half[2, j], half[3, j],
                )  # fmt: skip
            for i in range(min(4, height - top)):
                row = out[top + i]
                _transform_four(
                    half[i, 0], half[i, 1], half[i, 2], half[i, 3], half[i, 4], half[i, 5],
                    bias, floor,
                    row[left],
                    row[left + 1] if left + 1 < width else spare[1],
                    row[left + 2] if left + 2 < width else spare[2],
                    row[left + 3] if left + 3 < width else spare[3],
                )  # fmt: skip


@compiled()
def _cell(x, i, j, nothing):
    """Return the values of a cell of x [h, w, c]; `nothing` outside of x."""
    return x[i, j] if 0 <= i < x.shape[0] and 0 <= j < x.shape[1] else nothing


@compiled()
def _transform_six(a, b, c, d, e, f, to_a, to_b, to_c, to_d, to_e, to_f):
    """Write one direction of the transform of a window, for all channels.

    All but the second transform of equal values are exactly 0. Results are therefore equal where all values are, as
    those of direct convolutions, and the first of the equal values of a pooling window is its maximum.
    """
    for k in range(a.size):
        even, odd = e[k] - _FOUR * c[k], d[k] - _FOUR * b[k]
        far, apart = e[k] - c[k], _TWO * (d[k] - b[k])
        to_a[k] = _FOUR * (a[k] - c[k]) + (e[k] - c[k])
        to_b[k] = even + odd
        to_c[k] = even - odd
        to_d[k] = far + apart
        to_e[k] = far - apart
        to_f[k] = _FOUR * (b[k] - d[k]) + (f[k] - d[k])


@compiled()
def _transform_four(a, b, c, d, e, f, bias, floor, to_a, to_b, to_c, to_d):
    """Write one direction of the transform of products plus the bias, for all channels; NaN stays NaN."""
    for k in range(a.size):
        near, difference, far, apart = b[k] + c[k], b[k] - c[k], d[k] + e[k], d[k] - e[k]
        one, two = a[k] + near + far + bias[k], difference + _TWO * apart + bias[k]
        three, four = near + _FOUR * far + bias[k], difference + _EIGHT * apart + f[k] + bias[k]
        to_a[k] = floor if one < floor else one
        to_b[k] = floor if two < floor else two
        to_c[k] = floor if three < floor else three
        to_d[k] = floor if four < floor else four
