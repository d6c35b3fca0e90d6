"""Projection of colors to the range that screens can display: 0 to 1 in every channel.

A loss on images pushes colors beyond what a screen can show, where viewers clip them and the change is lost. Projecting
each color back after every step is projected gradient descent on a box. Adam scales each channel separately, so
clamping each channel is the exact projection.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0


def _largest_coefficient() -> float:
    """Return the largest float32 coefficient whose color is at most 1 in float64.

    Its negative has the color 0, because coefficient 0 is mid-gray.
    """
    largest = np.float32((1 - COLOR_OFFSET) / SH_C0)
    if COLOR_OFFSET + SH_C0 * float(largest) > 1:
        largest = np.nextafter(largest, np.float32(0))
    return float(largest)


#: DC coefficients from -LARGEST to LARGEST are colors from 0 to 1.
LARGEST = _largest_coefficient()


def on_screen(sh_dc: Tensor) -> Tensor:
    """Clamp DC coefficients [n, 3] so that their colors are in 0..1."""
    return sh_dc.clamp(-LARGEST, LARGEST)


def on_screen_by_luminance(sh_dc: Tensor) -> Tensor:
    """Add the smallest gray shift to DC coefficients [n, 3] that brings all channels of their colors into 0..1.

    If the channels differ by more than 1, no shift suffices; they then exceed the range equally on both sides.

    Returns:
        [n, 3], in the dtype of the argument; chroma is preserved up to rounding (`luminance.with_chroma_of`).
    """
    lowest, highest = torch.aminmax(sh_dc.double(), dim=1, keepdim=True)
    # Slightly inside the range, so that rounded sums do not leave it again.
    bound = LARGEST * (1 - 1e-6)
    inwards = (-bound - lowest).clamp_min(0) - (highest - bound).clamp_min(0)
    centered = -(lowest + highest) / 2
    return (sh_dc.double() + torch.where(highest - lowest > 2 * bound, centered, inwards)).to(sh_dc.dtype)
