"""GPU versions of `style_loss` and `StyleGradient.add_to`, one kernel launch each.

The float64 references are the CPU versions in `statistics_terms`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.features.fused_statistics import (
    TILE,
    block_of_channels,
    block_of_entries,
    block_of_positions,
    matrix_precision,
)
from sgsst_core.features.statistics import LayerStatistics

#: Positions per program of the gradient kernel, and channels per step. Larger values would cause register spilling.
POSITIONS, STEP = 64, 32


def fused_style_loss(
    statistics: LayerStatistics,
    target: tuple[Tensor, Tensor, Tensor],
    weights: tuple[float, float, float],
    feature_eps: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Compute `statistics_terms.style_loss` on a GPU.

    Args:
        statistics: Statistics of the view's features.
        target: Gram matrix, mean and standard deviation of the style, float64.
        weights: c^2 w_G, w_m and w_s.
        feature_eps: Relative rounding error of the features, as in `statistics_terms.style_loss`.

    Returns:
        Terms [3] float64, and the gradient's matrix [c, c], mean [c] and offset [c] in float32.
    """
    from sgsst_core.loss import fused_kernels as kernels

    device, channels = statistics.mean.device, len(statistics.mean)
    terms = torch.empty((channels, 3), dtype=torch.float64, device=device)
    matrix = torch.empty((channels, channels), device=device)
    mean, offset = torch.empty(channels, device=device), torch.empty(channels, device=device)
    gram_weight, mean_weight, std_weight = weights
    columns = block_of_channels(channels)
    rows = block_of_entries(channels) // columns
    kernels.compare[(-(-channels // rows),)](
        statistics.count, statistics.mean, statistics.centered, *target, terms, matrix, mean, offset,
        GRAM=gram_weight, MEAN=mean_weight, STD=std_weight, EPS=feature_eps, CHANNELS=channels, ROWS=rows,
        COLUMNS=columns,
    )  # fmt: skip
    return terms.sum(dim=0), matrix, mean, offset


def fused_add_style_gradient(
    gradient: Tensor,
    features: Tensor,
    matrix: Tensor,
    mean: Tensor,
    offset: Tensor,
    position_weights: Tensor | None = None,
) -> None:
    """Add a_p (matrix (F_p - mean) + offset) to a gradient in place.

    Args:
        gradient: [h, w, c].
        features: [h, w, c], same dtype as the gradient.
        matrix: [c, c] from `fused_style_loss`.
        mean: [c] from `fused_style_loss`.
        offset: [c] from `fused_style_loss`.
        position_weights: [h, w]; None for equal weights.
    """
    from sgsst_core.loss import fused_kernels as kernels

    height, width, channels = features.shape
    positions, tile, block = height * width, block_of_channels(channels, TILE), block_of_positions(POSITIONS)
    weights = features if position_weights is None else position_weights
    kernels.add_style_gradient[(-(-positions // block), -(-channels // tile))](
        features, weights, gradient, matrix, mean, offset,
        positions, width, *features.stride()[:2], *weights.stride()[:2], *gradient.stride()[:2],
        CHANNELS=channels, TILE=tile, K=block_of_channels(channels, STEP), P=block,
        WEIGHTED=position_weights is not None, PRECISION=matrix_precision(features.dtype),
    )  # fmt: skip
