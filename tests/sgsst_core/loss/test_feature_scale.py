from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import CONTENT_LAYER, PIXELS, STYLE_LAYERS, FeatureNetwork
from sgsst_core.loss.feature_scale import (
    EVEN_COLOR_SCALE,
    EVEN_PIXEL_SCALE,
    EVEN_SCALE,
    PUBLISHED,
    at_scale,
    paper_scales,
    with_scales,
)
from sgsst_core.paintings import STARRY_NIGHT
from sgsst_core.settings import make_settings

LAYERS = (*STYLE_LAYERS, CONTENT_LAYER)


@pytest.fixture
def renormalized(tiny_weights: BackboneWeights) -> BackboneWeights:
    """Return a network with another input normalization than the original network."""
    return replace(tiny_weights, input_scale=torch.tensor([250.0, 255.0, 260.0]))


def features(weights: BackboneWeights, image: torch.Tensor) -> dict[str, torch.Tensor]:
    network = FeatureNetwork(weights, LAYERS, torch.float64)
    return network.forward(image.double(), cache=False).features


def test_features_of_each_layer_are_scaled_by_its_factor(tiny_weights: BackboneWeights) -> None:
    scales = dict(zip(LAYERS, (1.3, 0.25, 7.0, 3.0, 1e-3, 40.0), strict=True))
    image = torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(0))
    before, after = features(tiny_weights, image), features(with_scales(tiny_weights, scales), image)
    for layer in LAYERS:
        wanted = before[layer] * scales[layer]
        torch.testing.assert_close(after[layer], wanted, rtol=0, atol=1e-5 * float(wanted.amax()))
    assert float(before["relu5_1"].amax()) > 0


def test_paper_scales_give_the_published_statistics(renormalized: BackboneWeights) -> None:
    """Statistics agree to 22 %, because the factors have two digits."""
    with Image.open(STARRY_NIGHT) as painting:
        small = painting.resize((512, 405), Image.Resampling.LANCZOS)
    image = torch.from_numpy(np.array(small)).double() / 255
    nothing = (torch.tensor([123.68, 116.779, 103.939]) / 255).expand(image.shape)
    scaled = at_scale(renormalized, "paper")
    own_features, of_nothing = features(scaled, image), features(scaled, nothing)
    for layer in STYLE_LAYERS:
        grams = [values[layer].flatten(0, 1).T @ values[layer].flatten(0, 1) for values in (own_features, of_nothing)]
        statistic = ((grams[0] - grams[1]) / own_features[layer].numel()).square().mean()
        assert float(statistic) == pytest.approx(PUBLISHED[layer], rel=0.25)
    difference = (own_features[CONTENT_LAYER] - of_nothing[CONTENT_LAYER]).square().mean()
    assert float(difference) == pytest.approx(PUBLISHED[CONTENT_LAYER], rel=0.12)


@pytest.mark.slow
def test_torchvision_vgg16_has_the_expected_scales(vgg16_weights: BackboneWeights) -> None:
    wanted = {"relu1_1": 1.2, "relu2_1": 1.5, "relu3_1": 0.91, "relu4_1": 4.9, "relu4_2": 4.4, "relu5_1": 0.75}
    assert paper_scales(vgg16_weights) == pytest.approx(wanted, rel=0.02)


def test_even_scales_differ_only_in_the_color_layers(renormalized: BackboneWeights) -> None:
    scaled = at_scale(renormalized, "even")
    assert scaled.scales["relu1_1"] == EVEN_COLOR_SCALE
    assert scaled.scales[PIXELS] == EVEN_PIXEL_SCALE
    assert {factor for layer, factor in scaled.scales.items() if layer not in ("relu1_1", PIXELS)} == {EVEN_SCALE}
    image = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(1))
    before, after = features(renormalized, image), features(scaled, image)
    for layer in LAYERS:  # exact, because factors are powers of two
        torch.testing.assert_close(after[layer], before[layer] * scaled.scales[layer], rtol=0, atol=0)


def test_papers_network_is_returned_unchanged(tiny_weights: BackboneWeights) -> None:
    assert at_scale(tiny_weights, "paper") is tiny_weights
    assert at_scale(tiny_weights, "even") is tiny_weights


def test_paper_preset_uses_the_paper_scale() -> None:
    assert make_settings("paper").feature_scale == "paper"
    assert make_settings("standard").feature_scale == make_settings("preview").feature_scale == "even"
