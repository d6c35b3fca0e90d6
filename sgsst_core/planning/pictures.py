"""Synthetic images for measurements that do not use the job's own images."""

from __future__ import annotations

import torch
from torch import Tensor


def soft_picture(side: int) -> Tensor:
    """Return a smooth image [side, side, 3] in 0..1: fixed random colors 16 pixels apart, interpolated."""
    cells = torch.rand((1, 3, side // 16 + 1, side // 16 + 1), generator=torch.Generator().manual_seed(0))
    picture = torch.nn.functional.interpolate(cells, size=(side, side), mode="bilinear")[0]
    return picture.permute(1, 2, 0).contiguous()
