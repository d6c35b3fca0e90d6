"""How large a network's features are, and factors that change it layer by layer.

Of a layer whose features are s times as large, the loss of the Gram matrix is s^4 times as large, those of mean,
standard deviation and content s^2 times: how much each layer and each term counts follows from the size of features.
The paper's network is the original VGG19 (`vgg_conv.pth` of Gatys et al.); torchvision's networks were trained anew,
and their layers are of other sizes. A network of ReLUs is positively homogeneous: its weights times the ratio of two
layers' factors, and its biases times the layer's own, give the same features times these factors.

A factor of `PIXELS` also has the pixels themselves compared, which the paper does not do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from sgsst_core.features.network_sources import CAFFE_MEAN
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import PIXELS, FeatureNetwork
from sgsst_core.paintings import STARRY_NIGHT
from sgsst_core.settings import FeatureScale, Settings

#: Of every layer but the first, `even`: Gram matrix, mean and standard deviation then count about alike at the start.
EVEN_SCALE = 8.0
#: Of the first layer, `even`. It alone knows colors as such, and with the others' factor its share of the loss is less
#: than a hundredth: palettes came out better with this one, and styles no worse (docs/quality.md).
EVEN_COLOR_SCALE = 16.0
#: Of the pixels, `even`. Colors that begin as the style's would be given up for strokes: with this factor palettes
#: came out nearer by 3 to 16 levels on six pairs, for up to 0.02 of style (docs/quality.md).
EVEN_PIXEL_SCALE = 28.0
#: What the original VGG19 logs in the first iteration of a published run (installation guide of J. Johnson,
#: "neural-style", its default pictures at 512 pixels), divided by the run's weights of 100 and 5. The run starts from
#: noise that is nothing to the network. Style layers: the mean squared difference of Gram / (c h w) from a painting's;
#: the content layer: that of the features from a photograph's.
PUBLISHED = {
    "relu1_1": 300.2129,
    "relu2_1": 7003.4956,
    "relu3_1": 1530.3320,
    "relu4_1": 124046.3516,
    "relu4_2": 418235.7188,
    "relu5_1": 6.568603,
}
_CONTENT = "relu4_2"
#: Longer side of the pictures of that run.
_SIDE = 512


def at_scale(weights: BackboneWeights, scale: FeatureScale) -> BackboneWeights:
    """The same network with features of a scale; those that have been scaled already stay as they are.

    `vgg_conv.pth` is the paper's network itself and stays as it is with either.
    """
    if weights.scales or is_original(weights):
        return weights
    return with_scales(weights, paper_scales(weights) if scale == "paper" else even_scales(weights))


def weights_for(weights: BackboneWeights, settings: Settings) -> BackboneWeights:
    """The network as a job with these settings uses it: at its scale, and shown luminance alone where colors stay."""
    scaled = at_scale(weights, settings.feature_scale)
    return replace(scaled, gray=True) if settings.preserve_colors == "luminance" else scaled


def even_scales(weights: BackboneWeights) -> dict[str, float]:
    """Factors of layers, `even`: of features powers of two, so that they change by them and by no rounding."""
    layers = [layer.replace("conv", "relu") for layer in weights.convolutions]
    return {**dict.fromkeys(layers, EVEN_SCALE), layers[0]: EVEN_COLOR_SCALE, PIXELS: EVEN_PIXEL_SCALE}


def is_original(weights: BackboneWeights) -> bool:
    """Whether they are those of the original network, which takes colors of 0 to 255 as they are."""
    return bool((weights.input_scale == 255).all())


def paper_scales(weights: BackboneWeights, picture: Path = STARRY_NIGHT) -> dict[str, float]:
    """Factors of layers that give a picture, The Starry Night unless told otherwise, the published statistics.

    To two digits: rounding does not show. The painting of the published run is another one; two others give factors
    within 25 % of this one's (docs/quality.md).
    """
    with Image.open(picture) as painting:
        size = [round(side * _SIDE / max(painting.size)) for side in painting.size]
        small = painting.convert("RGB").resize((size[0], size[1]), Image.Resampling.LANCZOS)
    pixels = torch.from_numpy(np.array(small, dtype=np.float32)) / 255
    nothing = (torch.tensor(CAFFE_MEAN) / 255).expand(pixels.shape)
    found, of_nothing = _features(weights, pixels), _features(weights, nothing)
    scales = {}
    for layer, published in PUBLISHED.items():
        if layer == _CONTENT:
            factor = (published / float((found[layer] - of_nothing[layer]).square().mean())) ** (1 / 2)
        else:
            difference = _gram(found[layer]) - _gram(of_nothing[layer])
            factor = (published / float(difference.square().mean())) ** (1 / 4)
        scales[layer] = float(f"{factor:.2g}")
    return scales


def with_scales(weights: BackboneWeights, scales: Mapping[str, float]) -> BackboneWeights:
    """A network whose features of some layers are so many times as large; other layers have the factor before them.

    `PIXELS` have none before them, and are compared where they are given one.
    """
    convolutions: dict[str, tuple[Tensor, Tensor]] = {}
    before = 1.0
    for layer, (weight, bias) in weights.convolutions.items():
        factor = scales.get(layer.replace("conv", "relu"), before)
        convolutions[layer] = (weight.double() * (factor / before)).float(), (bias.double() * factor).float()
        before = factor
    return replace(weights, convolutions=convolutions, scales=dict(scales))


def _features(weights: BackboneWeights, picture: Tensor) -> dict[str, Tensor]:
    """Features [h, w, c] of the published layers, of a picture [H, W, 3]."""
    network = FeatureNetwork(weights, tuple(PUBLISHED), torch.float32)
    return network.forward(picture, keep=False).features


def _gram(features: Tensor) -> Tensor:
    """Gram matrix / (h w c) of features [h, w, c], float64."""
    values = features.flatten(0, 1).double()
    return values.T @ values / values.numel()
