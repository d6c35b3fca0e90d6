"""GPU kernels for the content term and the style terms, and for their gradients with respect to the features.

Those of the content term read every feature once, where PyTorch would store seven float32 tensors as large as the
features. All kernels also run on the CPU in Triton's interpreter (set TRITON_INTERPRET=1 before the first import).
"""

import triton
import triton.language as tl

from sgsst_core.features.triton_kernels import cells_of, halves, load_features, load_weights, mask_of

# Arguments are untyped: Triton compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"


_UNSPECIALIZED = ["positions", "width", "row_cells", "content_row_cells", "weight_row_step", "weight_column_step"]


@triton.jit
def weighted_difference(
    features, content, weights, position, there, channel,
    width, row_cells, content_row_cells, weight_row_step, weight_column_step,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr, WEIGHTED: tl.constexpr,
):  # fmt: skip
    """Return features x [P, C], d = x - content and a_p d, the latter two float32; the arguments are as below."""
    x = load_features(features, cells_of(position, width, row_cells), channel, there, CHANNELS, BLOCK)
    wanted = load_features(content, cells_of(position, width, content_row_cells), channel, there, CHANNELS, BLOCK)
    a = load_weights(weights, weight_row_step, weight_column_step, width, position, there, tl.float32, WEIGHTED)
    difference = x.to(tl.float32) - wanted.to(tl.float32)
    return x, difference, difference * a[:, None]


@triton.jit(do_not_specialize=_UNSPECIALIZED)
def content_sums(
    features, content, weights, sums,
    positions, width, row_cells, content_row_cells, weight_row_step, weight_column_step,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr, WEIGHTED: tl.constexpr,
):  # fmt: skip
    """Compute the sum of a_p |F_p - content_p|^2 over P positions for each program.

    Args:
        features, content: [h, width, CHANNELS] in the same dtype.
        weights: Position weights [h, width]; ignored if WEIGHTED is false.
        sums: Output [programs] float32.
        positions: Number of positions, h * width.
        row_cells, content_row_cells: Distances of two rows of features and content in cells of CHANNELS values.
        BLOCK: CHANNELS or the next valid size of a block.
    """
    position, channel = tl.program_id(0) * P + tl.arange(0, P), tl.arange(0, BLOCK)
    _, difference, weighted = weighted_difference(
        features, content, weights, position, position < positions, channel,
        width, row_cells, content_row_cells, weight_row_step, weight_column_step, CHANNELS, BLOCK, WEIGHTED,
    )  # fmt: skip
    tl.store(sums + tl.program_id(0), tl.sum(difference * weighted))


@triton.jit(do_not_specialize=[*_UNSPECIALIZED, "out_row_cells"])
def add_content_gradient(
    features, content, weights, gradient, factor,
    positions, width, row_cells, content_row_cells, weight_row_step, weight_column_step, out_row_cells,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr, WEIGHTED: tl.constexpr, RELU: tl.constexpr,
):  # fmt: skip
    """Compute gradient_p += 2 factor a_p (F_p - content_p), and if RELU zero it where the features are not positive.

    Args:
        features, content, weights, positions, row_cells, content_row_cells, BLOCK, P: As in `content_sums`.
        gradient: [h, width, CHANNELS] in the dtype of the features, updated in place; its rows are out_row_cells apart.
        factor: [] float64.
    """
    position, channel = tl.program_id(0) * P + tl.arange(0, P), tl.arange(0, BLOCK)
    there = position < positions
    x, _, weighted = weighted_difference(
        features, content, weights, position, there, channel,
        width, row_cells, content_row_cells, weight_row_step, weight_column_step, CHANNELS, BLOCK, WEIGHTED,
    )  # fmt: skip
    target = gradient + cells_of(position, width, out_row_cells)[:, None] * CHANNELS + channel[None, :]
    mask = mask_of(there, channel, CHANNELS)
    before = tl.load(target, mask=mask, other=0.0)
    sums = before.to(tl.float32) + weighted * (2 * tl.load(factor)).to(tl.float32)
    if RELU:
        sums = tl.where(x.to(tl.float32) <= 0, 0.0, sums)
    tl.store(target, sums.to(before.dtype), mask=mask)


