"""GPU kernels for the content term: sum of squared differences of features, and its gradient.

Each reads every feature once, where PyTorch would store seven float32 tensors as large as the features. They also run
on the CPU in Triton's interpreter (set TRITON_INTERPRET=1 before the first import).
"""

# Arguments are untyped: Triton compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

from __future__ import annotations

import triton
import triton.language as tl

from sgsst_core.features.statistics_kernels import cells_of, load_features, load_weights, mask_of

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
