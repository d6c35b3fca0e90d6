"""Float64 reference of `loss.sos.SosLoss`: the loss and all its terms by their definition, untiled, with autograd."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.constants import COARSEST_SHORTER_SIDE
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.statistics import LayerStatistics
from sgsst_core.features.vgg import CONTENT_LAYER, PIXEL_UNIT, PIXELS, layer_stride
from sgsst_core.loss.terms import (
    PAPERS_WEIGHTS,
    LayerTarget,
    StyleGradient,
    TermWeights,
    nearest_layers,
    nearest_weight,
    statistics_layers,
    term_weights,
)
from sgsst_core.scales import scale_count
from sgsst_core.scene.colors import WEIGHTS as LUMINANCE_WEIGHTS
from sgsst_core.settings import StyleLossName


def layer_statistics_reference(features: Tensor, position_weights: Tensor | None = None) -> LayerStatistics:
    """Compute the statistics from their definition in float64, unblocked; reference of `layer_statistics`."""
    flat = features.double().reshape(-1, features.shape[-1])
    equal = torch.ones(flat.shape[0], dtype=torch.float64)
    a = equal if position_weights is None else position_weights.double().reshape(-1)
    count = a.sum()
    mean = (a[:, None] * flat).sum(0) / count
    centered = (flat - mean) * a[:, None].sqrt()
    return LayerStatistics(count, mean, centered.T @ centered)


def applied(gradient: StyleGradient, features: Tensor, position_weights: Tensor | None = None) -> Tensor:
    """Return dE/dfeatures [h, w, c] for features [h, w, c] and position weights [h, w]."""
    result = torch.zeros(features.shape, dtype=features.dtype, device=features.device)
    gradient.add_to(result, features, position_weights)
    return result


@dataclass(frozen=True)
class StyledWeights:
    """Region of a view.

    Attributes:
        style: Style image [H', W', 3].
        weights: Position weights [H, W], the region's fraction of the blend weights; None for equal weights.
        factor: Weight of the region's style loss.
    """

    style: Tensor
    weights: Tensor | None
    factor: float = 1.0


def features_reference(network_weights: BackboneWeights, rgb: Tensor) -> dict[str, Tensor]:
    """Compute float64 features [h, w, c] by layer from rgb [H, W, 3] in 0..1; differentiable."""
    rgb = rgb.double()
    if network_weights.gray:
        rgb = (rgb @ torch.tensor(LUMINANCE_WEIGHTS, dtype=torch.float64))[..., None].expand(rgb.shape)
    features = {PIXELS: rgb * PIXEL_UNIT}
    x = rgb * network_weights.input_scale.double() + network_weights.input_shift.double()
    x = x.permute(2, 0, 1).unsqueeze(0)
    block = 1
    for name, (weight, bias) in network_weights.convolutions.items():
        if int(name[4]) > block:
            block += 1
            x = F.max_pool2d(x, 2)
        x = F.conv2d(x, weight.double(), bias.double(), padding=1).relu()
        features["relu" + name[4:]] = x[0].permute(1, 2, 0)
        if name == "conv5_1":
            break
    return features


def box_average_reference(image: Tensor, side: int) -> Tensor:
    """Box-average [H, W, c] over blocks of side x side."""
    return F.avg_pool2d(image.permute(2, 0, 1).unsqueeze(0), side)[0].permute(1, 2, 0)


def style_loss_reference(
    features: Tensor,
    target: LayerTarget,
    position_weights: Tensor | None = None,
    *,
    weights: TermWeights = PAPERS_WEIGHTS,
) -> Tensor:
    """Compute the style loss of one layer from its definition; reference of `terms.style_loss`.

    The computation is in float64 and differentiable.

    Args:
        features: [h, w, c].
        target: Statistics of the style.
        position_weights: [h, w]; None for equal weights.
        weights: Weights of the terms.
    """
    own = _statistics(features, position_weights)
    loss = weights.gram / features.shape[-1] ** 2 * (own.gram - target.gram).square().mean()
    loss = loss + weights.mean * (own.mean - target.mean).square().mean()
    return loss + weights.std * (own.std - target.std).square().mean()


def _statistics(features: Tensor, position_weights: Tensor | None = None) -> LayerTarget:
    flat = features.double().reshape(-1, features.shape[-1])
    equal = torch.ones(flat.shape[0], dtype=torch.float64)
    a = equal if position_weights is None else position_weights.reshape(-1).double()
    mean = (a[:, None] * flat).sum(0) / a.sum()
    gram = (a[:, None] * flat).T @ flat / a.sum()
    variance = (a[:, None] * (flat - mean) ** 2).sum(0) / a.sum()
    # The derivative of the square root is infinite at 0 (a dead channel) and huge at the rounding error of a constant
    # channel. Such channels are excluded, as in `terms.style_loss`.
    alive = variance > (1e-12 * mean).square()
    return LayerTarget(gram, mean, torch.where(alive, variance, 1.0).sqrt() * alive)


def nearest_reference(features: Sequence[Tensor], style: Sequence[Tensor], weights: Tensor | None = None) -> Tensor:
    """Compute the mean distance to the nearest style vector from its definition.

    The computation is in float64, unblocked and differentiable.

    Args:
        features: Features of each layer, [h, w, c_l]. The feature vector of a position must not be 0.
        style: Style features of each layer, [h', w', c_l]. The feature vector of a position must not be 0.
        weights: [h, w]; None for equal weights.
    """
    own, other = (torch.cat([part.double() for part in parts], dim=2).flatten(0, 1) for parts in (features, style))
    cosine = (own / own.norm(dim=1, keepdim=True)) @ (other / other.norm(dim=1, keepdim=True)).T
    distance = 1 - cosine.max(dim=1).values
    a = torch.ones_like(distance) if weights is None else weights.double().flatten()
    result: Tensor = (a * distance).sum() / a.sum()
    return result


def sos_reference(
    network_weights: BackboneWeights,
    image: Tensor,
    style: Tensor | Sequence[StyledWeights],
    content: Tensor | None = None,
    *,
    content_weight: float = 1.0,
    coverage: Tensor | None = None,
    content_weights: Tensor | None = None,
    style_loss: StyleLossName = "sos",
    coarsest: int = COARSEST_SHORTER_SIDE,
    scales: Sequence[float] = (),
) -> tuple[float, Tensor]:
    """Compute E and dE/dimage [H, W, 3] in float64.

    Args:
        network_weights: Weights of the feature network.
        image: [H, W, 3] in 0..1.
        style: [H', W', 3], already resized (`colors.style_size`), or one reference per region.
        content: [H, W, 3] in 0..1; None for no content term.
        content_weight: lambda_c.
        coverage: [H, W] position weights; None for equal weights.
        content_weights: [H, W] position weights of the content term relative to `content_weight`; None for `coverage`.
        style_loss: Style loss; see `terms`. If it matches features, the style may have at most
            `terms.MAX_VECTORS` positions.
        coarsest: Maximum shorter side of the coarsest scale in pixels.
        scales: Weight of each scale from full size downwards; empty for equal weights.
    """
    regions = [StyledWeights(style, coverage)] if isinstance(style, Tensor) else style
    x = image.double().clone().requires_grad_()
    total = torch.zeros((), dtype=torch.float64)
    count = scale_count(image.shape[0], image.shape[1], coarsest)
    factors = [1.0] * count if not scales else [*scales, *[0.0] * count][:count]
    for scale, factor in enumerate(factors):
        side = 1 << scale
        features = features_reference(network_weights, box_average_reference(x, side))
        value = torch.zeros((), dtype=torch.float64)
        for region in regions:
            own, weights = _scaled(network_weights, region.style, side), _cells(region.weights, side)
            value = value + region.factor * _style_terms(network_weights, style_loss, features, own, weights)
        if content is not None and content_weight:
            difference = (features[CONTENT_LAYER] - _scaled(network_weights, content, side)[CONTENT_LAYER]).square()
            covered, counted = _cells(coverage, side)(CONTENT_LAYER), _cells(content_weights, side)(CONTENT_LAYER)
            a = torch.ones(difference.shape[:2], dtype=torch.float64) if covered is None else covered
            v = a if counted is None else counted
            value = value + content_weight * (v[:, :, None] * difference).sum() / (a.sum() * difference.shape[-1])
        total = total + factor * value
    loss = total / sum(factors)
    (gradient,) = torch.autograd.grad(loss, x)
    return loss.item(), gradient


def _style_terms(
    network_weights: BackboneWeights,
    style_loss: StyleLossName,
    features: Mapping[str, Tensor],
    style: Mapping[str, Tensor],
    weights: Callable[[str], Tensor | None],
) -> Tensor:
    """Return the style terms of one region at one scale, from the features of view and style by layer."""
    loss = torch.zeros((), dtype=torch.float64)
    for layer in statistics_layers(style_loss, network_weights):
        own = term_weights(layer, network_weights.scales.get(PIXELS, 1.0) ** 2)
        loss = loss + style_loss_reference(features[layer], _statistics(style[layer]), weights(layer), weights=own)
    if layers := nearest_layers(style_loss, network_weights.name):
        factor = nearest_weight(style_loss, network_weights.scales.get(CONTENT_LAYER, 1.0))
        view, vectors = ([each[layer] for layer in layers] for each in (features, style))
        loss = loss + factor * nearest_reference(view, vectors, weights(layers[0]))
    return loss


def _scaled(network_weights: BackboneWeights, image: Tensor, side: int) -> dict[str, Tensor]:
    """Return the features of an image, each pixel averaged over side x side."""
    features = features_reference(network_weights, box_average_reference(image.double(), side))
    return {layer: values.detach() for layer, values in features.items()}


def _cells(coverage: Tensor | None, side: int) -> Callable[[str], Tensor | None]:
    """Return a function that averages position weights [H, W] over a layer's cells of side x side scaled pixels."""

    def of(layer: str) -> Tensor | None:
        if coverage is None:
            return None
        return box_average_reference(coverage.double()[:, :, None], side * layer_stride(layer))[:, :, 0]

    return of
