"""Tests of Winograd's algorithm against convolutions in float64."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.bench.device_checks import texture
from sgsst_core.features import winograd
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import STYLE_LAYERS, FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.style import Style

#: A whole window, sides that are no multiples of it, more than one part of windows, and fewer windows than threads.
SIZES = [(4, 4), (9, 14), (61, 45), (1, 7), (18, 3)]


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def convolve(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    transformed = winograd.transform_weight(weight)
    assert transformed is not None
    image = x.float().contiguous(memory_format=torch.channels_last)
    return winograd.convolve(image, transformed, None if bias is None else bias.float())


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


def test_each_cell_reaches_its_neighbors_only() -> None:
    """A single value is convolved exactly: its window and the windows beside it."""
    weight = noise(64, 64, 3, 3, seed=1)
    for i, j in ((0, 0), (3, 4), (5, 9)):
        x = torch.zeros((1, 64, 6, 10), dtype=torch.float64)
        x[0, 7, i, j] = 1.0
        expected = F.conv2d(x, weight, padding=1)
        assert (convolve(x, weight).double() - expected).abs().max() < 3e-5 * expected.abs().max()


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
    assert not winograd.pays_off(5, 5)
    assert winograd.pays_off(4, 8)
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


def test_tiles_add_up_to_the_gradient_of_the_whole_image(vgg16_weights: BackboneWeights) -> None:
    """Windows of deep layers begin elsewhere in a tile than in the image."""
    network, image = FeatureNetwork(vgg16_weights, STYLE_LAYERS, winograd=True), texture(208, 176, seed=1)
    size, gradients = (208, 176), []
    for fraction in (4.0, 0.6):
        memory = int(fraction * 208 * 176 * network.held_bytes_per_pixel())
        loss = SosLoss(network, content_weight=0, memory=memory)
        style = loss.targets.of_style(Style.of(texture(208, 176, seed=2)), size)
        gradients.append(loss.evaluate(image, style, loss.targets.of_view(image)).image_gradient)
    whole, tiled = gradients
    assert whole is not None
    assert tiled is not None
    assert 0 < float((tiled - whole).norm() / whole.norm()) < 1e-4


def test_winograd_requires_float32(tiny_weights: BackboneWeights) -> None:
    with pytest.raises(ValueError, match="Winograd's algorithm are ways to multiply float32"):
        FeatureNetwork(tiny_weights, dtype=torch.bfloat16, winograd=True)
