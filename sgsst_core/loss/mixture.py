"""Several style pictures as one style: a mixture, of which each picture is a share.

What a mixture asks for are the moments of its features, taken over all pictures at once with each picture's share:

    G = sum_i w_i G_i,  mu = sum_i w_i mu_i,  sigma^2 = sum_i w_i (sigma_i^2 + (mu_i - mu)^2),  sum_i w_i = 1

The variance is a sum of terms that are not negative: nothing cancels, as it would in diag(G) - mu^2. One picture alone
is itself, to the bit.
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
    """The pictures of a style, with their shares.

    Attributes:
        pictures: [H_i, W_i, 3] in 0..1 each.
        weights: shares, above 0; they add up to 1.
        names: of the pictures, for people; empty where nobody gave any.
    """

    pictures: tuple[Tensor, ...]
    weights: tuple[float, ...] = (1.0,)
    names: tuple[str, ...] = ()

    @staticmethod
    def of(style: Tensor | StyleMixture) -> StyleMixture:
        """A picture [H, W, 3] as the mixture of itself alone; a mixture as it is."""
        return style if isinstance(style, StyleMixture) else StyleMixture((style,))

    @staticmethod
    def weighted(pictures: Sequence[Tensor], weights: Sequence[float], names: Sequence[str] = ()) -> StyleMixture:
        """Pictures with weights of any sum.

        Raises:
            SettingsError: no pictures, or weights that are no shares.
        """
        return StyleMixture(tuple(pictures), normalized(weights), tuple(names))

    def map(self, change: Callable[[Tensor], Tensor]) -> StyleMixture:
        """Every picture changed; itself where none is."""
        pictures = tuple(change(picture) for picture in self.pictures)
        if all(new is old for new, old in zip(pictures, self.pictures, strict=True)):
            return self
        return StyleMixture(pictures, self.weights, self.names)

    @property
    def text(self) -> str:
        """Names, and shares where there are several, for people."""
        names = self.names or [f"picture {number}" for number in range(1, len(self.pictures) + 1)]
        if len(names) == 1:
            return names[0]
        shares = zip(names, self.weights, strict=True)
        return ", ".join(f"{name} {share:.0%}" for name, share in shares)


def normalized(weights: Sequence[float]) -> tuple[float, ...]:
    """Weights of style pictures as shares that add up to 1; that of one picture alone is exactly 1.

    Raises:
        SettingsError: there are none, or one is not finite, or not above 0.
    """
    if not weights:
        raise SettingsError("There is no style picture. Give one.")
    for weight in weights:
        if not (math.isfinite(weight) and weight > 0):
            raise SettingsError(f"The weight {weight:g} of a style picture is no finite number above 0.")
    largest = max(weights)  # so that the sum of finite weights is finite
    shares = [weight / largest for weight in weights]
    total = math.fsum(shares)
    return tuple(share / total for share in shares)


def mixed_target(targets: Sequence[LayerTarget], weights: Sequence[float]) -> LayerTarget:
    """What a mixture asks of a layer, from what each picture asks, with weights that add up to anything above 0."""
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
    """Mean [c] and covariance [c, c] of a mixture from those of its parts."""
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
    """How many of each picture's positions are taken: all where that is no more than `most`, else by the weights.

    Each picture that has any gives one at least.
    """
    if sum(counts) <= most:
        return list(counts)
    return [min(count, max(1, int(most * weight))) for count, weight in zip(counts, weights, strict=True)]


def _sum(parts: Sequence[Tensor]) -> Tensor:
    return torch.stack(list(parts)).sum(dim=0)
