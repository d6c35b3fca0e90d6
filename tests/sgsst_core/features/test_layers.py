"""Tests of the network's layers with kernels: Winograd's convolution, pooling, first convolution."""

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.features import layers as winograd
from sgsst_core.features.layers import (
    convolve_pixels,
    fused_max_pool,
    fused_max_pool_backward,
    max_pool,
    max_pool_backward,
    max_pool_backward_reference,
    pixel_gradient,
)
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from tests.sgsst_core.synthetic_images import relative_error

#: A whole window, sides that are no multiples of it, more than one part of windows, and fewer windows than threads.
SIZES = [(4, 4), (9, 14), (61, 45), (1, 7), (18, 3)]


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def convolve(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    transformed = winograd.transform_weight(weight)
    assert transformed is not None
    image = x.float().contiguous(memory_format=torch.channels_last)
    return winograd.convolve_winograd(image, transformed, None if bias is None else bias.float())


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("channels", [(64, 96), (130, 64)])
def test_convolutions_agree_with_float64(size: tuple[int, int], channels: tuple[int, int]) -> None:
    source, target = channels
    x, weight, bias = noise(1, source, *size), noise(target, source, 3, 3, seed=1), noise(target, seed=2)
    linear = F.conv2d(x, weight, padding=1)
    for result, expected in (
        (convolve(x, weight), linear),
        (convolve(x, weight, bias), torch.relu(linear + bias[:, None, None])),
    ):
        assert result.shape == expected.shape
        assert result.is_contiguous(memory_format=torch.channels_last)
        assert (result.double() - expected).abs().max() < 3e-5 * expected.abs().max()


def test_equal_values_give_equal_results() -> None:
    """Windows of one value, or equal in one direction, so that pooling chooses as after a direct convolution."""
    weight, value = noise(64, 64, 3, 3, seed=1), noise(1, 64, 1, 1, seed=2)
    inside = convolve(value.expand(1, 64, 30, 22), weight)[..., 4:24, 4:16].unflatten(2, (5, 4)).unflatten(4, (3, 4))
    assert torch.equal(inside, inside[..., :1, :, :1].expand_as(inside))
    rows = convolve(noise(1, 64, 30, 1, seed=3).expand(1, 64, 30, 22), weight)[..., 4:16].unflatten(3, (3, 4))
    assert torch.equal(rows, rows[..., :1].expand_as(rows))


def test_results_do_not_depend_on_the_threads(vgg16_weights: BackboneWeights) -> None:
    x, weight = noise(1, 128, 50, 70), noise(64, 128, 3, 3, seed=1)
    before, results = torch.get_num_threads(), []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        results.append(convolve(x, weight))
    torch.set_num_threads(before)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


@pytest.mark.parametrize("bias", [None, torch.zeros(64)])
def test_nan_and_infinity_are_not_hidden(bias: Tensor | None) -> None:
    for value in (torch.nan, torch.inf):
        x = noise(1, 64, 12, 12)
        x[0, 3, 5, 5] = value
        assert not convolve(x, noise(64, 64, 3, 3), bias)[..., 4:7, 4:7].isfinite().any()


def test_narrow_weights_and_small_images_are_convolved_directly(tiny_weights: BackboneWeights) -> None:
    assert winograd.transform_weight(noise(64, 63, 3, 3)) is None
    assert not winograd.winograd_pays_off(5, 5)
    assert winograd.winograd_pays_off(4, 8)
    image = torch.rand((40, 40, 3))
    direct, fewer = FeatureNetwork(tiny_weights), FeatureNetwork(tiny_weights, winograd=True)
    for layer, features in direct.forward(image).features.items():
        assert torch.equal(fewer.forward(image).features[layer], features)


@pytest.mark.parametrize("size", [(48, 64), (75, 53)])
def test_features_and_gradients_are_as_accurate_as_direct_ones(
    vgg16_weights: BackboneWeights, size: tuple[int, int]
) -> None:
    """Most of the error of either comes from ReLU and max-pool decisions that flip under rounding."""
    image = torch.rand((*size, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    slopes: dict[str, Tensor] = {}

    def add(layer: str, features: Tensor, gradient: Tensor) -> None:
        slopes.setdefault(layer, torch.randn(features.shape, generator=torch.Generator().manual_seed(1)))
        gradient += slopes[layer].to(gradient)

    def of(network: FeatureNetwork) -> tuple[dict[str, Tensor], Tensor]:
        activations = network.forward(image)
        return dict(activations.features), network.backward(activations, add)

    exact, exact_gradient = of(FeatureNetwork(vgg16_weights, dtype=torch.float64))
    errors: list[Any] = []
    for network in (FeatureNetwork(vgg16_weights), FeatureNetwork(vgg16_weights, winograd=True)):
        features, gradient = of(network)
        every = [float((features[name] - exact[name]).norm() / exact[name].norm()) for name in exact]
        errors.append((max(every), float((gradient - exact_gradient).norm() / exact_gradient.norm())))
    (_, direct), (features_error, fewer) = errors
    assert features_error < 5e-6
    assert 0 < fewer < max(4 * direct, 1e-4)


def test_winograd_requires_float32(tiny_weights: BackboneWeights) -> None:
    with pytest.raises(ValueError, match="Winograd's algorithm are ways to multiply float32"):
        FeatureNetwork(tiny_weights, dtype=torch.bfloat16, winograd=True)


DTYPES = [torch.float32, torch.float64, torch.bfloat16]
#: Even and odd sides, a single window, and less than one window.
POOLED_SIZES = [(12, 10), (13, 11), (2, 2), (3, 2), (1, 5)]


def relu_output(height: int, width: int, dtype: torch.dtype, *, levels: int = 0) -> Tensor:
    """Return a synthetic ReLU output [1, 24, h, w] with memory format channels_last.

    If `levels` is not 0, values are multiplied by it and rounded to integers. If it is small, most pooling windows
    have ties, and some are all zero.
    """
    values = torch.randn((1, height, width, 24), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    if levels:
        values = (values * levels).round()
    return values.to(dtype).permute(0, 3, 1, 2).relu_()


@pytest.mark.parametrize("size", POOLED_SIZES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("levels", [0, 1])
def test_max_pool_and_backward_pass_match_pytorch(size: tuple[int, int], dtype: torch.dtype, levels: int) -> None:
    source = relu_output(*size, dtype, levels=levels)
    pooled = max_pool(source)
    assert pooled.shape[2:] == (size[0] // 2, size[1] // 2)
    assert pooled.is_contiguous(memory_format=torch.channels_last)
    if not pooled.numel():
        return
    assert torch.equal(pooled, torch.nn.functional.max_pool2d(source, 2))
    gradient = torch.randn(pooled.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64).to(dtype)
    gradient = gradient.contiguous(memory_format=torch.channels_last)
    result = max_pool_backward(gradient, source)
    assert result.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(result, max_pool_backward_reference(gradient, source))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_nan_is_the_maximum(dtype: torch.dtype, sign: float) -> None:
    """NaN of either sign must propagate through max pooling."""
    source = relu_output(2, 2, dtype)
    source[0, 5, 1, 0] = torch.copysign(torch.tensor(torch.nan, dtype=dtype), torch.tensor(sign, dtype=dtype))
    assert bool(torch.signbit(source[0, 5, 1, 0])) == (sign < 0)
    assert max_pool(source)[0, 5].isnan().all()
    assert int(max_pool(source).isnan().sum()) == 1


pytest.importorskip("triton")
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
pytestmark = [pytest.mark.gpu] if DEVICE == "cuda" else []
SCALE, SHIFT = torch.tensor([1.0, 2.0, -3.0]), torch.tensor([-0.5, 0.4, 0.3])


def random(*shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(len(shape))).bfloat16()


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("size", [(12, 10), (13, 11), (1, 5)])
def test_pooling_kernels_match_the_reference(size: tuple[int, int], dtype: torch.dtype) -> None:
    source = relu_output(*size, dtype, levels=1).to(DEVICE)
    pooled = fused_max_pool(source)
    assert torch.equal(pooled, max_pool(source.cpu()).to(DEVICE))
    assert pooled.is_contiguous(memory_format=torch.channels_last)
    gradient = torch.randn(pooled.shape, generator=torch.Generator().manual_seed(4)).to(DEVICE, dtype)
    actual = fused_max_pool_backward(gradient.contiguous(memory_format=torch.channels_last), source)
    assert actual.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(actual.cpu(), max_pool_backward(gradient.cpu(), source.cpu()))


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
