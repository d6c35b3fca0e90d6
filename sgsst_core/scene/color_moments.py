"""Mean and covariance of colors."""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.style import Style, mixed_moments

#: Mean [3] and covariance [3, 3], float64.
Moments = tuple[Tensor, Tensor]


def color_moments(colors: Tensor, weights: Tensor | None = None) -> Moments:
    """Return the mean and covariance of colors [n, 3], weighted by [n]; None for equal weights."""
    colors = colors.double()
    weights = colors.new_ones(len(colors)) if weights is None else weights.double()
    total = weights.sum()
    mean = (weights[:, None] * colors).sum(dim=0) / total
    centered = colors - mean
    return mean, (weights[:, None] * centered).T @ centered / total


def style_moments(style: Style) -> Moments:
    """Return the mean and covariance of the pixels of a style; those of several images are mixed."""
    return mixed_moments([color_moments(image.reshape(-1, 3)) for image in style.images], style.weights)


def square_root(matrix: Tensor) -> Tensor:
    """Return the square root of a symmetric matrix that is positive semidefinite up to rounding."""
    values, vectors = torch.linalg.eigh(matrix)
    root: Tensor = vectors * values.clamp_min(0).sqrt() @ vectors.T
    return root
