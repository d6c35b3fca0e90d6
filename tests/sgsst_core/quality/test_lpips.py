"""Tests of LPIPS against a second implementation, values from the published code, and properties in its paper."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from skimage import data
from torch import Tensor

from sgsst_core.errors import WeightsError
from sgsst_core.features.network_weights import load_perceptual
from sgsst_core.quality.judge import MIN_SIDE, Lpips, load_lpips_or_none
from tests.sgsst_core.synthetic_images import synthetic_image

Array = NDArray[np.float64]


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


def test_prefers_a_small_warp_to_a_blur_unlike_squared_error(alex: Lpips):
    """In figure 1 of the paper, people prefer the warped patch, whereas L2 and PSNR prefer the blurred one."""
    image = photo("coffee")[100:300, 150:450]
    rows, columns = torch.meshgrid(torch.linspace(-1, 1, 200), torch.linspace(-1, 1, 300), indexing="ij")
    wave = torch.stack([columns + 0.009 * torch.sin(9 * rows), rows + 0.0135 * torch.sin(7 * columns)], dim=-1)
    planes = image.permute(2, 0, 1)[None]
    warped = F.grid_sample(planes, wave[None].double(), padding_mode="border", align_corners=True)
    warped = warped[0].permute(1, 2, 0)
    blurred = box_blurred(image, 5)
    assert (blurred - image).square().mean() < (warped - image).square().mean()
    assert alex.distance(image, warped).mean < 0.3 * alex.distance(image, blurred).mean


def test_agrees_with_a_direct_formulation_in_numpy(alex: Lpips):
    first, second = synthetic_image(47, 63, seed=5), synthetic_image(47, 63, seed=6)
    expected_mean, expected_map = lpips_directly(first.numpy(), second.numpy())
    result = alex.distance(first, second)
    assert result.mean == pytest.approx(expected_mean, rel=1e-6)
    np.testing.assert_allclose(result.map.numpy(), expected_map, rtol=1e-5, atol=1e-9)


def lpips_directly(first: Array, second: Array) -> tuple[float, Array]:
    """Compute LPIPS with AlexNet by equation 1 of the paper, with input from -1 to 1 as in the published code."""
    tensors = {name: tensor.double().numpy() for name, tensor in load_perceptual().items()}
    total, spatial = 0.0, np.zeros(first.shape[:2])
    pairs = zip(alexnet_directly(first, tensors), alexnet_directly(second, tensors), strict=True)
    for layer, (x, y) in enumerate(pairs, start=1):
        x, y = (f / (np.sqrt((f * f).sum(axis=2, keepdims=True)) + 1e-10) for f in (x, y))
        distances = ((x - y) ** 2 * tensors[f"linear{layer}.weight"]).sum(axis=2)
        total += distances.mean()
        spatial += upsampled(distances, first.shape[:2])
    return total, spatial


def alexnet_directly(rgb: Array, tensors: dict[str, Array]) -> list[Array]:
    x = (2 * rgb - 1 - np.array([-0.030, -0.088, -0.188])) / np.array([0.458, 0.448, 0.450])
    outputs = []
    for layer, (side, stride, padding) in enumerate([(11, 4, 2), (5, 1, 2), (3, 1, 1), (3, 1, 1), (3, 1, 1)], start=1):
        if layer in (2, 3):
            x = sliding_window_view(x, (3, 3), axis=(0, 1))[::2, ::2].max(axis=(3, 4))
        x = np.pad(x, ((padding, padding), (padding, padding), (0, 0)))
        windows = sliding_window_view(x, (side, side), axis=(0, 1))[::stride, ::stride]
        x = np.tensordot(windows, tensors[f"conv{layer}.weight"], axes=([2, 3, 4], [1, 2, 3]))
        x = np.maximum(x + tensors[f"conv{layer}.bias"], 0)
        outputs.append(x)
    return outputs


def upsampled(values: Array, size: tuple[int, ...]) -> Array:
    """Upsample bilinearly, with pixel centers at half-integers and replicated borders."""

    def matrix(cells: int, pixels: int) -> Array:
        positions = np.clip((np.arange(pixels) + 0.5) * cells / pixels - 0.5, 0, cells - 1)
        return np.maximum(0, 1 - np.abs(positions[:, None] - np.arange(cells)))

    return matrix(values.shape[0], size[0]) @ values @ matrix(values.shape[1], size[1]).T


def test_map_is_large_where_the_images_differ(alex: Lpips):
    image = photo("coffee")[:160, :240]
    changed = image.clone()
    changed[40:80, 150:200] = changed[40:80, 150:200].flip(0)
    spatial = alex.distance(image, changed).map
    assert spatial[40:80, 150:200].mean() > 5 * spatial[:, :80].mean()
    assert spatial.amin() >= 0


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
