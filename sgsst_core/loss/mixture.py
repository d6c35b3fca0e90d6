"""Style mixtures: several weighted style images used as one style.

The targets of a mixture are the moments of the features of all its images, with weights w_i:

    G = sum_i w_i G_i,  mu = sum_i w_i mu_i,  sigma^2 = sum_i w_i (sigma_i^2 + (mu_i - mu)^2),  sum_i w_i = 1

The variance is a sum of non-negative terms, which avoids the cancellation in diag(G) - mu^2. The targets of a mixture
of one image are bit-identical to those of the image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.errors import SettingsError
from sgsst_core.loss.terms import LayerTarget


@dataclass(frozen=True)
class StyleMixture:
    """Style images with their weights.

    Attributes:
        pictures: Images, [H_i, W_i, 3] in 0..1 each.
        weights: Weights above 0 that add up to 1.
        names: Display names of the images; empty if they have none.
    """

    pictures: tuple[Tensor, ...]
    weights: tuple[float, ...] = (1.0,)
    names: tuple[str, ...] = ()

    @staticmethod
    def of(style: Tensor | StyleMixture) -> StyleMixture:
        """Wrap a single image [H, W, 3] as a mixture; return a mixture unchanged."""
        return style if isinstance(style, StyleMixture) else StyleMixture((style,))

    @staticmethod
    def weighted(pictures: Sequence[Tensor], weights: Sequence[float], names: Sequence[str] = ()) -> StyleMixture:
        """Create a mixture from weights that need not add up to 1.

        Raises:
            SettingsError: If there are no images, or a weight is not a finite number above 0.
        """
        return StyleMixture(tuple(pictures), normalized(weights), tuple(names))

    def map(self, change: Callable[[Tensor], Tensor]) -> StyleMixture:
        """Return the mixture with a function applied to every image, or `self` if no image changes."""
        pictures = tuple(change(picture) for picture in self.pictures)
        if all(new is old for new, old in zip(pictures, self.pictures, strict=True)):
            return self
        return StyleMixture(pictures, self.weights, self.names)

    @property
    def text(self) -> str:
        """Display text: the names, with percentages if there are several images."""
        names = self.names or [f"picture {number}" for number in range(1, len(self.pictures) + 1)]
        if len(names) == 1:
            return names[0]
        shares = zip(names, self.weights, strict=True)
        return ", ".join(f"{name} {share:.0%}" for name, share in shares)


def normalized(weights: Sequence[float]) -> tuple[float, ...]:
    """Normalize weights of style images so that they add up to 1. A single weight becomes exactly 1.

    Raises:
        SettingsError: If there are no weights, or one is not a finite number above 0.
    """
    if not weights:
        raise SettingsError("There is no style image. Give at least one.")
    for weight in weights:
        if not (math.isfinite(weight) and weight > 0):
            raise SettingsError(
                f"The weight {weight:g} of a style image is not a finite number greater than 0. Change it."
            )
    largest = max(weights)  # dividing by it keeps the sum of finite weights finite
    shares = [weight / largest for weight in weights]
    total = math.fsum(shares)
    return tuple(share / total for share in shares)


def mixed_target(targets: Sequence[LayerTarget], weights: Sequence[float]) -> LayerTarget:
    """Combine the layer targets of several images into the target of their mixture.

    The weights need not add up to 1.
    """
    if len(targets) == 1:
        return targets[0]
    total = math.fsum(weights)
    shares = [weight / total for weight in weights]
    mean = _sum([share * target.mean for target, share in zip(targets, shares, strict=True)])
    gram = _sum([share * target.gram for target, share in zip(targets, shares, strict=True)])
    variance = _sum(
        [
            share * (target.std.square() + (target.mean - mean).square())
            for target, share in zip(targets, shares, strict=True)
        ]
    )
    return LayerTarget(gram, mean, variance.sqrt())


def mixed_moments(moments: Sequence[tuple[Tensor, Tensor]], weights: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Compute mean [c] and covariance [c, c] of a mixture from those of its components."""
    if len(moments) == 1:
        return moments[0]
    mean = _sum([weight * own for (own, _), weight in zip(moments, weights, strict=True)])
    covariance = _sum(
        [
            weight * (spread + torch.outer(own - mean, own - mean))
            for (own, spread), weight in zip(moments, weights, strict=True)
        ]
    )
    return mean, covariance


def shares_of(counts: Sequence[int], weights: Sequence[float], most: int) -> list[int]:
    """Return how many positions to take from each image.

    If there are at most `most` positions in total, all are taken. Otherwise each image contributes in proportion to its
    weight, but at least one position if it has any.
    """
    if sum(counts) <= most:
        return list(counts)
    return [min(count, max(1, int(most * weight))) for count, weight in zip(counts, weights, strict=True)]


def _sum(parts: Sequence[Tensor]) -> Tensor:
    return torch.stack(list(parts)).sum(dim=0)
