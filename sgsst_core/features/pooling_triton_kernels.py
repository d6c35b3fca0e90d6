"""GPU kernels for max pooling, and for the backward pass through it and the ReLU before it.

Each reads and writes every value once. All masks depend on the window alone, which is the same for the neighboring
channels of a thread, so that Triton combines their loads and stores. They also run on the CPU in Triton's interpreter
(set TRITON_INTERPRET=1 before the first import).
"""

# Arguments are untyped: Triton compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

from __future__ import annotations

import triton
import triton.language as tl

#: Windows times channels per program: with four warps, a thread moves 16 bytes of bfloat16 at a time.
BLOCK = tl.constexpr(1024)


@triton.jit(do_not_specialize=["width", "across", "windows"])
def max_pool(source, out, width, across, windows, CHANNELS: tl.constexpr, MASK: tl.constexpr, BLOCK: tl.constexpr):
    """Write the maxima of 2x2 windows, as `pooling_kernels.max_pool` does.

    Args:
        out: [height // 2, across, CHANNELS].
        across: Columns of the output, width // 2.
        source, CHANNELS, MASK, BLOCK: As in `max_pool_backward`.
    """
    entry = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    channel, window = entry % CHANNELS, entry // CHANNELS
    there = window < windows
    at = (2 * (window // across) * width + 2 * (window % across)) * CHANNELS + channel
    below = at + width.to(tl.int64) * CHANNELS
    a = tl.load(source + at, mask=there, other=0) & MASK
    b = tl.load(source + at + CHANNELS, mask=there, other=0) & MASK
    c = tl.load(source + below, mask=there, other=0) & MASK
    d = tl.load(source + below + CHANNELS, mask=there, other=0) & MASK
    tl.store(out + entry, tl.maximum(tl.maximum(a, b), tl.maximum(c, d)), mask=there)


@triton.jit(do_not_specialize=["height", "width", "windows"])
def max_pool_backward(
    gradient, source, out, height, width, windows, CHANNELS: tl.constexpr, MASK: tl.constexpr, BLOCK: tl.constexpr
):
    """Write the gradient with respect to the ReLU's input, as `pooling_kernels.max_pool_backward` does.

    Args:
        gradient: [height // 2, width // 2, CHANNELS], gradient of the maxima.
        source: [height, width, CHANNELS], ReLU output.
        out: [height, width, CHANNELS].
        windows: Number of windows, including those that the border cuts, whose gradient is 0.
        MASK: All bits of the type except the sign bit. ReLU outputs are compared by their bits: NaN is the largest.
        BLOCK: Windows times channels per program.
    """
    entry = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    channel, window, across = entry % CHANNELS, entry // CHANNELS, (width + 1) // 2
    row, column = window // across, window % across
    there = window < windows
    right, below = there & (2 * column + 1 < width), there & (2 * row + 1 < height)
    whole = right & below
    at = (2 * row * width + 2 * column) * CHANNELS + channel
    next_row = at + width.to(tl.int64) * CHANNELS
    a = tl.load(source + at, mask=there, other=0).to(tl.int32) & MASK
    b = tl.load(source + at + CHANNELS, mask=right, other=0).to(tl.int32) & MASK
    c = tl.load(source + next_row, mask=below, other=0).to(tl.int32) & MASK
    d = tl.load(source + next_row + CHANNELS, mask=whole, other=0).to(tl.int32) & MASK
    most = tl.maximum(tl.maximum(a, b), tl.maximum(c, d))
    slope = tl.load(gradient + (row * (width // 2) + column) * CHANNELS + channel, mask=whole, other=0)
    nothing = tl.zeros_like(slope)
    slope = tl.where(most > 0, slope, nothing)
    is_a, is_b, is_c = a == most, b == most, c == most
    tl.store(out + at, tl.where(is_a, slope, nothing), mask=there)
    tl.store(out + at + CHANNELS, tl.where(is_b & ~is_a, slope, nothing), mask=right)
    tl.store(out + next_row, tl.where(is_c & ~(is_a | is_b), slope, nothing), mask=below)
    tl.store(out + next_row + CHANNELS, tl.where(is_a | is_b | is_c, nothing, slope), mask=whole)
