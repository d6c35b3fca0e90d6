"""GPU kernels for the first convolution, from pixels to 16-bit features, and for its backward pass.

cuDNN first pads three channels to eight and copies the pixels. These kernels read pixels and write features once. They
also run on the CPU in Triton's interpreter (set TRITON_INTERPRET=1 before the first import).
"""

# Arguments are untyped: Triton compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

from __future__ import annotations

import triton
import triton.language as tl

#: Pixels of a row per program.
P = tl.constexpr(128)


@triton.jit
def strip_of(width, P: tl.constexpr):
    """Return the row, int64, and the columns [P] of a program's pixels."""
    across = (width + P - 1) // P
    return (tl.program_id(0) // across).to(tl.int64), tl.program_id(0) % across * P + tl.arange(0, P)


@triton.jit(do_not_specialize=["height", "width"])
def convolve_pixels(
    pixels, weight, bias, scale, shift, out, height, width,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """Compute relu(convolution(scale * pixels + shift) + bias), where 0 surrounds the image.

    Args:
        pixels: [height, width, 3] float32.
        weight: [CHANNELS, 3, 3, 3], bfloat16 or float16, in the order channel, row, column, color.
        bias: [CHANNELS] in the same dtype.
        scale, shift: [3] float32.
        out: [height, width, CHANNELS] in the dtype of `weight`.
        BLOCK: CHANNELS or the next valid size of a block.
    """
    row, column = strip_of(width, P)
    channel, factor = tl.arange(0, BLOCK), tl.arange(0, 32)  # factors of the product: nine pixels of three colors
    color, from_row = factor % 3, row + factor // 9 - 1
    from_column = column[:, None] + (factor // 3 % 3 - 1)[None, :]
    is_row = (factor < 27) & (from_row >= 0) & (from_row < height)
    there = is_row[None, :] & (from_column >= 0) & (from_column < width)
    values = tl.load(pixels + (from_row[None, :] * width + from_column) * 3 + color[None, :], mask=there, other=0.0)
    values = values * tl.load(scale + color)[None, :] + tl.load(shift + color)[None, :]
    values = tl.where(there, values, 0.0).to(out.dtype.element_ty)
    is_weight = (factor < 27)[:, None] & (channel < CHANNELS)[None, :]
    weights = tl.load(weight + channel[None, :] * 27 + factor[:, None], mask=is_weight, other=0.0)
    sums = tl.dot(values, weights) + tl.load(bias + channel, mask=channel < CHANNELS, other=0.0).to(tl.float32)[None, :]
    sums = tl.where(sums < 0, 0.0, sums)
    target = out + ((row * width + column) * CHANNELS)[:, None] + channel[None, :]
    tl.store(target, sums.to(out.dtype.element_ty), mask=(column < width)[:, None] & (channel < CHANNELS)[None, :])


@triton.jit(do_not_specialize=["height", "width"])
def pixel_gradients(
    gradient, weight, scale, out, height, width, CHANNELS: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr
):
    """Compute the gradient of the pixels from that of the first convolution's output before its ReLU.

    A pixel's gradient comes from three rows. Each program reads one row, so that all features are read once, and
    writes its summands for the rows above, at and below it. Outside of the image, rows are 0.

    Args:
        gradient: [height, width, CHANNELS], bfloat16 or float16.
        weight: Transposed and flipped weights [3, CHANNELS, 3, 3] of the same dtype, in the order color, row, column,
            channel.
        scale: [3] float32, factor of the pixels.
        out: [3, height, width, 3] float32, whose sum over the first dimension is the gradient.
        BLOCK: CHANNELS or the next valid size of a block.
    """
    row, column = strip_of(width, P)
    row -= 1
    channel, entry = tl.arange(0, BLOCK), tl.arange(0, 16)  # nine entries: three rows of three colors
    is_weight = (channel < CHANNELS)[:, None] & (entry < 9)[None, :]
    sums = tl.zeros([P, 16], tl.float32)
    from_row = row + tl.zeros_like(column)  # Triton 3.9's interpreter accepts no mask made from a scalar
    for tap in tl.range(3, num_stages=1):
        from_column = column + tap - 1
        there = (from_row >= 0) & (from_row < height) & (from_column >= 0) & (from_column < width)
        source = gradient + ((row * width + from_column) * CHANNELS)[:, None] + channel[None, :]
        values = tl.load(source, mask=there[:, None] & (channel < CHANNELS)[None, :], other=0.0)
        of_tap = weight + ((entry % 3 * 9 + entry // 3 * 3 + tap) * CHANNELS)[None, :] + channel[:, None]
        sums = tl.dot(values, tl.load(of_tap, mask=is_weight, other=0.0), sums)
    sums *= tl.load(scale + entry % 3)[None, :]
    to_row = row + 1 - entry // 3
    is_row = (entry < 9) & (to_row >= 0) & (to_row < height)
    target = out + (((entry // 3 * height + to_row) * width)[None, :] + column[:, None]) * 3 + (entry % 3)[None, :]
    tl.store(target, sums, mask=(column < width)[:, None] & is_row[None, :])
