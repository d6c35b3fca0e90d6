"""Luminance, for changing colors without changing their chroma.

Luminance is Y = 0.299 R + 0.587 G + 0.114 B, the luma of YIQ, computed from colors as they are stored and displayed
(gamma-encoded), as in Gatys, Ecker, Bethge, Hertzmann and Shechtman, "Controlling Perceptual Factors in Neural Style
Transfer", CVPR 2017, section 5.1. Adding the same value to all channels of a color does not change its I and Q, which
are its chroma.
"""

from __future__ import annotations

import torch
from torch import Tensor

#: Weights of red, green and blue; their sum is 1.
WEIGHTS = (0.299, 0.587, 0.114)


def luminance(colors: Tensor) -> Tensor:
    """Return the luminance [...] of colors [..., 3], in their dtype."""
    red, green, blue = colors.unbind(-1)
    return WEIGHTS[0] * red + WEIGHTS[1] * green + WEIGHTS[2] * blue


def gray(colors: Tensor) -> Tensor:
    """Return gray colors [..., 3], whose channels all equal the luminance of the given colors."""
    return torch.stack([luminance(colors)] * 3, dim=-1)


def gray_gradient(gradient: Tensor) -> Tensor:
    """Return dL/dcolors [..., 3] from dL/dgray(colors) [..., 3]: the channel sum times the luminance weights."""
    total = gradient.sum(dim=-1)
    return torch.stack([weight * total for weight in WEIGHTS], dim=-1)


def with_chroma_of(colors: Tensor, original: Tensor) -> Tensor:
    """Remove rounding errors from the chroma of colors [n, 3] that differ from `original` only in luminance.

    The difference from the original, averaged over the three channels, is added to each original channel and rounded
    once, so errors of many steps do not accumulate. DC coefficients work too, because colors are linear in them.
    """
    change = (colors.double() - original.double()).mean(dim=-1, keepdim=True)
    return (original.double() + change).to(colors.dtype)
