"""Float64 reference of `sos.SosLoss` for tests: the SOS loss as defined in the paper, untiled, with autograd."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.constants import COARSEST_SHORTER_SIDE
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import CONTENT_LAYER, PIXEL_UNIT, PIXELS, layer_stride
from sgsst_core.loss.nearest import nearest_reference
from sgsst_core.loss.style_losses import nearest_layers, nearest_weight, statistics_layers, term_weights
from sgsst_core.loss.terms import PAPERS_WEIGHTS, LayerTarget, TermWeights
from sgsst_core.scene.luminance import WEIGHTS as LUMINANCE_WEIGHTS
from sgsst_core.scene.pyramid import scale_count
from sgsst_core.settings import StyleLossName


@dataclass(frozen=True)
class RegionReference:
    """Region of a view.

    Attributes:
        style: Style image [H', W', 3].
        share: Position weights [H, W], the region's fraction of the blend weights; None for equal weights.
        weight: Weight of the region's style loss.
    """

    style: Tensor
    share: Tensor | None
    weight: float = 1.0


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
    found = _statistics(features, position_weights)
    loss = weights.gram / features.shape[-1] ** 2 * (found.gram - target.gram).square().mean()
    loss = loss + weights.mean * (found.mean - target.mean).square().mean()
    return loss + weights.std * (found.std - target.std).square().mean()


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


def sos_reference(
    network_weights: BackboneWeights,
    image: Tensor,
    style: Tensor | Sequence[RegionReference],
    content: Tensor | None = None,
    *,
    content_weight: float = 1.0,
    coverage: Tensor | None = None,
    style_loss: StyleLossName = "sos",
    coarsest: int = COARSEST_SHORTER_SIDE,
    scales: Sequence[float] = (),
) -> tuple[float, Tensor]:
    """Compute E and dE/dimage [H, W, 3] in float64.

    Args:
        network_weights: Weights of the feature network.
        image: [H, W, 3] in 0..1.
        style: [H', W', 3], already resized (`pyramid.style_size`), or one reference per region.
        content: [H, W, 3] in 0..1; None for no content term.
        content_weight: lambda_c.
        coverage: [H, W] position weights; None for equal weights.
        style_loss: Style loss; see `style_losses`. If it matches features, the style may have at most
            `nearest.MOST_VECTORS` positions.
        coarsest: Maximum shorter side of the coarsest scale in pixels.
        scales: Weight of each scale from full size downwards; empty for equal weights.
    """
    parts = [RegionReference(style, coverage)] if isinstance(style, Tensor) else style
    x = image.double().clone().requires_grad_()
    total = torch.zeros((), dtype=torch.float64)
    count = scale_count(image.shape[0], image.shape[1], coarsest)
    factors = [1.0] * count if not scales else [*scales, *[0.0] * count][:count]
    for scale, factor in enumerate(factors):
        loss = torch.zeros((), dtype=torch.float64)
        side = 1 << scale
        features = features_reference(network_weights, box_average_reference(x, side))
        for part in parts:
            loss = loss + part.weight * _part_reference(network_weights, features, part, side, style_loss)
        if content is not None and content_weight:
            difference = features[CONTENT_LAYER] - _content_reference(network_weights, content, side)
            position = _cells(coverage, side * layer_stride(CONTENT_LAYER))
            a = torch.ones(difference.shape[:2], dtype=torch.float64) if position is None else position
            loss = loss + content_weight * (a[:, :, None] * difference**2).sum() / (a.sum() * difference.shape[-1])
        total = total + factor * loss
    loss = total / sum(factors)
    (gradient,) = torch.autograd.grad(loss, x)
    return loss.item(), gradient


def _part_reference(
    network_weights: BackboneWeights,
    features: Mapping[str, Tensor],
    part: RegionReference,
    side: int,
    style_loss: StyleLossName,
) -> Tensor:
    """Return the style terms of a region at one scale, given the view's features at that scale.

    A pixel of the scale is the average of side x side full-size pixels.
    """
    wanted = features_reference(network_weights, box_average_reference(part.style.double(), side))
    loss = torch.zeros((), dtype=torch.float64)
    for layer in statistics_layers(style_loss, network_weights):
        position = _cells(part.share, side * layer_stride(layer))
        weights = term_weights(layer, network_weights.scales.get(PIXELS, 1.0) ** 2)
        loss = loss + style_loss_reference(features[layer], _statistics(wanted[layer]), position, weights=weights)
    if matched := nearest_layers(style_loss, network_weights.name):
        position = _cells(part.share, side * layer_stride(matched[0]))
        own, other = ([found[layer] for layer in matched] for found in (features, wanted))
        weight = nearest_weight(style_loss, network_weights.scales.get(CONTENT_LAYER, 1.0))
        loss = loss + weight * nearest_reference(own, other, position)
    return loss


def _content_reference(network_weights: BackboneWeights, content: Tensor, side: int) -> Tensor:
    return features_reference(network_weights, box_average_reference(content.double(), side))[CONTENT_LAYER].detach()


def _cells(coverage: Tensor | None, side: int) -> Tensor | None:
    return None if coverage is None else box_average_reference(coverage.double()[:, :, None], side)[:, :, 0]
