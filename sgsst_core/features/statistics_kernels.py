"""GPU kernels for layer statistics: shifted moments of spans of positions, and statistics from their sum in float64.

The kernels also run on the CPU in Triton's interpreter (set TRITON_INTERPRET=1 before the first import). They use no
atomics, so results are reproducible bit for bit.
"""

# Arguments are untyped: Triton compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def mask_of(there, channel, CHANNELS: tl.constexpr):
    """Return the load mask [P, C] of valid positions and channels.

    A block may have more channels than the layer; the excess channels are invalid.
    """
    return there[:, None] & (channel < CHANNELS)[None, :]


@triton.jit
def cells_of(position, width, row_cells):
    """Return the offsets in cells [P], int64, of row-major positions in a layer whose rows are row_cells apart."""
    return (position // width).to(tl.int64) * row_cells + position % width


@triton.jit
def load_features(features, cell, channel, there, CHANNELS: tl.constexpr, TILE: tl.constexpr):
    """Load features [P, TILE] from cells; those of invalid cells and channels count as 0."""
    at = features + cell[:, None] * CHANNELS + channel[None, :]
    if CHANNELS % TILE == 0:
        return tl.load(at, mask=there[:, None], other=0.0)
    return tl.load(at, mask=mask_of(there, channel, CHANNELS), other=0.0)


@triton.jit
def load_weights(weights, row_step, column_step, width, position, there, dtype: tl.constexpr, WEIGHTED: tl.constexpr):
    """Load position weights [P] as float32, rounded to the features' dtype; those of invalid positions are 0."""
    if WEIGHTED:
        offset = (position // width).to(tl.int64) * row_step + (position % width).to(tl.int64) * column_step
        return tl.load(weights + offset, mask=there, other=0.0).to(dtype).to(tl.float32)
    return there.to(tl.float32)


@triton.jit
def halves(x, dtype: tl.constexpr):
    """Return the two 16-bit numbers whose sum is closest to a float32 number.

    Together they have 16 bits in bfloat16, and 22 in float16.
    """
    high = x.to(dtype)
    return high, (x - high.to(tl.float32)).to(dtype)


@triton.jit
def add_block(
    features, weights, shift, start, end, width, row_cells, weight_row_step, weight_column_step,
    own, other, second, first, count,
    CHANNELS: tl.constexpr, TILE: tl.constexpr, P: tl.constexpr, WEIGHTED: tl.constexpr,
):  # fmt: skip
    """Add the moments of P positions to `second` [TILE, TILE], `first` [TILE] and `count` [P], and return the sums."""
    position = start + tl.arange(0, P)
    there = position < end
    cell = cells_of(position, width, row_cells)
    a = load_weights(
        weights, weight_row_step, weight_column_step, width, position, there, features.dtype.element_ty, WEIGHTED
    )
    left = load_features(features, cell, own, there, CHANNELS, TILE)
    right = left if CHANNELS <= TILE else load_features(features, cell, other, there, CHANNELS, TILE)
    if features.dtype.element_ty != tl.float32:
        scaled = left.to(tl.float32)
        if WEIGHTED:
            scaled *= a[:, None]
            high, low = halves(scaled, features.dtype.element_ty)
            second = tl.dot(tl.trans(high), right, tl.dot(tl.trans(low), right, second))
        else:
            second = tl.dot(tl.trans(left), right, second)
    else:
        scaled = (left - tl.load(shift + own, mask=own < CHANNELS, other=0.0)[None, :]) * a[:, None]
        right -= tl.load(shift + other, mask=other < CHANNELS, other=0.0)[None, :]
        second = tl.dot(tl.trans(scaled), right, second, input_precision="ieee")
    return second, first + tl.sum(scaled, 0), count + a


@triton.jit(do_not_specialize=["positions", "width", "row_cells", "weight_row_step", "weight_column_step", "span"])
def shifted_moments(
    features, weights, shift, sums, positions, width, row_cells, weight_row_step, weight_column_step, span,
    CHANNELS: tl.constexpr, TILE: tl.constexpr, P: tl.constexpr, PARTS: tl.constexpr, WEIGHTED: tl.constexpr,
):  # fmt: skip
    """Compute moments about the shift over `span` positions, for one TILE x TILE block of channel pairs.

    Only blocks on and above the diagonal are computed. Second moments are accumulated over PARTS * P positions at a
    time, so that no float32 chain is long. Below, a_p is a position weight and x_p = F_p - shift.

    In 16 bits there is no shift: a product of two features, or of a feature and a rounded weight, has 16 bits (22 in
    float16), so that sums of products are nearly exact in float32. After cancellation, their error is less than that of
    rounded features.

    Args:
        features: [h, width, CHANNELS], float32, bfloat16 or float16.
        weights: Position weights [h, width]; ignored if WEIGHTED is false.
        shift: [CHANNELS] float32; None if the features have 16 bits.
        sums: Output [spans, CHANNELS^2 + CHANNELS + 1] float32: the sum of a_p x_p x_p^T, of a_p x_p, and of a_p.
            Entries of lower blocks are not written.
        positions: Number of positions, h * width.
        row_cells: Distance of two rows in cells of CHANNELS values.
    """
    tiles: tl.constexpr = (CHANNELS + TILE - 1) // TILE
    stages: tl.constexpr = 3 if shift is None else 1  # half as many bytes: the next blocks are loaded meanwhile
    pair, number = tl.program_id(0), tl.program_id(1)  # programs that read the same features are neighbors
    down, across = pair // tiles, pair % tiles
    if down <= across:
        own, other = down * TILE + tl.arange(0, TILE), across * TILE + tl.arange(0, TILE)
        second = tl.zeros([TILE, TILE], tl.float32)
        first = tl.zeros([TILE], tl.float32)
        count = tl.zeros([P], tl.float32)
        end = tl.minimum((number + 1) * span, positions)
        some = tl.zeros([TILE, TILE], tl.float32)
        for start in tl.range(number * span, end, P, num_stages=stages):
            some, first, count = add_block(
                features, weights, shift, start, end, width, row_cells, weight_row_step,
                weight_column_step, own, other, some, first, count, CHANNELS, TILE, P, WEIGHTED,
            )  # fmt: skip
            if (start + P) % (PARTS * P) == 0:
                second += some
                some = tl.zeros([TILE, TILE], tl.float32)
        second += some
        row = sums + number.to(tl.int64) * (CHANNELS * CHANNELS + CHANNELS + 1)
        entry = own[:, None] * CHANNELS + other[None, :]
        tl.store(row + entry, second, mask=(own < CHANNELS)[:, None] & (other < CHANNELS)[None, :])
        if down == across:
            tl.store(row + CHANNELS * CHANNELS + own, first, mask=own < CHANNELS)
            if pair == 0:
                tl.store(row + CHANNELS * CHANNELS + CHANNELS, tl.sum(count, 0))


@triton.jit
def combine_moments(
    sums, shift, count, mean, centered,
    CHANNELS: tl.constexpr, ENTRIES: tl.constexpr,
):  # fmt: skip
    """Compute count, mean and centered second moment from moments about a shift, in float64.

    Each program computes ENTRIES matrix entries.

    Args:
        sums: [CHANNELS^2 + CHANNELS + 1] float64, the sum of the outputs of `shifted_moments` over all spans; with a
            single span its output, float32.
        shift: [CHANNELS], shift of these moments; None for 0.
        count: Output [] float64. All outputs are 0 if no position has weight.
        mean: Output [CHANNELS] float64.
        centered: Output [CHANNELS, CHANNELS] float64.
    """
    entry = tl.program_id(0) * ENTRIES + tl.arange(0, ENTRIES)
    inside = entry < CHANNELS * CHANNELS
    i, j = tl.where(inside, entry // CHANNELS, 0), entry % CHANNELS
    # Blocks below the diagonal are not computed: the matrix is symmetric, so read the transposed entry.
    upper = tl.where(i <= j, i * CHANNELS + j, j * CHANNELS + i)
    firsts = sums + CHANNELS * CHANNELS
    total = tl.load(firsts + CHANNELS).to(tl.float64)
    some = total > 0
    divisor = tl.where(some, total, 1.0)
    second = tl.load(sums + upper, mask=inside, other=0.0).to(tl.float64)
    down, across = tl.load(firsts + i).to(tl.float64), tl.load(firsts + j).to(tl.float64)
    tl.store(centered + entry, second - (down / divisor) * (across / divisor) * total, mask=inside)
    own = across / divisor
    if shift is not None:
        own = tl.where(some, tl.load(shift + j).to(tl.float64) + own, 0.0)
    tl.store(mean + j, own, mask=inside & (i == 0))
    tl.store(count, total, mask=tl.program_id(0) == 0)
