"""Tests of LPIPS against a second implementation, values from the published code, and properties in its paper."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from skimage import data
from torch import Tensor

from sgsst_core.errors import WeightsError
from sgsst_core.quality.lpips import MIN_SIDE, Lpips, load_lpips_or_none
from tests.sgsst_core.synthetic_images import synthetic_image


@pytest.fixture(scope="module")
def alex(vgg16_weights: object) -> Lpips:
    """Load LPIPS with AlexNet in float64. Its weights are installed together with VGG16's."""
    return Lpips(dtype=torch.float64)


def photo(name: str) -> Tensor:
    """Return a photo [H, W, 3], float64 from 0 to 1."""
    return torch.from_numpy(getattr(data, name)()).double() / 255


def box_blurred(image: Tensor, side: int) -> Tensor:
    planes = image.permute(2, 0, 1)[None]
    blurred = F.avg_pool2d(planes, side, 1, side // 2, count_include_pad=False)
    return blurred[0].permute(1, 2, 0).contiguous()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_zero_for_equal_images_and_symmetric(vgg16_weights, dtype):
    lpips = Lpips(dtype=dtype)
    first, second = synthetic_image(37, 50, seed=1), synthetic_image(37, 50, seed=2)
    same = lpips.distance(first, first)
    assert same.mean == 0.0
    assert same.map.shape == (37, 50)
    assert not same.map.any()
    forth, back = lpips.distance(first, second), lpips.distance(second, first)
    assert forth.mean > 0.01
    assert forth.mean == back.mean
    assert torch.equal(forth.map, back.map)


def test_float32_agrees_with_float64(alex: Lpips):
    first, second = synthetic_image(45, 61, seed=3), synthetic_image(45, 61, seed=4)
    reference, result = alex.distance(first, second), Lpips().distance(first, second)
    assert result.map.dtype == torch.float32
    assert result.mean == pytest.approx(reference.mean, rel=1e-5)
    torch.testing.assert_close(result.map.double(), reference.map, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    "changed",
    [
        lambda image, strength: image + strength * torch.randn(image.shape, generator=torch.Generator().manual_seed(0)),
        lambda image, strength: box_blurred(image, 2 * round(strength * 50) + 1),
    ],
    ids=["noise", "blur"],
)
def test_increases_with_noise_and_blur(alex: Lpips, changed: Callable[[Tensor, float], Tensor]):
    image = photo("coffee")[100:200, 150:300]
    distances = [alex.distance(image, changed(image, strength)).mean for strength in (0.02, 0.04, 0.08, 0.16)]
    assert distances == sorted(distances)
    assert distances[0] > 0.005
    assert distances[-1] > 3 * distances[0]


#: Photo that 150 x 120 pixels are taken from, image it is compared with, and value of the published PyTorch package
#: (`lpips` 0.1.4 with these weights, in float64).
PUBLISHED = [
    ("astronaut", lambda image: image**0.7, 0.034148751276),
    ("astronaut", lambda image: box_blurred(image, 5), 0.286169259936),
    ("coffee", lambda image: image**0.7, 0.021160692171),
    ("coffee", lambda image: box_blurred(image, 5), 0.166752439171),
]


@pytest.mark.parametrize(("name", "changed", "expected"), PUBLISHED, ids=["curve", "blur"] * 2)
def test_agrees_with_the_published_code(alex: Lpips, name, changed, expected):
    image = photo(name)[100:220, 150:300]
    result = alex.distance(image, changed(image))
    assert result.mean == pytest.approx(expected, rel=1e-6)  # the published code rounds its input scaling to float32
    assert float(result.map.mean()) == pytest.approx(expected, rel=2e-3)  # upsampling weighs the border differently


def test_constant_images_are_finite(alex: Lpips):
    black, white = torch.zeros(40, 40, 3), torch.ones(40, 40, 3)
    for first, second in ((black, white), (black, black), (white, 0.5 * white)):
        result = alex.distance(first, second)
        assert np.isfinite(result.mean)
        assert result.map.isfinite().all()


def test_minimum_image_size_is_enforced(alex: Lpips):
    side = MIN_SIDE
    first, second = synthetic_image(side, 64, seed=7), synthetic_image(side, 64, seed=8)
    assert alex.distance(first, second).mean > 0
    with pytest.raises(ValueError, match=f"64 x {side - 1} pixels: {side} are the least"):
        alex.distance(first[1:], second[1:])


def test_wrong_arguments_are_named(alex: Lpips, tmp_path):
    with pytest.raises(ValueError, match=r"two images \[H, W, 3\]"):
        alex.distance(torch.zeros(40, 40, 3), torch.zeros(40, 41, 3))
    with pytest.raises(WeightsError, match="sgsst weights fetch vgg16"):
        Lpips(folder=tmp_path)


def test_lpips_is_skipped_without_installed_weights(vgg16_weights, tmp_path):
    assert load_lpips_or_none(folder=tmp_path) is None
    assert load_lpips_or_none() is not None
    (tmp_path / "lpips_alex.safetensors").write_bytes(b"no weights")
    with pytest.raises(WeightsError, match="damaged"):
        load_lpips_or_none(folder=tmp_path)