# Arguments are untyped: Triton compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"


@triton.jit
def compare(
    count, mean, centered, target_gram, target_mean, target_std, terms, matrix, own_mean, offset, high, low, constant,
    GRAM: tl.constexpr, MEAN: tl.constexpr, STD: tl.constexpr, EPS: tl.constexpr, CHANNELS: tl.constexpr,
    ROWS: tl.constexpr, COLUMNS: tl.constexpr, UNIT: tl.constexpr,
):  # fmt: skip
    """Compute `terms.style_loss` in float64.

    Each program computes ROWS rows of the Gram matrix. COLUMNS must be at least CHANNELS.

    Args:
        count, mean, centered: Statistics of the view.
        target_gram, target_mean, target_std: Statistics of the style.
        terms: Output [CHANNELS, 3] float64, contribution of each channel to each term.
        matrix, own_mean, offset: Outputs [CHANNELS, CHANNELS], [CHANNELS] and [CHANNELS] float32, the fields of
            `terms.StyleGradient`.
        high, low, constant: Outputs [CHANNELS, CHANNELS] bfloat16 or float16 (two) and [CHANNELS] float32, the fields
            of `terms.SplitGradient`.
        UNIT: Factor of `high` and `low`.
    """
    i = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    j = tl.arange(0, COLUMNS)
    row, column = i < CHANNELS, j < CHANNELS
    both = row[:, None] & column[None, :]
    entry = i[:, None] * CHANNELS + j[None, :]
    n = tl.load(count)
    some = n > 0
    divisor = tl.where(some, n, 1.0)
    fraction = tl.where(some, 1.0 / divisor, 0.0)
    own, means = tl.load(mean + i, mask=row, other=0.0), tl.load(mean + j, mask=column, other=0.0)
    wanted = tl.load(target_gram + entry, mask=both, other=0.0)
    gram_error = tl.load(centered + entry, mask=both, other=0.0) / divisor + own[:, None] * means[None, :] - wanted
    mean_error = own - tl.load(target_mean + i, mask=row, other=0.0)
    std = tl.sqrt(tl.maximum(tl.load(centered + i * CHANNELS + i, mask=row, other=0.0), 0.0) / divisor)
    std_error = std - tl.load(target_std + i, mask=row, other=0.0)
    slope = tl.where(std > EPS * tl.abs(own), std_error / tl.where(std > 0, std, 1.0), 0.0)
    weight: tl.constexpr = GRAM / (CHANNELS * CHANNELS)
    line = (4 * weight / (CHANNELS * CHANNELS)) * gram_error
    drawn = (tl.sum(line * means[None, :], 1) + (2 * MEAN / CHANNELS) * mean_error) * fraction
    line += tl.where(i[:, None] == j[None, :], (2 * STD / CHANNELS) * slope[:, None], 0.0)
    rounded = (line * fraction).to(tl.float32)
    first, second = halves(rounded * UNIT, high.dtype.element_ty)
    stored = (first.to(tl.float32).to(tl.float64) + second.to(tl.float32).to(tl.float64)) / UNIT
    tl.store(constant + i, (drawn - tl.sum(stored * means[None, :], 1)).to(tl.float32), mask=row)
    # `add_style_gradient` centers features about the float32 mean; the offset compensates for its rounding error.
    drawn += tl.sum(line * (means.to(tl.float32).to(tl.float64) - means)[None, :], 1) * fraction
    tl.store(matrix + entry, rounded, mask=both)
    tl.store(high + entry, first, mask=both)
    tl.store(low + entry, second, mask=both)
    tl.store(own_mean + i, own.to(tl.float32), mask=row)
    tl.store(offset + i, drawn.to(tl.float32), mask=row)
    present = tl.where(some, 1.0, 0.0).to(tl.float64)
    squares = tl.sum(gram_error * gram_error, 1) / (CHANNELS * CHANNELS)
    tl.store(terms + 3 * i, present * weight * squares, mask=row)
    tl.store(terms + 3 * i + 1, present * (MEAN / CHANNELS) * mean_error * mean_error, mask=row)
    tl.store(terms + 3 * i + 2, present * (STD / CHANNELS) * std_error * std_error, mask=row)


