"""Weighted second-order statistics of features, merged over partition tiles.

The features F [n, c] of a layer are summarized by (count, mean, C) with C = sum_p a_p (F_p - mean)(F_p - mean)^T. Gram
matrix and standard deviation follow from it: G = C / n + mean mean^T, sigma = sqrt(diag(C) / n). The reverse, sigma^2 =
diag(G) - mean^2, cancels: at a mean-to-sigma ratio of a few thousand, float32 has no correct digit left and the
difference may be negative. Features are therefore centered before they are multiplied (in their own precision, block by
block), and everything is merged in float64 by the pairwise update of Chan, Golub and LeVeque, "Updating Formulae and a
Pairwise Algorithm for Computing Sample Variances" (1979).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.devices import on_device
from sgsst_core.scene.spherical_harmonics import triton_runs_on

#: Values per block. Centered values stay in the CPU cache until they have been multiplied.
BLOCK_VALUES = 1 << 18
#: Positions per span. A span is summed in the features' precision; spans are added in float64. A float32 sum over so
#: few positions is accurate to six digits, so accuracy does not depend on the size of the tile.
SPAN_POSITIONS = 1 << 12
#: Values per block on a GPU, where few kernel launches matter more than cached blocks.
_GPU_BLOCK_VALUES = 1 << 21
#: Minimum number of positions averaged for the shift on a CPU, if there are that many.
_SHIFT_POSITIONS = 1024
#: Maximum distance of a channel's mean from the shift in standard deviations; cancellation grows with its square.
_FAR = 8.0
#: Limits of the positions per span on a GPU. A span is summed by one program in float32; spans are added in float64.
_GPU_SPANS = 256, 4096
#: Programs that occupy a GPU. Spans are as long as this number permits, because the sums of spans take time to add.
_GPU_PROGRAMS = 1024
#: Positions after which a program starts a new accumulator of second moments, by bytes per feature. Longer float32
#: chains round too much: one over 3,500 positions of float32 features is off by 1e-5.
FLUSH = {2: 256, 4: 128}
#: Positions per step of a program, by bytes per feature.
POSITIONS = {2: 64, 4: 32}
#: Minimum number of feature rows averaged for the shift.
_SHIFT_ROWS = 64
#: Channels per block of a program.
TILE = 64
#: Matrix entries per program, rounded to whole rows.
ENTRIES = 512
#: Minimum channels per block, as required for matrix products. Layers with fewer channels fill part of a block.
MIN_CHANNELS = 16


@dataclass(frozen=True)
class LayerStatistics:
    """Count, mean and centered second moment of one layer, float64.

    Attributes:
        count: Scalar tensor, number of positions or sum of their weights.
        centered: [c, c], sum of a_p (F_p - mean)(F_p - mean)^T.
    """

    count: Tensor  # []
    mean: Tensor  # [c]
    centered: Tensor  # [c, c]

    @staticmethod
    def zero(channels: int, device: torch.device | str = "cpu") -> "LayerStatistics":
        """Return the statistics of no positions, the neutral element of `merge`."""
        return LayerStatistics(
            torch.zeros((), dtype=torch.float64, device=device),
            torch.zeros(channels, dtype=torch.float64, device=device),
            torch.zeros((channels, channels), dtype=torch.float64, device=device),
        )

    @property
    def divisor(self) -> Tensor:
        """Count, or 1 if it is 0, so that dividing empty sums gives 0 instead of NaN."""
        return torch.where(self.count > 0, self.count, 1.0)

    def gram(self) -> Tensor:
        """Return G = F^T F / n, [c, c]; zeros if there is no position."""
        return self.centered / self.divisor + torch.outer(self.mean, self.mean)

    def std(self) -> Tensor:
        """Return the population standard deviation, [c]; zeros if there is no position."""
        # Rounding errors of the merge may leave -1e-30 where the exact value is 0.
        return (self.centered.diagonal().clamp_min(0) / self.divisor).sqrt()


def merge(first: LayerStatistics, second: LayerStatistics) -> LayerStatistics:
    """Return the combined statistics of two disjoint sets of positions (Chan et al. 1979).

    The statistics of an empty set are zeros and add nothing. Empty sets therefore need no branch, which would
    synchronize with the device.
    """
    count = first.count + second.count
    fraction = second.count / torch.where(count > 0, count, 1.0)
    delta = second.mean - first.mean
    mean = first.mean + delta * fraction
    centered = first.centered + second.centered + torch.outer(delta, delta) * (first.count * fraction)
    return LayerStatistics(count, mean, centered)


def layer_statistics(features: Tensor, position_weights: Tensor | None = None) -> LayerStatistics:
    """Compute the statistics of features [h, w, c], with optional position weights [h, w] >= 0.

    A GPU uses `fused_statistics` if it has kernels for the features. Otherwise, products of centered blocks are
    computed in the features' precision (float32 for half-precision features), and spans of blocks are added in float64.
    Blocks are centered about a shift. On a CPU, the shift is the mean of some positions; if it turns out to be far from
    the true mean, all sums are recomputed about the true mean. On a GPU, the shift is the mean of all positions,
    because this check would synchronize with the device.
    """
    if can_be_fused(features):
        return fused_statistics(features, position_weights)
    height, width, channels = features.shape
    if height * width == 0:
        return LayerStatistics.zero(channels, features.device)
    precision = torch.promote_types(features.dtype, torch.float32)
    on_cpu = features.device.type == "cpu"
    shift = _shift(features, position_weights) if on_cpu else features.to(precision).mean(dim=(0, 1))
    statistics = _statistics_about(shift, features, position_weights)
    if on_cpu and _is_far(shift, statistics):
        statistics = _statistics_about(statistics.mean.to(precision), features, position_weights)
    return statistics


def blocks_of(features: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Yield the slice of rows of each block of features [h, w, c], and a buffer [rows, w, c] for the block.

    The buffer is float32 or float64. All blocks use the same memory for it.
    """
    height, width, channels = features.shape
    on_cpu = features.device.type == "cpu"
    values = min(BLOCK_VALUES, SPAN_POSITIONS * channels) if on_cpu else _GPU_BLOCK_VALUES
    rows = min(max(1, values // max(width * channels, 1)), height)
    precision = torch.promote_types(features.dtype, torch.float32)
    buffer = torch.empty((rows, width, channels), dtype=precision, device=features.device)
    for top in range(0, height, max(rows, 1)):
        part = slice(top, min(top + rows, height))
        yield part, buffer[: part.stop - top]


def _shift(features: Tensor, position_weights: Tensor | None) -> Tensor:
    """Return an offset [c] to subtract before accumulating: the mean of a few positions, in float32 or float64.

    If any of these positions has a positive weight, only positions of positive weight are used. For a constant channel,
    the shift is exactly that constant.
    """
    height, width = features.shape[:2]
    positions = height * width
    count = min(positions, _SHIFT_POSITIONS)
    # Evenly spaced in row-major order, so that their columns differ at any width.
    chosen = torch.arange(count) * positions // count
    row, column = chosen // width, chosen % width
    some = features[row, column]
    if position_weights is not None:
        weighted = position_weights[row, column] > 0
        if weighted.any():
            some = some[weighted]
    return some.mean(dim=0, dtype=torch.float64).to(torch.promote_types(features.dtype, torch.float32))


def _is_far(shift: Tensor, statistics: LayerStatistics) -> bool:
    """Return whether the shift is so far from the mean that cancellation lost digits. Synchronizes with the device."""
    offset = (statistics.mean - shift).abs()
    rounding = torch.finfo(shift.dtype).eps * shift.abs()
    return bool(((offset > _FAR * statistics.std()) & (offset > _FAR * rounding)).any())


def _statistics_about(shift: Tensor, features: Tensor, position_weights: Tensor | None) -> LayerStatistics:
    """Compute statistics from sums about a shift [c] close to the mean, so that subtracting it cancels no digits.

    Sums are in the shift's precision within a span, and in float64 across spans.
    """
    channels = features.shape[-1]
    total = LayerStatistics.zero(channels, shift.device)
    first, second = torch.zeros_like(shift), shift.new_zeros((channels, channels))
    # Channels per strip. Each strip is multiplied by itself and all later channels. Below the diagonal, products are
    # computed only within diagonal blocks.
    side = max(32, channels // 8) if shift.device.type == "cpu" else channels
    positions = 0
    for rows, block in blocks_of(features):
        centered = center(features[rows], shift, block).reshape(-1, channels)
        # `sum` adds pairwise. A matrix-vector product may add positions one by one, which loses two more digits.
        if position_weights is None:
            total.count.add_(len(centered))
            first.add_(centered.sum(dim=0))
        else:
            weights = position_weights[rows].reshape(-1).to(shift.dtype)
            total.count.add_(weights.sum(dtype=torch.float64))
            # With the square root of the weights in both factors, the product is symmetric, so half of it suffices.
            roots = weights.sqrt()
            centered *= roots[:, None]
            first.add_((centered * roots[:, None]).sum(dim=0))
        for left in range(0, channels, side):
            strip = slice(left, left + side)
            second[strip, left:].addmm_(centered[:, strip].T, centered[:, left:])
        positions += len(centered)
        if positions >= SPAN_POSITIONS or rows.stop == len(features):
            total.mean.add_(first)
            total.centered.add_(second)
            first.zero_()
            second.zero_()
            positions = 0
    some = total.count > 0
    offset = total.mean / torch.where(some, total.count, 1.0)
    mean = torch.where(some, shift.double() + offset, 0.0)
    upper = total.centered.triu()
    return LayerStatistics(total.count, mean, upper + upper.triu(1).T - torch.outer(offset, offset) * total.count)


def center(features: Tensor, mean: Tensor, out: Tensor) -> Tensor:
    """Subtract a mean [c] from features [n, w, c], in the precision of `out` [n, w, c], which is returned."""
    return torch.sub(features, mean, out=out) if features.dtype == out.dtype else out.copy_(features).sub_(mean)


# --- on a GPU ---


def span_positions(positions: int, channels: int) -> int:
    """Return the number of positions per span of a layer."""
    tiles = -(-channels // TILE)
    span = positions * tiles * (tiles + 1) // 2 // _GPU_PROGRAMS
    least, most = _GPU_SPANS
    return min(max(least, 1 << max(span.bit_length() - 1, 0)), most)


def block_of_entries(channels: int) -> int:
    """Return the number of matrix entries per program, in whole rows."""
    channels = max(channels, MIN_CHANNELS)
    return min(channels**2, max(ENTRIES, channels))


def block_of_channels(channels: int, most: int | None = None) -> int:
    """Return the number of channels per step: all of them, or at most `most`."""
    return min(max(channels, MIN_CHANNELS), most or max(channels, MIN_CHANNELS))


def fused_statistics(features: Tensor, position_weights: Tensor | None = None) -> LayerStatistics:
    """Compute `layer_statistics` on a GPU in four launches, without a temporary tensor as large as the features.

    Moments are summed in float32 about a shift, the mean of some rows, which only has to be close to the true mean. In
    16 bits, they are summed about 0, and position weights are rounded likewise (see `shifted_moments`).

    Features are float32, bfloat16 or float16 with contiguous channels, and c is below 16 or a power of two.
    """
    from sgsst_core.features import triton_kernels as kernels

    height, width, channels = features.shape
    device, positions = features.device, height * width
    span, tile = span_positions(positions, channels), block_of_channels(channels, TILE)
    block = POSITIONS[features.element_size()]
    shift = None
    if features.dtype == torch.float32:
        shift = features[:: max(1, height // _SHIFT_ROWS)].mean(dim=(0, 1))
    sums = torch.empty((-(-positions // span), channels**2 + channels + 1), device=device)
    weights = features if position_weights is None else position_weights
    with on_device(device):
        kernels.shifted_moments[((-(-channels // tile)) ** 2, len(sums))](
            features, weights, shift, sums,
            positions, width, row_cells(features), *weights.stride()[:2], span,
            CHANNELS=channels, TILE=tile, P=block, PARTS=max(1, FLUSH[features.element_size()] // block),
            WEIGHTED=position_weights is not None,
        )  # fmt: skip
    count = torch.empty((), dtype=torch.float64, device=device)
    mean = torch.empty(channels, dtype=torch.float64, device=device)
    centered = torch.empty((channels, channels), dtype=torch.float64, device=device)
    entries = block_of_entries(channels)
    total = sums.sum(dim=0, dtype=torch.float64) if len(sums) != 1 else sums
    with on_device(device):
        kernels.combine_moments[(-(-(channels**2) // entries),)](
            total, shift, count, mean, centered, CHANNELS=channels, ENTRIES=entries
        )
    return LayerStatistics(count, mean, centered)


def can_be_fused(features: Tensor) -> bool:
    """Return whether there are kernels for features [h, w, c].

    The kernels need a supported GPU, contiguous channels and columns, and a dtype other than float64.
    """
    height, width, channels = features.shape
    rows, columns, _ = features.stride()
    in_cells = (width <= 1 or columns == channels) and (height <= 1 or rows % channels == 0)
    contiguous = in_cells and features.stride(2) == 1
    return contiguous and features.dtype != torch.float64 and has_kernels(features.device, int(channels))


def row_cells(features: Tensor) -> int:
    """Return the distance of two rows of features [h, w, c] in cells of c values."""
    return features.stride(0) // int(features.shape[2])


def has_kernels(device: torch.device, channels: int) -> bool:
    """Return whether there are kernels on a device for layers with this number of channels."""
    taken = channels < MIN_CHANNELS or channels.bit_count() == 1
    return device.type == "cuda" and taken and triton_runs_on(device)
