"""Transfer loss of one scale and its gradient with respect to the features, in closed form.

E_style = sum over layers of w_G mean((G - G_v)^2) + w_m mean((mu - mu_v)^2) + w_s mean((sigma - sigma_v)^2)
E_content = lambda_c mean((F_42 - F_42^content)^2)
E_nearest: see `nearest`

with w_G = 1e3 / c^2 and w_m = w_s = 1e4 (SGSST, CVPR 2025). Means are over the entries of each matrix or vector. If
there are position weights a_p, the statistics G, mu and sigma and the content mean are weighted by them, and n is their
sum instead of the number of positions.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from sgsst_core.features.fused_statistics import can_be_fused, has_kernels
from sgsst_core.features.statistics import LayerStatistics, blocks_of, center
from sgsst_core.loss.fused_terms import fused_add_style_gradient, fused_style_loss

#: Terms whose sum is the loss of a scale: name in files and reports, and display name. Summation, display and chart
#: colors follow this order.
TERMS = {
    "gram": "Gram matrix",
    "mean": "mean",
    "std": "standard deviation",
    "content": "content",
    "nearest": "nearest neighbors",
}

#: Numerator of w_G = GRAM_WEIGHT / c^2.
GRAM_WEIGHT = 1e3
#: w_m.
MEAN_WEIGHT = 1e4
#: w_s.
STD_WEIGHT = 1e4


class TermWeights(NamedTuple):
    """Weights c^2 w_G, w_m and w_s of the terms of a layer."""

    gram: float = GRAM_WEIGHT
    mean: float = MEAN_WEIGHT
    std: float = STD_WEIGHT


#: Weights of the SGSST paper.
PAPERS_WEIGHTS = TermWeights()


@dataclass(frozen=True)
class LayerTarget:
    """Target of one layer: the style's Gram matrix [c, c], mean [c] and standard deviation [c], float64."""

    gram: Tensor
    mean: Tensor
    std: Tensor

    @staticmethod
    def of(statistics: LayerStatistics) -> LayerTarget:
        """Create the target from the statistics of a style image."""
        return LayerTarget(statistics.gram(), statistics.mean, statistics.std())

    @staticmethod
    def mixed(targets: Sequence[LayerTarget], weights: Sequence[float]) -> LayerTarget:
        """Combine the targets of several images into the target of a style of all of them.

        The variance is a sum of non-negative terms, which avoids the cancellation in diag(G) - mu^2:

            G = sum_i w_i G_i,  mu = sum_i w_i mu_i,  sigma^2 = sum_i w_i (sigma_i^2 + (mu_i - mu)^2)

        Args:
            targets: Target of each image.
            weights: Weights w_i, which need not add up to 1.
        """
        if len(targets) == 1:
            return targets[0]
        total = math.fsum(weights)
        pairs = [(target, weight / total) for target, weight in zip(targets, weights, strict=True)]
        mean = torch.stack([weight * target.mean for target, weight in pairs]).sum(dim=0)
        gram = torch.stack([weight * target.gram for target, weight in pairs]).sum(dim=0)
        variances = [weight * (target.std.square() + (target.mean - mean).square()) for target, weight in pairs]
        return LayerTarget(gram, mean, torch.stack(variances).sum(dim=0).sqrt())


class LossTerms(Mapping[str, float]):
    """Immutable mapping from every name in `TERMS` to its value: the loss of one scale, split into terms.

    Args:
        values: Values by name; missing terms are 0.

    Raises:
        TypeError: If a name is not in `TERMS`.
    """

    __slots__ = ("_values",)

    def __init__(self, **values: float) -> None:
        unknown = ", ".join(values.keys() - TERMS.keys())
        if unknown:
            raise TypeError(f"the loss has no term {unknown}; it has {', '.join(TERMS)}")
        self._values = {name: values.get(name, 0.0) for name in TERMS}

    @property
    def total(self) -> float:
        """Sum of all terms, the loss to minimize."""
        # `sum` rounds differently from Python 3.12 on, so results would depend on the interpreter.
        return reduce(operator.add, self._values.values())

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __add__(self, other: LossTerms) -> LossTerms:
        return LossTerms(**{name: value + other[name] for name, value in self.items()})

    @staticmethod
    def of(values: Sequence[float]) -> LossTerms:
        """Create from the values of all terms, in the order of `TERMS`."""
        return LossTerms(**dict(zip(TERMS, values, strict=True)))

    def __truediv__(self, count: int) -> LossTerms:
        """Divide every term by a count, which turns a sum into a mean."""
        return LossTerms(**{name: value / count for name, value in self.items()})

    def __repr__(self) -> str:
        return f"LossTerms({', '.join(f'{name}={value!r}' for name, value in self.items())})"


