"""Targets that the loss compares a view with: statistics and vectors of the style, and content features."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from sgsst_core.features.partition import PartitionTile
from sgsst_core.features.statistics import LayerStatistics
from sgsst_core.loss.tiling import Division


@dataclass(frozen=True)
class LayerTarget:
    """Target of one layer: the style's Gram matrix [c, c], mean [c] and standard deviation [c], float64."""

    gram: Tensor
    mean: Tensor
    std: Tensor

    @staticmethod
    def of(statistics: LayerStatistics) -> LayerTarget:
        """Create the target from the statistics of a style image."""
        return LayerTarget(statistics.gram(), statistics.mean, statistics.std())

    @staticmethod
    def mixed(targets: Sequence[LayerTarget], weights: Sequence[float]) -> LayerTarget:
        """Combine the targets of several images into the target of a style of all of them.

        The variance is a sum of non-negative terms, which avoids the cancellation in diag(G) - mu^2:

            G = sum_i w_i G_i,  mu = sum_i w_i mu_i,  sigma^2 = sum_i w_i (sigma_i^2 + (mu_i - mu)^2)

        Args:
            weights: Weights w_i, which need not add up to 1.
        """
        if len(targets) == 1:
            return targets[0]
        total = math.fsum(weights)
        pairs = [(target, weight / total) for target, weight in zip(targets, weights, strict=True)]
        mean = torch.stack([weight * target.mean for target, weight in pairs]).sum(dim=0)
        gram = torch.stack([weight * target.gram for target, weight in pairs]).sum(dim=0)
        variances = [weight * (target.std.square() + (target.mean - mean).square()) for target, weight in pairs]
        return LayerTarget(gram, mean, torch.stack(variances).sum(dim=0).sqrt())


@dataclass(frozen=True)
class StyleVectors:
    """Style vectors to match with the positions of a view.

    Attributes:
        units: Unit vectors [k, c], float32 or float64; 0 where the style's features are 0.
        parts: Slice of the c channels for each layer, in layer order.
        length: Scalar, largest norm of a vector before normalization.
    """

    units: Tensor
    parts: Mapping[str, slice]
    length: Tensor

    @staticmethod
    def of(features: Mapping[str, Tensor]) -> StyleVectors:
        """Create style vectors from features [k, c_l] by layer, all at the same k > 0 positions."""
        vectors = torch.cat([at_least_float32(part) for part in features.values()], dim=1)
        lengths = vectors.norm(dim=1)
        units = vectors * torch.where(lengths > 0, lengths, torch.inf).reciprocal()[:, None]
        parts, first = {}, 0
        for layer, part in features.items():
            parts[layer] = slice(first, first + part.shape[1])
            first += part.shape[1]
        return StyleVectors(units, parts, lengths.max())


def at_least_float32(values: Tensor) -> Tensor:
    """Return half-precision values in float32, and all others unchanged."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


#: Position weights [H >> k, W >> k] for each power of two 2^k; None for equal weights.
PositionWeights = Sequence[Tensor] | None


@dataclass(frozen=True)
class StyleTarget:
    """Style target of a region, or of a whole view, at one scale.

    Attributes:
        layers: Statistics by layer, for compared layers with at least one cell at this scale.
        vectors: Style vectors for nearest-neighbor matching; None if the loss matches no features.
        weight: Factor of the region's style loss.
        positions: Position weights of the region in the view that is compared.
    """

    layers: Mapping[str, LayerTarget]
    vectors: StyleVectors | None = None
    weight: float = 1.0
    positions: PositionWeights = None


#: Style targets by scale: one for each region of the scene, or a single one for whole views.
StyleTargets = dict[int, tuple[StyleTarget, ...]]


def combined(targets: Sequence[StyleTargets], weights: Sequence[float]) -> StyleTargets:
    """Combine the targets of the styles of several regions, and the factors of their style losses."""
    return {
        scale: tuple(replace(own[scale][0], weight=weight) for own, weight in zip(targets, weights, strict=True))
        for scale in targets[0]
    }


def by_band(targets: StyleTargets, bands: int) -> StyleTargets:
    """Return the targets of a style whose strokes have the same size at every depth.

    Each scale is compared in its own depth band alone; the coarsest one also in the bands of scales that the view does
    not have.
    """
    coarsest = max(targets)
    return {
        scale: tuple(replace(own, weight=float(min(band, coarsest) == scale)) for band in range(bands))
        for scale, (own,) in targets.items()
    }


#: Content features [h, w, 512] of the cells owned by each partition tile of this rank.
ContentFeatures = dict[PartitionTile, Tensor]


@dataclass
class ViewTarget:
    """Targets of a view, apart from the style.

    Attributes:
        content_image: Content image [H, W, 3] from which uncached content features are computed; None if they are not
            needed.
        coverage: Position weights [H >> k, W >> k] for each power of two 2^k; None for equal weights.
        division: Division of work for which the content was prepared; None to divide the work in every evaluation.
        regions: Position weights of each region (its fraction of the blend weights), in the format of `coverage` and
            the order of the style targets. None if the scene has no regions.
        content_weights: Content weight of each position relative to the loss's, in 0..1 and the format of `coverage`,
            which it replaces in the content term; None for the same weight everywhere.
        background: Color of the pixels that no rank renders, because no Gaussian covers them.
    """

    content_image: Tensor | None = None
    content: dict[int, ContentFeatures] = field(default_factory=dict)
    coverage: list[Tensor] | None = None
    division: Division | None = None
    regions: list[list[Tensor]] | None = None
    content_weights: list[Tensor] | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
