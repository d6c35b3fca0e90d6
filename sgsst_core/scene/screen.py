"""Colors that screens show: 0 to 1 in every channel.

A loss on pictures pushes colors beyond what a screen can show, where a viewer cuts them off and nothing is seen of
what they were moved for. Bringing each color back after every step is projected gradient descent on a box; for Adam,
whose metric is diagonal, cutting off each channel is the exact projection.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0


def _largest_coefficient() -> float:
    """Largest float32 whose color is at most 1 in float64; that of 0 is its negative, because 0.5 is in the middle."""
    largest = np.float32((1 - COLOR_OFFSET) / SH_C0)
    if COLOR_OFFSET + SH_C0 * float(largest) > 1:
        largest = np.nextafter(largest, np.float32(0))
    return float(largest)


#: DC coefficients from -LARGEST to LARGEST are colors from 0 to 1.
LARGEST = _largest_coefficient()


def on_screen(sh_dc: Tensor) -> Tensor:
    """DC coefficients [n, 3] cut off where their colors would leave 0..1."""
    return sh_dc.clamp(-LARGEST, LARGEST)


def on_screen_by_luminance(sh_dc: Tensor) -> Tensor:
    """DC coefficients [n, 3] moved along gray, as little as brings all channels into 0..1.

    Where channels are further apart than 0 and 1 are, none could hold them: they stick out as far on both sides.

    Returns:
        [n, 3], in the dtype of the argument; chroma is kept to its rounding (`luminance.with_chroma_of`).
    """
    lowest, highest = torch.aminmax(sh_dc.double(), dim=1, keepdim=True)
    # A little inside, so that rounding of what is added to each channel does not lead out again.
    bound = LARGEST * (1 - 1e-6)
    inwards = (-bound - lowest).clamp_min(0) - (highest - bound).clamp_min(0)
    centered = -(lowest + highest) / 2
    return (sh_dc.double() + torch.where(highest - lowest > 2 * bound, centered, inwards)).to(sh_dc.dtype)