@dataclass(frozen=True)
class StyleGradient:
    """dE/dF of one layer as an affine map of centered features: dE/dF_p = a_p (matrix (F_p - mean) + offset).

    The map acts on centered features because at mean-to-sigma ratios of 1e4, matrix @ F and a separate offset would
    cancel down to their last digits in float32. Tensors are float64, or float32 if GPU kernels computed them; float32
    features are multiplied in float32 in either case.
    """

    matrix: Tensor  # [c, c]
    mean: Tensor  # [c]
    offset: Tensor  # [c]

    def times(self, factor: float) -> StyleGradient:
        """Return the gradient of the loss times a factor."""
        return StyleGradient(self.matrix * factor, self.mean, self.offset * factor)

    def about_rounded_mean(self) -> StyleGradient:
        """Return the same map about the mean rounded to float32, with the rounding error moved into the offset.

        `add_to` subtracts the mean in the precision of the features. If the features differ by less than the rounding
        error of their mean, as in an image of a single color, that error would dominate the result.
        """
        mean = self.mean.float().double()
        return StyleGradient(self.matrix, mean, self.offset + self.matrix @ (mean - self.mean))

    def apply(self, features: Tensor, position_weights: Tensor | None = None) -> Tensor:
        """Return dE/dfeatures [h, w, c] for features [h, w, c] and position weights [h, w]."""
        result = torch.zeros(features.shape, dtype=features.dtype, device=features.device)
        self.add_to(result, features, position_weights)
        return result

    def add_to(self, gradient: Tensor, features: Tensor, position_weights: Tensor | None = None) -> None:
        """Add the result of `apply` to a gradient [h, w, c] in place.

        The computation runs in blocks, so no tensor as large as the features is allocated.
        """
        if can_be_fused(features) and can_be_fused(gradient) and self.matrix.dtype == torch.float32:
            fused_add_style_gradient(gradient, features, self.matrix, self.mean, self.offset, position_weights)
            return
        precision = torch.promote_types(features.dtype, torch.float32)
        matrix, mean, offset = (t.to(features.device, precision) for t in (self.matrix, self.mean, self.offset))
        for rows, block in blocks_of(features):
            centered, target = center(features[rows], mean, block).view(-1, len(mean)), gradient[rows]
            weights = centered.new_ones(1) if position_weights is None else position_weights[rows].reshape(-1)
            weights = weights.to(precision).expand(len(centered))
            if position_weights is not None:
                centered *= weights[:, None]
            if target.dtype == precision and target.is_contiguous():
                target.view(centered.shape).addmm_(centered, matrix).addr_(weights, offset)
            else:
                target += torch.addr(centered @ matrix, weights, offset).view(target.shape)


def style_loss(
    statistics: LayerStatistics,
    target: LayerTarget,
    *,
    feature_eps: float = 2.0**-23,
    weights: TermWeights = PAPERS_WEIGHTS,
) -> tuple[Tensor, StyleGradient]:
    """Compute the style loss of one layer and its gradient with respect to the features.

    A channel counts as constant if its sigma is 0 or within the rounding error of its mean. In the gradient, its factor
    (F - mu)/sigma is then set to 0, so the gradient is finite; the loss still contains the sigma term. If there are no
    positions, loss and gradient are 0.

    Args:
        statistics: Statistics of the view's features.
        target: Target from the style.
        feature_eps: Relative rounding error of the features (2^-23 for float32, 2^-52 for float64).
        weights: Weights of the terms.

    Returns:
        Contribution of the layer to each of `TERMS`, [5] float64, and the gradient.
    """
    channels = statistics.mean.shape[0]
    if has_kernels(statistics.mean.device, channels) and feature_eps > torch.finfo(torch.float64).eps:
        fused = fused_style_loss(statistics, (target.gram, target.mean, target.std), weights, feature_eps)
        return fused[0], StyleGradient(*fused[1:])
    some = statistics.count > 0
    gram_error = statistics.gram() - target.gram
    mean_error = statistics.mean - target.mean
    std = statistics.std()
    std_error = std - target.std
    gram_weight, nothing = weights.gram / channels**2, torch.zeros_like(statistics.count)
    terms = torch.stack(
        [
            gram_weight * gram_error.square().mean(),
            weights.mean * mean_error.square().mean(),
            weights.std * std_error.square().mean(),
            nothing,
            nothing,
        ]
    )
    matrix = (4 * gram_weight / channels**2) * gram_error
    offset = matrix @ statistics.mean + (2 * weights.mean / channels) * mean_error
    alive = std > feature_eps * statistics.mean.abs()
    slope = torch.where(alive, std_error / torch.where(alive, std, 1.0), 0.0)
    matrix = matrix + torch.diag((2 * weights.std / channels) * slope)
    count = torch.where(some, statistics.count, torch.inf)
    return torch.where(some, terms, 0.0), StyleGradient(matrix / count, statistics.mean, offset / count)


def content_factor(count: Tensor, channels: int, weight: float) -> Tensor:
    """Return lambda_c / (n c), the factor of the content term of a whole view, float64 scalar.

    Args:
        count: n, float64 scalar: number of positions or sum of their weights. If it is 0, the factor is 0.
        channels: c.
        weight: lambda_c.
    """
    return weight / (torch.where(count > 0, count, torch.inf) * channels)


@dataclass(frozen=True)
class ContentDifference:
    """Difference between content features and their target on some cells.

    Attributes:
        difference: [h, w, c], float32 or float64.
        weighted: Difference times the position weights.
        factor: lambda_c / (n c), float64, where n is the number of positions of the view or the sum of their weights.
    """

    difference: Tensor
    weighted: Tensor
    factor: Tensor

    @staticmethod
    def of(
        features: Tensor, content: Tensor, factor: Tensor, position_weights: Tensor | None = None
    ) -> ContentDifference:
        """Compare features of the image with those of the content image at the same positions.

        Args:
            features: [h, w, c].
            content: [h, w, c].
            factor: Result of `content_factor`.
            position_weights: [h, w]; None for equal weights.
        """
        precision = torch.promote_types(features.dtype, torch.float32)
        difference = features.to(precision) - content.to(precision)
        weighted = difference if position_weights is None else difference * position_weights[:, :, None].to(precision)
        return ContentDifference(difference, weighted, factor)

    def loss(self) -> Tensor:
        """Return the contribution of these cells to the content loss, float64 scalar."""
        # A float32 dot product over a whole view would lose digits, so rows are summed first and then added in float64.
        return self.factor * (self.weighted * self.difference).sum(dim=(1, 2)).sum(dtype=torch.float64)

    def gradient(self) -> Tensor:
        """Return the gradient with respect to the features, [h, w, c]."""
        return self.weighted * (2 * self.factor)
