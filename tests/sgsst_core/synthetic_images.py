"""Synthetic images with smooth structure and some texture, so that features are neither zero nor noise."""

import torch
import torch.nn.functional as F
from torch import Tensor


def synthetic_image(height: int, width: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    """Return an image [height, width, 3] from 0 to 1 with edges, gradients and texture."""
    generator = torch.Generator().manual_seed(seed)
    result = torch.zeros((1, 3, height, width), dtype=torch.float64)
    for cell, strength in ((64, 0.5), (16, 0.3), (4, 0.2)):
        coarse = torch.rand((1, 3, height // cell + 2, width // cell + 2), generator=generator, dtype=torch.float64)
        result += strength * F.interpolate(coarse, size=(height, width), mode="bilinear")
    return result[0].permute(1, 2, 0).contiguous().to(dtype)


def relative_error(value: Tensor, expected: Tensor) -> float:
    """Return the norm of the difference divided by the norm of the expected value."""
    expected = expected.double()
    return float((value.double() - expected).norm() / expected.norm())


def nearly_one_color(height: int = 40, width: int = 50) -> Tensor:
    """Return an image [h, w, 3] float32 with values from 100 to 100 + 7 * 2^-17: eight adjacent float32 numbers.

    Its mean is not representable in float32.
    """
    steps = torch.randint(8, (height, width, 3), generator=torch.Generator().manual_seed(3))
    return 100 + 2.0**-17 * steps.float()
