"""GPU kernels of the feature network: layer statistics, max pooling, first convolution.

They also run on the CPU in Triton's interpreter (set TRITON_INTERPRET=1 before the first import). They use no atomics,
so results are reproducible bit for bit.

Pooling reads and writes every value once. All masks depend on the window alone, which is the same for the neighboring
channels of a thread, so that Triton combines their loads and stores. For the first convolution, cuDNN would pad three
channels to eight and copy the pixels; these kernels read pixels and write features once.
"""

# Arguments are untyped: Triton compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

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


#: Windows times channels per program: with four warps, a thread moves 16 bytes of bfloat16 at a time.
BLOCK = tl.constexpr(1024)


@triton.jit(do_not_specialize=["width", "across", "windows"])
def max_pool(source, out, width, across, windows, CHANNELS: tl.constexpr, MASK: tl.constexpr, BLOCK: tl.constexpr):
    """Write the maxima of 2x2 windows, as `layers.max_pool` does.

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
    """Write the gradient with respect to the ReLU's input, as `layers.max_pool_backward` does.

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
