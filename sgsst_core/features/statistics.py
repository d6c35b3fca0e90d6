"""Weighted second-order statistics of features, merged over partition tiles.

A layer's features F [n, c] are summarised by (count, mean, C) with C = sum_p a_p (F_p - mean)(F_p - mean)^T.
Gram matrix and standard deviation both follow from it: G = C / n + mean mean^T, sigma = sqrt(diag(C) / n).
The reverse, sigma^2 = diag(G) - mean^2, cancels: at a mean-to-sigma ratio of a few thousand no digit is left in
float32 and the root is taken of a negative number. Features are centred before they are multiplied (in their own
precision, chunk by chunk) and everything is merged in float64 by the pairwise update of Chan, Golub and LeVeque,
"Updating Formulae and a Pairwise Algorithm for Computing Sample Variances" (1979).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

#: Entries multiplied in one GEMM: small enough that a centred chunk of 64..512 channels stays in cache and that
#: a float32 sum over it keeps six digits whatever the size of the tile.
CHUNK_VALUES = 1 << 21


@dataclass(frozen=True)
class LayerStatistics:
    """Count, mean and centred second moment of one layer, float64.

    Attributes:
        count: scalar tensor, number of positions or sum of their weights.
        mean: [c].
        centred: [c, c], sum of a_p (F_p - mean)(F_p - mean)^T.
    """

    count: Tensor  # []
    mean: Tensor  # [c]
    centred: Tensor  # [c, c]

    @staticmethod
    def zero(channels: int, device: torch.device | str = "cpu") -> LayerStatistics:
        """The statistics of no positions at all: the neutral element of `merge`."""
        return LayerStatistics(
            torch.zeros((), dtype=torch.float64, device=device),
            torch.zeros(channels, dtype=torch.float64, device=device),
            torch.zeros((channels, channels), dtype=torch.float64, device=device),
        )

    @property
    def empty(self) -> bool:
        """True when no position has any weight, so that mean and Gram matrix do not exist. Waits for the device."""
        return not float(self.count) > 0

    @property
    def divisor(self) -> Tensor:
        """The count, or 1 where there is none: nothing divided by it is nothing, not NaN."""
        return torch.where(self.count > 0, self.count, 1.0)

    def gram(self) -> Tensor:
        """G = F^T F / n, [c, c]; zeros where there is no position."""
        return self.centred / self.divisor + torch.outer(self.mean, self.mean)

    def std(self) -> Tensor:
        """Population standard deviation, [c]; zeros where there is no position."""
        # Rounding of the merge may leave -1e-30 where the exact value is 0.
        return (self.centred.diagonal().clamp_min(0) / self.divisor).sqrt()


def merge(first: LayerStatistics, second: LayerStatistics) -> LayerStatistics:
    """Statistics of two disjoint sets of positions together (Chan et al. 1979).

    A set without positions, all of whose numbers are 0, adds nothing: no question of it, for which a device would have
    to be waited for, is needed.
    """
    count = first.count + second.count
    share = second.count / torch.where(count > 0, count, 1.0)
    delta = second.mean - first.mean
    mean = first.mean + delta * share
    centred = first.centred + second.centred + torch.outer(delta, delta) * (first.count * share)
    return LayerStatistics(count, mean, centred)


def merge_all(parts: Iterable[LayerStatistics]) -> LayerStatistics:
    """Statistics of all parts together, merged in the order given."""
    return reduce(merge, parts)


def layer_statistics(features: Tensor, position_weights: Tensor | None = None) -> LayerStatistics:
    """Statistics of features [h, w, c], with optional position weights [h, w] >= 0.

    The GEMM runs in the features' precision (float32 for half-precision features) on centred chunks; sums over
    chunks are kept in float64.
    """
    height, width, channels = features.shape
    if height * width == 0:
        return LayerStatistics.zero(channels, features.device)
    precision = torch.promote_types(features.dtype, torch.float32)
    shift = features.to(precision).mean(dim=(0, 1)) if features.dtype != precision else features.mean(dim=(0, 1))
    total = _ShiftedSums(channels, features.device)
    rows = max(1, CHUNK_VALUES // (width * channels))
    for top in range(0, height, rows):
        centred = (features[top : top + rows].to(precision) - shift).reshape(-1, channels)
        chunk = None if position_weights is None else position_weights[top : top + rows].reshape(-1).to(precision)
        total.add(centred, chunk)
    return total.statistics(shift.double())


class _ShiftedSums:
    """Float64 sums about a shift that lies near the mean, so that taking the mean out afterwards cancels nothing."""

    def __init__(self, channels: int, device: torch.device) -> None:
        self.count = torch.zeros((), dtype=torch.float64, device=device)
        self.first = torch.zeros(channels, dtype=torch.float64, device=device)
        self.second = torch.zeros((channels, channels), dtype=torch.float64, device=device)

    def add(self, centred: Tensor, position_weights: Tensor | None) -> None:
        """Add positions centred [n, c] with their weights [n]."""
        if position_weights is None:
            self.count += centred.shape[0]
            weighted = centred
        else:
            self.count += position_weights.double().sum()
            weighted = centred * position_weights[:, None]
        self.first += weighted.sum(dim=0, dtype=torch.float64)
        self.second += weighted.T @ centred

    def statistics(self, shift: Tensor) -> LayerStatistics:
        some = self.count > 0
        offset = self.first / torch.where(some, self.count, 1.0)
        mean = torch.where(some, shift + offset, 0.0)
        return LayerStatistics(self.count, mean, self.second - torch.outer(offset, offset) * self.count)


def layer_statistics_reference(features: Tensor, position_weights: Tensor | None = None) -> LayerStatistics:
    """The same in float64 and in one step: the definition, against which `layer_statistics` is tested."""
    flat = features.double().reshape(-1, features.shape[-1])
    equal = torch.ones(flat.shape[0], dtype=torch.float64)
    a = equal if position_weights is None else position_weights.double().reshape(-1)
    count = a.sum()
    mean = (a[:, None] * flat).sum(0) / count
    centred = (flat - mean) * a[:, None].sqrt()
    return LayerStatistics(count, mean, centred.T @ centred)
