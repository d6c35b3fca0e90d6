"""Luminance: the part of a colour that changes where its chroma is kept.

Y = 0.299 R + 0.587 G + 0.114 B, the luma of YIQ, of colours as files and screens have them: what Gatys, Ecker, Bethge,
Hertzmann and Shechtman take ("Controlling Perceptual Factors in Neural Style Transfer", CVPR 2017, section 5.1). A
colour to whose channels the same is added keeps its I and Q: its chroma.
"""

from __future__ import annotations

import torch
from torch import Tensor

#: Of red, green, blue; their sum is 1.
WEIGHTS = (0.299, 0.587, 0.114)


def luminance(colours: Tensor) -> Tensor:
    """Luminance [...] of colours [..., 3], in their dtype."""
    red, green, blue = colours.unbind(-1)
    return WEIGHTS[0] * red + WEIGHTS[1] * green + WEIGHTS[2] * blue


def grey(colours: Tensor) -> Tensor:
    """Colours [..., 3] with their luminance in each channel: pictures without colour."""
    return torch.stack([luminance(colours)] * 3, dim=-1)


def grey_gradient(gradient: Tensor) -> Tensor:
    """dL/dcolours [..., 3] from dL/dgrey(colours) [..., 3]: along the weights of luminance in every pixel."""
    total = gradient.sum(dim=-1)
    return torch.stack([weight * total for weight in WEIGHTS], dim=-1)


def with_chroma_of(colours: Tensor, original: Tensor) -> Tensor:
    """Colours [n, 3] moved no further than rounding, so that they differ from the original ones in luminance alone.

    The mean difference of the three channels is added to all of them, each rounded once: errors of many steps do not
    add up. Made for linear coefficients of colours as much as for colours.
    """
    change = (colours.double() - original.double()).mean(dim=-1, keepdim=True)
    return (original.double() + change).to(colours.dtype)
