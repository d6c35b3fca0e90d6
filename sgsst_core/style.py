"""Styles: one or several weighted images.

The mean mu and covariance S of a style of several images, with weights w_i, are those of their union:

    mu = sum_i w_i mu_i,  S = sum_i w_i (S_i + (mu_i - mu) (mu_i - mu)^T),  sum_i w_i = 1
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sgsst_core.errors import SettingsError


@dataclass(frozen=True)
class Style:
    """Weighted images that are used together as one style.

    Attributes:
        images: Images, [H_i, W_i, 3] in 0..1 each.
        weights: Weights above 0 that add up to 1.
        names: Display names of the images; empty if they have none.
        notes: What was not used when the images were read, such as a broken color profile.
    """

    images: tuple[Tensor, ...]
    weights: tuple[float, ...] = (1.0,)
    names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @staticmethod
    def of(style: Tensor | Style) -> Style:
        """Wrap a single image [H, W, 3] as a style; return a style unchanged."""
        return style if isinstance(style, Style) else Style((style,))

    @staticmethod
    def weighted(images: Sequence[Tensor], weights: Sequence[float], names: Sequence[str] = ()) -> Style:
        """Create a style from weights that need not add up to 1.

        Raises:
            SettingsError: If there are no images, or a weight is not a finite number above 0.
        """
        return Style(tuple(images), normalized(weights), tuple(names))

    def map(self, change: Callable[[Tensor], Tensor]) -> Style:
        """Return the style with a function applied to every image, or `self` if no image changes."""
        images = tuple(change(image) for image in self.images)
        if all(new is old for new, old in zip(images, self.images, strict=True)):
            return self
        return replace(self, images=images)

    @property
    def text(self) -> str:
        """Display text: the names, with percentages if there are several images."""
        names = self.names or [f"image {number}" for number in range(1, len(self.images) + 1)]
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


def _sum(parts: Sequence[Tensor]) -> Tensor:
    return torch.stack(list(parts)).sum(dim=0)
