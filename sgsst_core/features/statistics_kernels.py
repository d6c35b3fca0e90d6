"""GPU kernels for layer statistics: shifted moments of blocks of positions, and their sum in float64.

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
def load_centered(features, shift, row_step, column_step, width, position, channel, there, CHANNELS: tl.constexpr):
    """Load features minus shift [P, C] as float32, at row-major positions; invalid features count as 0."""
    offset = (position // width).to(tl.int64) * row_step + (position % width).to(tl.int64) * column_step
    mask = mask_of(there, channel, CHANNELS)
    values = tl.load(features + offset[:, None] + channel[None, :], mask=mask, other=0.0).to(tl.float32)
    return values - tl.load(shift + channel, mask=channel < CHANNELS, other=0.0)[None, :]


@triton.jit
def load_weights(weights, row_step, column_step, width, position, there, WEIGHTED: tl.constexpr):
    """Load position weights [P] as float32, 0 at invalid positions."""
    if WEIGHTED:
        offset = (position // width).to(tl.int64) * row_step + (position % width).to(tl.int64) * column_step
        return tl.load(weights + offset, mask=there, other=0.0).to(tl.float32)
    return there.to(tl.float32)


@triton.jit
def shifted_moments(
    features, weights, shift, counts, firsts, seconds,
    positions, width, row_step, column_step, weight_row_step, weight_column_step,
    CHANNELS: tl.constexpr, TILE: tl.constexpr, SPAN: tl.constexpr, P: tl.constexpr, WEIGHTED: tl.constexpr,
    PRECISION: tl.constexpr,
):  # fmt: skip
    """Compute moments about the shift over SPAN positions, for one TILE x TILE block of channel pairs.

    Only blocks on and above the diagonal are computed. Below, a_p is a position weight and x_p = F_p - shift.

    Args:
        features: [h, width, CHANNELS], float32 or bfloat16.
        weights: Position weights [h, width]; ignored if WEIGHTED is false.
        shift: [CHANNELS] float32.
        counts: Output [spans] float32, sum of a_p; written by block (0, 0).
        firsts: Output [spans, CHANNELS] float32, sum of a_p x_p; written by diagonal blocks.
        seconds: Output [spans, CHANNELS, CHANNELS] float32, sum of a_p x_p x_p^T; lower blocks are not written.
        positions: Number of positions, h * width.
    """
    tiles: tl.constexpr = (CHANNELS + TILE - 1) // TILE
    span, pair = tl.program_id(0), tl.program_id(1)
    down, across = pair // tiles, pair % tiles
    if down <= across:
        own, other = down * TILE + tl.arange(0, TILE), across * TILE + tl.arange(0, TILE)
        second = tl.zeros([TILE, TILE], tl.float32)
        first = tl.zeros([TILE], tl.float32)
        count = tl.zeros([P], tl.float32)
        begin = span * SPAN
        end = tl.minimum(begin + SPAN, positions)
        while begin < end:
            position = begin + tl.arange(0, P)
            there = position < end
            a = load_weights(weights, weight_row_step, weight_column_step, width, position, there, WEIGHTED)
            left = load_centered(features, shift, row_step, column_step, width, position, own, there, CHANNELS)
            left = left * a[:, None]
            right = load_centered(features, shift, row_step, column_step, width, position, other, there, CHANNELS)
            second += tl.dot(tl.trans(left), right, input_precision=PRECISION)
            first += tl.sum(left, 0)
            count += a
            begin += P
        row = seconds + (span.to(tl.int64) * CHANNELS + own)[:, None] * CHANNELS
        tl.store(row + other[None, :], second, mask=(own < CHANNELS)[:, None] & (other < CHANNELS)[None, :])
        if down == across:
            tl.store(firsts + span.to(tl.int64) * CHANNELS + own, first, mask=own < CHANNELS)
            if pair == 0:
                tl.store(counts + span, tl.sum(count, 0))


@triton.jit
def add_moments(
    counts, firsts, seconds, shift, count, mean, centered, spans,
    CHANNELS: tl.constexpr, ENTRIES: tl.constexpr, S: tl.constexpr,
):  # fmt: skip
    """Combine the moments of all spans into count, mean and centered second moment, in float64.

    Each program computes ENTRIES matrix entries.

    Args:
        counts, firsts, seconds, shift: Outputs of `shifted_moments`, and its shift.
        count: Output [] float64. All outputs are 0 if no position has weight.
        mean: Output [CHANNELS] float64.
        centered: Output [CHANNELS, CHANNELS] float64.
        spans: Number of spans.
    """
    entry = tl.program_id(0) * ENTRIES + tl.arange(0, ENTRIES)
    inside = entry < CHANNELS * CHANNELS
    i, j = tl.where(inside, entry // CHANNELS, 0), entry % CHANNELS
    # Blocks below the diagonal are not computed: the matrix is symmetric, so read the transposed entry.
    offset = tl.where(i <= j, i * CHANNELS + j, j * CHANNELS + i)
    n = tl.zeros([S], tl.float64)
    down, across, second = (
        tl.zeros([ENTRIES], tl.float64),
        tl.zeros([ENTRIES], tl.float64),
        tl.zeros([ENTRIES], tl.float64),
    )
    begin = tl.zeros([], tl.int32)
    while begin < spans:
        span = begin + tl.arange(0, S)
        there = span < spans
        row = (span.to(tl.int64) * CHANNELS)[:, None]
        n += tl.load(counts + span, mask=there, other=0.0).to(tl.float64)
        down += tl.sum(tl.load(firsts + row + i[None, :], mask=there[:, None], other=0.0).to(tl.float64), 0)
        across += tl.sum(tl.load(firsts + row + j[None, :], mask=there[:, None], other=0.0).to(tl.float64), 0)
        each = tl.load(seconds + row * CHANNELS + offset[None, :], mask=there[:, None], other=0.0)
        second += tl.sum(each.to(tl.float64), 0)
        begin += S
    total = tl.sum(n, 0)
    some = total > 0
    divisor = tl.where(some, total, 1.0)
    tl.store(centered + entry, second - (down / divisor) * (across / divisor) * total, mask=inside)
    own = tl.where(some, tl.load(shift + j).to(tl.float64) + across / divisor, 0.0)
    tl.store(mean + j, own, mask=inside & (i == 0))
    tl.store(count, total, mask=tl.program_id(0) == 0)
