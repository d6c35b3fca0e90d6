"""Per-layer scale of a network's features.

If the features of a layer are s times as large, its Gram loss is s^4 times as large, and its mean, standard deviation
and content losses are s^2 times as large. The feature scale therefore decides how much each layer and term counts. The
paper uses the original VGG19 (`vgg_conv.pth` of Gatys et al.); torchvision's networks were trained separately, and
their layers have other scales. ReLU networks are positively homogeneous: multiplying a layer's weights by the ratio of
its factor to the previous layer's, and its biases by its own factor, scales its features by exactly that factor.

A factor for `PIXELS` adds the pixels themselves to the comparison, which the paper does not do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from sgsst_core.features.network_weights import CAFFE_MEAN, BackboneWeights
from sgsst_core.features.vgg import CONTENT_LAYER, PIXELS, FeatureNetwork
from sgsst_core.settings import FeatureScale, Settings
from sgsst_core.style import STARRY_NIGHT

#: Factor of every layer except the first, for feature scale `even`. With this factor, Gram matrix, mean and standard
#: deviation contribute about equally to the loss at the start of a job.
EVEN_SCALE = 8.0
#: Factor of the first layer, for `even`. Only this layer responds to color directly. With `EVEN_SCALE`, it would
#: contribute less than 1 % of the loss. The larger factor brings colors closer to the style image without degrading the
#: match of other style features (docs/quality.md).
EVEN_COLOR_SCALE = 16.0
#: Factor of the pixels, for `even`. Without it, colors that initially match the style drift away in favor of brush
#: strokes. On six pairs of scene and style, it reduces the color distance by 3 to 16 levels of 8 bits, and degrades the
#: style measure by up to 0.02 (docs/quality.md).
EVEN_PIXEL_SCALE = 28.0
#: Losses that the original VGG19 logs in the first iteration of a published run (installation guide of J. Johnson's
#: "neural-style", default images at 512 pixels), divided by that run's weights of 100 and 5. The run starts from noise
#: to which the network hardly responds. For style layers, the loss is the mean squared difference between Gram matrices
#: / (c h w) of the noise and of a painting. For the content layer, it is the mean squared difference between features
#: of the noise and of a photo.
PUBLISHED = {
    "relu1_1": 300.2129,
    "relu2_1": 7003.4956,
    "relu3_1": 1530.3320,
    "relu4_1": 124046.3516,
    "relu4_2": 418235.7188,
    "relu5_1": 6.568603,
}
#: Longer side in pixels of the images in the published run.
_SIDE = 512


def at_scale(weights: BackboneWeights, scale: FeatureScale) -> BackboneWeights:
    """Return the network with its features scaled as requested.

    Networks that are already scaled, and `vgg_conv.pth`, which is the paper's own network and has an input range of 0
    to 255 without normalization, are returned unchanged.
    """
    if weights.scales or bool((weights.input_scale == 255).all()):
        return weights
    return with_scales(weights, paper_scales(weights) if scale == "paper" else even_scales(weights))


def weights_for(weights: BackboneWeights, settings: Settings) -> BackboneWeights:
    """Return the network for a job's settings.

    Its features are scaled to the feature scale, and its input is luminance if the job preserves chroma.
    """
    scaled = at_scale(weights, settings.feature_scale)
    return replace(scaled, gray=True) if settings.preserve_colors == "luminance" else scaled


def even_scales(weights: BackboneWeights) -> dict[str, float]:
    """Return the layer factors for feature scale `even`.

    Except for `PIXELS`, factors are powers of two, so scaling adds no rounding error.
    """
    layers = [layer.replace("conv", "relu") for layer in weights.convolutions]
    return {**dict.fromkeys(layers, EVEN_SCALE), layers[0]: EVEN_COLOR_SCALE, PIXELS: EVEN_PIXEL_SCALE}


def paper_scales(weights: BackboneWeights) -> dict[str, float]:
    """Return the layer factors with which The Starry Night produces the published losses.

    Factors are rounded to two digits, which makes no visible difference. The published run used another painting; two
    other paintings give factors within 25 % of these.
    """
    with Image.open(STARRY_NIGHT) as painting:
        size = [round(side * _SIDE / max(painting.size)) for side in painting.size]
        small = painting.convert("RGB").resize((size[0], size[1]), Image.Resampling.LANCZOS)
    pixels = torch.from_numpy(np.array(small, dtype=np.float32)) / 255
    nothing = (torch.tensor(CAFFE_MEAN) / 255).expand(pixels.shape)
    network = FeatureNetwork(weights, tuple(PUBLISHED), torch.float32)
    features, of_nothing = (network.forward(image, cache=False).features for image in (pixels, nothing))

    def gram(values: Tensor) -> Tensor:
        flat = values.flatten(0, 1).double()
        return flat.T @ flat / flat.numel()

    scales = {}
    for layer, published in PUBLISHED.items():
        if layer == CONTENT_LAYER:
            factor = (published / float((features[layer] - of_nothing[layer]).square().mean())) ** (1 / 2)
        else:
            difference = gram(features[layer]) - gram(of_nothing[layer])
            factor = (published / float(difference.square().mean())) ** (1 / 4)
        scales[layer] = float(f"{factor:.2g}")
    return scales


def with_scales(weights: BackboneWeights, scales: Mapping[str, float]) -> BackboneWeights:
    """Return the network with the features of some layers multiplied by a factor.

    A layer without a factor uses the factor of the preceding layer. `PIXELS` has no preceding layer, and is compared
    only if it has a factor of its own.
    """
    convolutions: dict[str, tuple[Tensor, Tensor]] = {}
    before = 1.0
    for layer, (weight, bias) in weights.convolutions.items():
        factor = scales.get(layer.replace("conv", "relu"), before)
        convolutions[layer] = (
            weight if factor == before else (weight.double() * (factor / before)).float(),
            (bias.double() * factor).float(),
        )
        before = factor
    return replace(weights, convolutions=convolutions, scales=dict(scales))
