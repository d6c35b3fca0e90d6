"""Images for benchmarks: photos from scikit-image, resized to any size."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from skimage import data
from torch import Tensor


def grainy_photo(name: str, height: int, width: int) -> Tensor:
    """Return a photo of scikit-image, e.g. "astronaut", as [height, width, 3] from 0 to 1, with fine grain added.

    Without grain, enlarged photos have no detail at full size, unlike real views.
    """
    pixels = torch.from_numpy(getattr(data, name)()[..., :3].copy()).float() / 255
    planes = F.interpolate(pixels.permute(2, 0, 1)[None], size=(height, width), mode="bicubic", align_corners=False)
    grain = torch.randn((height, width, 3), generator=torch.Generator().manual_seed(0)) * 0.03
    return (planes[0].permute(1, 2, 0) + grain).clamp(0, 1).contiguous()
