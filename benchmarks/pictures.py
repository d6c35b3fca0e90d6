"""Images for benchmarks: photos included in scikit-image, at any size."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from skimage import data
from torch import Tensor


def picture(name: str, height: int, width: int) -> Tensor:
    """Return an image of scikit-image, for example "astronaut", as [height, width, 3] in 0 to 1, with fine grain.

    Without grain, enlarged photos have no detail at full size, so the largest scale would be unlike that of a real
    view.
    """
    pixels = torch.from_numpy(getattr(data, name)()[..., :3].copy()).float() / 255
    planes = F.interpolate(pixels.permute(2, 0, 1)[None], size=(height, width), mode="bicubic", align_corners=False)
    grain = torch.randn((height, width, 3), generator=torch.Generator().manual_seed(0)) * 0.03
    return (planes[0].permute(1, 2, 0) + grain).clamp(0, 1).contiguous()
