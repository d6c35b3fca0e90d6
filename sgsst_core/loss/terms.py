"""The transfer loss of one scale and its gradient with respect to the features, in closed form.

E_style = sum over layers of w_G mean((G - G_v)^2) + w_m mean((mu - mu_v)^2) + w_s mean((sigma - sigma_v)^2)
E_content = lambda_c mean((F_42 - F_42^content)^2)
E_nearest: see `nearest`

with w_G = 1e3 / c^2 and w_m = w_s = 1e4 (SGSST, CVPR 2025); means over the entries of each matrix or vector.
With position weights a_p, n becomes their sum and the content mean is weighted in the same way.
"""

from __future__ import annotations

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

#: What the loss of a scale is the sum of: names, as files and reports have them, to what people read. The order is that
#: in which they are added up, shown and given their colors.
TERMS = {
    "gram": "Gram matrix",
    "mean": "mean",
    "std": "standard deviation",
    "content": "content",
    "nearest": "nearest neighbors",
}

#: w_G = GRAM_WEIGHT / c^2: the numerator.
GRAM_WEIGHT = 1e3
#: w_m.
MEAN_WEIGHT = 1e4
#: w_s.
STD_WEIGHT = 1e4


class TermWeights(NamedTuple):
    """c^2 w_G, w_m and w_s of a layer."""

    gram: float = GRAM_WEIGHT
    mean: float = MEAN_WEIGHT
    std: float = STD_WEIGHT


#: SGSST.
PAPERS_WEIGHTS = TermWeights()


@dataclass(frozen=True)
class LayerTarget:
    """What a layer is drawn to, float64: the style's Gram matrix [c, c], mean [c], standard deviation [c]."""

    gram: Tensor
    mean: Tensor
    std: Tensor

    @staticmethod
    def of(statistics: LayerStatistics) -> LayerTarget:
        """The target that the statistics of a style image make."""
        return LayerTarget(statistics.gram(), statistics.mean, statistics.std())


class LossTerms(Mapping[str, float]):
    """One scale's loss, split: every name in `TERMS` to its value, in that order; it does not change.

    Args:
        values: by name; those that are not given are 0.

    Raises:
        TypeError: there is no such term.
    """

    __slots__ = ("_values",)

    def __init__(self, **values: float) -> None:
        unknown = ", ".join(values.keys() - TERMS.keys())
        if unknown:
            raise TypeError(f"the loss has no term {unknown}; it has {', '.join(TERMS)}")
        self._values = {name: values.get(name, 0.0) for name in TERMS}

    @property
    def total(self) -> float:
        """What is minimized: the sum of all terms."""
        # `sum` would round otherwise from Python 3.12 on, and results would depend on the interpreter.
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
        """Of all terms' values, in the order of `TERMS`."""
        return LossTerms(**dict(zip(TERMS, values, strict=True)))

    def __truediv__(self, count: int) -> LossTerms:
        """Each term divided by a count: the mean of a sum."""
        return LossTerms(**{name: value / count for name, value in self.items()})

    def __repr__(self) -> str:
        return f"LossTerms({', '.join(f'{name}={value!r}' for name, value in self.items())})"


@dataclass(frozen=True)
class StyleGradient:
    """dE/dF of one layer as an affine map of centered features: dE/dF_p = a_p (matrix (F_p - mean) + offset).

    The map acts on centered features because at mean-to-sigma ratios of 1e4 the product matrix F and a separate
    offset would cancel each other down to their last digits in float32. In float64, but float32 where a GPU's kernels
    made it, which is what it is applied in to float32 features anyway.
    """

    matrix: Tensor  # [c, c]
    mean: Tensor  # [c]
    offset: Tensor  # [c]

    def times(self, factor: float) -> StyleGradient:
        """The gradient of the loss times a factor."""
        return StyleGradient(self.matrix * factor, self.mean, self.offset * factor)

    def about_rounded_mean(self) -> StyleGradient:
        """The same map about the mean as float32 has it, with what that leaves out in the offset.

        `add_to` takes the mean away in the features' precision. Where they lie nearer to each other than the rounding
        of their mean, as pixels of one color do, that would be most of the result.
        """
        mean = self.mean.float().double()
        return StyleGradient(self.matrix, mean, self.offset + self.matrix @ (mean - self.mean))

    def apply(self, features: Tensor, position_weights: Tensor | None = None) -> Tensor:
        """dE/dfeatures [h, w, c] for features [h, w, c] and position weights [h, w]."""
        result = torch.zeros(features.shape, dtype=features.dtype, device=features.device)
        self.add_to(result, features, position_weights)
        return result

    def add_to(self, gradient: Tensor, features: Tensor, position_weights: Tensor | None = None) -> None:
        """Add `apply` to a gradient [h, w, c] in place, block by block: nothing as large as the features is made."""
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
    """One layer's style loss and its gradient with respect to the features. Both are 0 where there is no position.

    Args:
        statistics: of the view's features.
        target: of the style.
        feature_eps: relative rounding of the features (2^-23 for float32, 2^-52 for float64).
        weights: of the terms.

    Returns:
        [5] float64, what the layer adds to each of `TERMS`; and the gradient.

    Where sigma is zero, or no more than the rounding of the mean, a channel is constant: its factor (F - mu)/sigma
    is taken as 0. The loss keeps the term, the gradient stays finite.
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
    """lambda_c / (n c) of a whole view, float64 scalar.

    Args:
        count: n, float64 scalar, positions or the sum of their weights; 0 gives no loss.
        weight: lambda_c.
    """
    return weight / (torch.where(count > 0, count, torch.inf) * channels)


@dataclass(frozen=True)
class ContentDifference:
    """How far some cells' content features are from what they should be: the content loss follows from it.

    Attributes:
        difference: [h, w, c], in float32 at least.
        weighted: the same times the position weights.
        factor: lambda_c / (n c), float64: the loss is a mean over the view's n positions (or their weights).
    """

    difference: Tensor
    weighted: Tensor
    factor: Tensor

    @staticmethod
    def of(
        features: Tensor, content: Tensor, factor: Tensor, position_weights: Tensor | None = None
    ) -> ContentDifference:
        """Of features and content [h, w, c] at the same positions.

        Args:
            factor: of `content_factor`.
            position_weights: [h, w].
        """
        precision = torch.promote_types(features.dtype, torch.float32)
        difference = features.to(precision) - content.to(precision)
        weighted = difference if position_weights is None else difference * position_weights[:, :, None].to(precision)
        return ContentDifference(difference, weighted, factor)

    def loss(self) -> Tensor:
        """These cells' share of the content loss, float64 scalar."""
        # A dot product in float32 over a whole view would lose digits: rows first, then float64.
        return self.factor * (self.weighted * self.difference).sum(dim=(1, 2)).sum(dtype=torch.float64)

    def gradient(self) -> Tensor:
        """Its gradient with respect to the features, [h, w, c]."""
        return self.weighted * (2 * self.factor)