@triton.jit(
    do_not_specialize=["positions", "width", "row_cells", "weight_row_step", "weight_column_step", "out_row_cells"]
)
def add_style_gradient(
    features, weights, gradient, matrix, low, mean, offset,
    positions, width, row_cells, weight_row_step, weight_column_step, out_row_cells,
    CHANNELS: tl.constexpr, TILE: tl.constexpr, K: tl.constexpr, P: tl.constexpr, WEIGHTED: tl.constexpr,
    RELU: tl.constexpr, UNIT: tl.constexpr,
):  # fmt: skip
    """Compute gradient_p += a_p (matrix (F_p - mean) + offset); if RELU, zero it where the features are not positive.

    Each program handles P positions and TILE output channels; it sums over the input channels in steps of K. In
    16 bits, features are multiplied as they are: products are exact.

    Args:
        features: [h, width, CHANNELS], float32, bfloat16 or float16.
        weights: Position weights [h, width]; ignored if WEIGHTED is false.
        gradient: [h, width, CHANNELS] in the dtype of the features, updated in place.
        matrix, mean, offset: Outputs of `compare` for float32; the matrix is symmetric. For 16-bit features, `matrix`
            and `offset` are the outputs `high` and `constant`, and `mean` is None.
        low: Output of `compare` for 16-bit features; otherwise None.
        positions: Number of positions, h * width.
        row_cells, out_row_cells: Distances of two rows of features and gradient in cells of CHANNELS values.
        RELU: Whether the features are the outputs of a ReLU, through which the gradient is passed on.
    """
    tiles: tl.constexpr = (CHANNELS + TILE - 1) // TILE
    stages: tl.constexpr = 3 if low is not None and CHANNELS > K else 1
    number = tl.program_id(0)  # programs that read the same features are neighbors
    position = number // tiles * P + tl.arange(0, P)
    there = position < positions
    own = number % tiles * TILE + tl.arange(0, TILE)
    cell = cells_of(position, width, row_cells)
    sums = tl.zeros([P, TILE], tl.float32)
    for k in tl.range(0, CHANNELS, K, num_stages=stages):
        channel = k + tl.arange(0, K)
        x = load_features(features, cell, channel, there, CHANNELS, K)
        entry = channel[:, None] * CHANNELS + own[None, :]
        part_of = mask_of(channel < CHANNELS, own, CHANNELS)
        part = tl.load(matrix + entry, mask=part_of, other=0.0)
        if low is not None:
            sums = tl.dot(x, part, sums)
            sums = tl.dot(x, tl.load(low + entry, mask=part_of, other=0.0), sums)
        else:
            x -= tl.load(mean + channel, mask=channel < CHANNELS, other=0.0)[None, :]
            sums = tl.dot(x, part, sums, input_precision="ieee")
    a = load_weights(
        weights, weight_row_step, weight_column_step, width, position, there, features.dtype.element_ty, WEIGHTED
    )
    if UNIT != 1.0:
        sums /= UNIT
    sums = (sums + tl.load(offset + own, mask=own < CHANNELS, other=0.0)[None, :]) * a[:, None]
    target = gradient + cells_of(position, width, out_row_cells)[:, None] * CHANNELS + own[None, :]
    mask = mask_of(there, own, CHANNELS)
    before = tl.load(target, mask=mask, other=0.0)
    sums += before.to(tl.float32)
    if RELU:
        output = load_features(features, cell, own, there, CHANNELS, TILE)
        sums = tl.where(output.to(tl.float32) <= 0, 0.0, sums)
    tl.store(target, sums.to(before.dtype), mask=mask)
