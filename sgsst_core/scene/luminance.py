"""Luminance: the part of a color that changes where its chroma is kept.

Y = 0.299 R + 0.587 G + 0.114 B, the luma of YIQ, of colors as files and screens have them: what Gatys, Ecker, Bethge,
Hertzmann and Shechtman take ("Controlling Perceptual Factors in Neural Style Transfer", CVPR 2017, section 5.1). A
color to whose channels the same is added keeps its I and Q: its chroma.
"""

from __future__ import annotations

import torch
from torch import Tensor

#: Of red, green, blue; their sum is 1.
WEIGHTS = (0.299, 0.587, 0.114)


def luminance(colors: Tensor) -> Tensor:
    """Luminance [...] of colors [..., 3], in their dtype."""
    red, green, blue = colors.unbind(-1)
    return WEIGHTS[0] * red + WEIGHTS[1] * green + WEIGHTS[2] * blue


def gray(colors: Tensor) -> Tensor:
    """Colors [..., 3] with their luminance in each channel: pictures without color."""
    return torch.stack([luminance(colors)] * 3, dim=-1)


def gray_gradient(gradient: Tensor) -> Tensor:
    """dL/dcolors [..., 3] from dL/dgray(colors) [..., 3]: along the weights of luminance in every pixel."""
    total = gradient.sum(dim=-1)
    return torch.stack([weight * total for weight in WEIGHTS], dim=-1)


def with_chroma_of(colors: Tensor, original: Tensor) -> Tensor:
    """Colors [n, 3] moved no further than rounding, so that they differ from the original ones in luminance alone.

    The mean difference of the three channels is added to all of them, each rounded once: errors of many steps do not
    add up. Made for linear coefficients of colors as much as for colors.
    """
    change = (colors.double() - original.double()).mean(dim=-1, keepdim=True)
    return (original.double() + change).to(colors.dtype)
