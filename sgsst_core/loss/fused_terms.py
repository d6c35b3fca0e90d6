"""`style_loss` and `StyleGradient.add_to` on a GPU, one launch each. Their float64 twins are those of `terms`."""

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

#: Positions that a program of the gradient takes, and channels of theirs at a time: with more, registers spill.
POSITIONS, STEP = 64, 32


def fused_style_loss(
    statistics: LayerStatistics,
    target: tuple[Tensor, Tensor, Tensor],
    weights: tuple[float, float, float],
    feature_eps: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What `terms.style_loss` gives: terms [5] float64; matrix [c, c], mean [c] and offset [c] float32.

    Args:
        target: Gram matrix, mean and standard deviation of the style, float64.
        weights: c^2 w_G, w_m and w_s.
        feature_eps: as for `terms.style_loss`.
    """
    from sgsst_core.loss import fused_kernels as kernels

    device, channels = statistics.mean.device, len(statistics.mean)
    terms = torch.empty((channels, 5), dtype=torch.float64, device=device)
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
    """Add a_p (matrix (F_p - mean) + offset) to a gradient [h, w, c] in place.

    Args:
        features: [h, w, c], of the gradient's type.
        matrix, mean, offset: of `fused_style_loss`.
        position_weights: [h, w].
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
