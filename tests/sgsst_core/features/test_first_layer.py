"""Tests of the Triton kernels of the first convolution against float64, on a GPU or in Triton's interpreter."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.features.first_layer import convolve_pixels, pixel_gradient
from tests.sgsst_core.synthetic_images import relative_error

pytest.importorskip("triton")
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
pytestmark = [pytest.mark.gpu] if DEVICE == "cuda" else []
SCALE, SHIFT = torch.tensor([1.0, 2.0, -3.0]), torch.tensor([-0.5, 0.4, 0.3])


def random(*shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(len(shape))).bfloat16()


@pytest.mark.parametrize(("height", "width", "channels"), [(3, 131, 64), (5, 7, 8), (1, 1, 16)])
def test_first_convolution_agrees_with_float64(height: int, width: int, channels: int) -> None:
    """A row has more pixels than a program, or fewer. Outside of the image are zeros, not normalized black pixels."""
    pixels, bias = random(height, width, 3).float(), random(channels)
    weight = random(channels, 3, 3, 3).contiguous(memory_format=torch.channels_last)
    actual = convolve_pixels(*(part.to(DEVICE) for part in (pixels, weight, bias, SCALE, SHIFT))).cpu()
    assert actual.is_contiguous(memory_format=torch.channels_last)
    normalized = (pixels * SCALE + SHIFT).bfloat16().double().permute(2, 0, 1)[None]
    expected = F.conv2d(normalized, weight.double(), bias.double(), padding=1).relu()
    assert relative_error(actual.double(), expected) < 3e-3


@pytest.mark.parametrize(("height", "width", "channels"), [(3, 131, 64), (5, 7, 8), (1, 1, 16)])
def test_pixel_gradient_agrees_with_float64(height: int, width: int, channels: int) -> None:
    weight = random(3, channels, 3, 3).contiguous(memory_format=torch.channels_last)
    gradient = random(1, height, width, channels).permute(0, 3, 1, 2)
    actual = pixel_gradient(*(part.to(DEVICE) for part in (gradient, weight, SCALE))).cpu()
    expected = F.conv2d(gradient.double(), weight.double(), padding=1)[0].permute(1, 2, 0) * SCALE
    assert relative_error(actual.double(), expected) < 1e-6


def test_nan_pixels_give_nan_features() -> None:
    """A broken image must not look like one without features."""
    pixels, weight = torch.full((2, 3, 3), torch.nan), random(8, 3, 3, 3).contiguous(memory_format=torch.channels_last)
    features = convolve_pixels(*(part.to(DEVICE) for part in (pixels, weight, random(8), SCALE, SHIFT)))
    assert features.isnan().all()
