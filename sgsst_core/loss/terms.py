"""Terms of the loss of one scale, their targets, and the layers of the feature network that they read.

The style loss `sos` is the paper's: Gram matrices, means and standard deviations of `STYLE_LAYERS`. `nnfm` replaces
them with the nearest-neighbor term; `mixed` uses both. If the weights have a factor for `PIXELS` (`feature_scale`), the
mean and standard deviation of the pixels are compared too. Every scale has the same terms.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import NamedTuple, Self

import torch
from torch import Tensor

from sgsst_core.devices import Timer, on_device
from sgsst_core.features.network_weights import BLOCKS, KAPPA, BackboneWeights
from sgsst_core.features.partition import PartitionTile, Rectangle
from sgsst_core.features.statistics import (
    TILE,
    LayerStatistics,
    block_of_channels,
    block_of_entries,
    blocks_of,
    can_be_fused,
    center,
    has_kernels,
    layer_statistics,
    row_cells,
)
from sgsst_core.features.vgg import CONTENT_LAYER, PIXELS, STYLE_LAYERS, FeatureNetwork
from sgsst_core.parallel import Division, PositionWeights, ScaledView
from sgsst_core.settings import StyleLossName


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


#: Content features [h, w, 512] of the cells owned by each partition tile of this rank.
ContentFeatures = dict[PartitionTile, Tensor]


@dataclass
class ViewTarget:
    """Targets of a view, apart from the style.

    Attributes:
        content: Content features of each scale; empty without a content term.
        coverage: Position weights [H >> k, W >> k] for each power of two 2^k; None for equal weights.
        division: Division of work for which the content was prepared; None to divide the work in every evaluation.
        regions: Position weights of each region (its fraction of the blend weights), in the format of `coverage` and
            the order of the style targets. None if the scene has no regions.
        content_weights: Content weight of each position relative to the loss's, in 0..1 and the format of `coverage`,
            which it replaces in the content term; None for the same weight everywhere.
        background: Color of the pixels that no rank renders, because no Gaussian covers them.
    """

    content: dict[int, ContentFeatures] = field(default_factory=dict)
    coverage: list[Tensor] | None = None
    division: Division | None = None
    regions: list[list[Tensor]] | None = None
    content_weights: list[Tensor] | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LossTerms:
    """Loss of one scale, split into its terms; the fields are the names in `TERMS`, in the same order."""

    gram: float = 0.0
    mean: float = 0.0
    std: float = 0.0
    content: float = 0.0
    nearest: float = 0.0

    @property
    def total(self) -> float:
        """Sum of all terms, the loss to minimize."""
        # `sum` rounds differently from Python 3.12 on, so results would depend on the interpreter.
        return float(reduce(operator.add, vars(self).values()))

    def __getitem__(self, name: str) -> float:
        return float(vars(self)[name])

    def __add__(self, other: LossTerms) -> LossTerms:
        return LossTerms(*(value + other[name] for name, value in vars(self).items()))

    def __mul__(self, factor: float) -> LossTerms:
        return LossTerms(*(value * factor for value in vars(self).values()))

    def __truediv__(self, count: int) -> LossTerms:
        """Divide every term by a count, which turns a sum into a mean."""
        return LossTerms(*(value / count for value in vars(self).values()))


#: Names of the terms of the statistics in files and reports.
STATISTICS_TERMS = ("gram", "mean", "std")


#: Numerator of w_G = GRAM_WEIGHT / c^2.
GRAM_WEIGHT = 1e3


#: w_m.
MEAN_WEIGHT = 1e4


#: w_s.
STD_WEIGHT = 1e4


#: Factor of the matrix of a `SplitGradient`: in float16, large views have entries below its normal numbers.
SPLIT_UNITS = {torch.bfloat16: 1.0, torch.float16: 2.0**10}


#: Positions per program of the gradient kernel.
POSITIONS = 64


#: Channels per step of that kernel, by bytes per feature. More would cause register spilling.
STEPS = {2: 64, 4: 32}


class TermWeights(NamedTuple):
    """Weights c^2 w_G, w_m and w_s of the terms of a layer."""

    gram: float = GRAM_WEIGHT
    mean: float = MEAN_WEIGHT
    std: float = STD_WEIGHT


#: Weights of the SGSST paper.
PAPERS_WEIGHTS = TermWeights()


# --- statistics of layers --------------------------------------------------------------------------------------------


def has_statistics(style_loss: StyleLossName) -> bool:
    """Return whether a loss compares Gram matrices, means and standard deviations."""
    return style_loss != "nnfm"


def statistics_layers(style_loss: StyleLossName, weights: BackboneWeights) -> tuple[str, ...]:
    """Return the layers whose statistics a loss compares; empty if it compares none."""
    if not has_statistics(style_loss):
        return ()
    return (PIXELS, *STYLE_LAYERS) if PIXELS in weights.scales else STYLE_LAYERS


def compared_layers(style_loss: StyleLossName, network: FeatureNetwork) -> list[str]:
    """Return the reported layers of a network whose statistics a loss compares."""
    return [layer for layer in (PIXELS, *STYLE_LAYERS) if layer in network.layers] if has_statistics(style_loss) else []


def term_weights(
    layer: str, pixel_weight: float, *, feature_unit: float = 1.0, loss_factor: float = 1.0
) -> TermWeights:
    """Return the weights of a layer's terms.

    They are the paper's weights, except that `PIXELS` has no Gram term, and its other terms are multiplied by
    `pixel_weight`.

    Args:
        feature_unit: See `FeatureNetwork`.
        loss_factor: See `FeatureNetwork`.
    """
    square = pixel_weight if layer == PIXELS else feature_unit**2
    gram = 0.0 if layer == PIXELS else GRAM_WEIGHT * square**2 * loss_factor
    return TermWeights(gram, MEAN_WEIGHT * square * loss_factor, STD_WEIGHT * square * loss_factor)


class SplitGradient(NamedTuple):
    """`StyleGradient` for 16-bit features on a GPU: dE/dF_p = a_p ((high + low) F_p / unit + constant).

    The two matrices together hold 16 bits of each entry, or 22 in float16. After cancellation with the constant, the
    error of the product is less than that of rounded features.
    """

    high: Tensor  # [c, c] bfloat16 or float16
    low: Tensor  # [c, c] in the same dtype
    constant: Tensor  # [c] float32


@dataclass(frozen=True)
class StyleGradient:
    """dE/dF of one layer as an affine map of centered features: dE/dF_p = a_p (matrix (F_p - mean) + offset).

    The map acts on centered features because at mean-to-sigma ratios of 1e4, matrix @ F and a separate offset would
    cancel down to their last digits in float32. Tensors are float64, or float32 if GPU kernels computed them; float32
    features are multiplied in float32 in either case. GPU kernels also compute the map as a `SplitGradient`.
    """

    matrix: Tensor  # [c, c]
    mean: Tensor  # [c]
    offset: Tensor  # [c]
    split: SplitGradient | None = None

    def times(self, factor: float) -> StyleGradient:
        """Return the gradient of the loss times a factor."""
        return StyleGradient(self.matrix * factor, self.mean, self.offset * factor)

    def about_rounded_mean(self) -> StyleGradient:
        """Return the same map about the mean rounded to float32, with the rounding error moved into the offset.

        `add_to` subtracts the mean in the precision of the features. If the features differ by less than the rounding
        error of their mean, as in an image of a single color, that error would dominate the result.
        """
        mean = self.mean.float().double()
        return StyleGradient(self.matrix, mean, self.offset + self.matrix @ (mean - self.mean))

    def about_zero(self, dtype: torch.dtype) -> SplitGradient:
        """Return the same map for 16-bit features."""
        matrix = self.matrix * SPLIT_UNITS[dtype]
        high = matrix.to(dtype)
        low = (matrix - high).to(dtype)
        constant = self.offset - (high.double() + low.double()) @ self.mean.double() / SPLIT_UNITS[dtype]
        return SplitGradient(high, low, constant.float())

    def add_to(
        self, gradient: Tensor, features: Tensor, position_weights: Tensor | None = None, *, relu: bool = False
    ) -> bool:
        """Add dE/dfeatures to a gradient [h, w, c] in place.

        The computation runs in blocks, so no tensor as large as the features is allocated.

        Args:
            features: [h, w, c].
            position_weights: [h, w]; None for equal weights.
            relu: Whether the gradient may be passed through the ReLU whose outputs the features are.

        Returns:
            Whether it was: GPU kernels do this at no cost, because they read the features anyway.
        """
        if can_be_fused(features) and can_be_fused(gradient) and self.matrix.dtype == torch.float32:
            fused_add_style_gradient(gradient, features, self, position_weights, relu=relu)
            return relu
        precision = torch.promote_types(features.dtype, torch.float32)
        matrix, mean, offset = (t.to(features.device, precision) for t in (self.matrix, self.mean, self.offset))
        for rows, block in blocks_of(features):
            centered, target = center(features[rows], mean, block).view(-1, len(mean)), gradient[rows]
            weights = centered.new_ones(1) if position_weights is None else position_weights[rows].reshape(-1)
            weights = weights.to(precision).expand(len(centered))
            if position_weights is not None:
                centered *= weights[:, None]
            if target.dtype == precision and target.is_contiguous():
                target.view(centered.shape).addmm_(centered, matrix).addr_(weights, offset)
            else:
                target += torch.addr(centered @ matrix, weights, offset).view(target.shape)
        return False


def style_loss(
    statistics: LayerStatistics,
    target: LayerTarget,
    *,
    feature_eps: float = 2.0**-23,
    weights: TermWeights = PAPERS_WEIGHTS,
    dtype: torch.dtype = torch.float32,
) -> tuple[Tensor, StyleGradient]:
    """Compute the style loss of one layer and its gradient with respect to the features.

    A channel counts as constant if its sigma is 0 or within the rounding error of its mean. In the gradient, its factor
    (F - mu)/sigma is then set to 0, so the gradient is finite; the loss still contains the sigma term. If there are no
    positions, loss and gradient are 0.

    Args:
        feature_eps: Relative rounding error of the features (2^-23 for float32, 2^-52 for float64).

    Returns:
        Contribution of the layer to each of `STATISTICS_TERMS`, [3] float64, and the gradient.
    """
    channels = statistics.mean.shape[0]
    if has_kernels(statistics.mean.device, channels) and feature_eps > torch.finfo(torch.float64).eps:
        return fused_style_loss(statistics, (target.gram, target.mean, target.std), weights, feature_eps, dtype)
    some = statistics.count > 0
    gram_error = statistics.gram() - target.gram
    mean_error = statistics.mean - target.mean
    std = statistics.std()
    std_error = std - target.std
    gram_weight = weights.gram / channels**2
    terms = torch.stack(
        [
            gram_weight * gram_error.square().mean(),
            weights.mean * mean_error.square().mean(),
            weights.std * std_error.square().mean(),
        ]
    )
    matrix = (4 * gram_weight / channels**2) * gram_error
    offset = matrix @ statistics.mean + (2 * weights.mean / channels) * mean_error
    alive = std > feature_eps * statistics.mean.abs()
    slope = torch.where(alive, std_error / torch.where(alive, std, 1.0), 0.0)
    matrix = matrix + torch.diag((2 * weights.std / channels) * slope)
    count = torch.where(some, statistics.count, torch.inf)
    return torch.where(some, terms, 0.0), StyleGradient(matrix / count, statistics.mean, offset / count)


class StatisticsTerms:
    """Style terms of one scale: Gram matrix, mean and standard deviation of features, with a closed-form gradient.

    E_style = sum over layers of w_G mean((G - G_v)^2) + w_m mean((mu - mu_v)^2) + w_s mean((sigma - sigma_v)^2)

    with w_G = 1e3 / c^2 and w_m = w_s = 1e4 (SGSST, CVPR 2025). Means are over the entries of each matrix or vector. If
    there are position weights a_p, the statistics G, mu and sigma are weighted by them, and n is their sum instead of
    the number of positions. There is no gradient before the statistics of the whole scale are compared.
    """

    def __init__(
        self, view: ScaledView, network: FeatureNetwork, regions: Sequence[StyleTarget], layers: Sequence[str]
    ) -> None:
        self._view, self._network, self._regions, self._layers = view, network, regions, layers
        #: Gradients by layer, with the regions that they apply to.
        self._gradients: dict[str, list[tuple[StyleGradient, StyleTarget]]] = {}

    def zero(self) -> list[LayerStatistics]:
        """Return statistics of zero pixels, to which those of tiles are added."""
        network, device = self._network, self._view.image.device
        return [LayerStatistics.zero(network.channels(layer), device) for _ in self._regions for layer in self._layers]

    def statistics(self, tile: PartitionTile, features: Mapping[str, Tensor]) -> list[LayerStatistics]:
        """Return the statistics of the cells that a tile owns, ordered by region and then by layer."""
        statistics = []
        for region in self._regions:
            for layer in self._layers:
                in_view, in_tile = tile.owned_cells(layer, self._view.size)
                owned, weights = features[layer][in_tile.slices], self._view.weights(layer, in_view, region.positions)
                if self._is_nowhere(weights):
                    statistics.append(LayerStatistics.zero(owned.shape[-1], owned.device))
                else:
                    statistics.append(layer_statistics(owned, weights))
        return statistics

    def compare(self, statistics: Sequence[LayerStatistics]) -> dict[str, Tensor]:
        """Compare the statistics of the whole scale, in the order of `statistics`, with those of the styles.

        Returns:
            Float64 scalar of each of `STATISTICS_TERMS`.
        """
        network = self._network
        total = torch.zeros(len(STATISTICS_TERMS), dtype=torch.float64, device=self._view.image.device)
        pairs = [(region, layer) for region in self._regions for layer in self._layers]
        for (region, layer), own in zip(pairs, statistics, strict=True):
            if layer not in region.layers:
                continue
            terms, gradient = style_loss(
                own,
                region.layers[layer],
                feature_eps=network.rounding_of(layer),
                weights=term_weights(
                    layer, network.pixel_weight, feature_unit=network.feature_unit, loss_factor=network.loss_factor
                ),
                dtype=network.dtype,
            )
            if layer == PIXELS and gradient.matrix.dtype == torch.float64:  # the GPU kernels already do this
                gradient = gradient.about_rounded_mean()
            if region.weight != 1:
                terms, gradient = region.weight * terms, gradient.times(region.weight)
            total = total + terms
            self._gradients.setdefault(layer, []).append((gradient, region))
        return dict(zip(STATISTICS_TERMS, total.unbind(), strict=True))

    def add_gradient(self, tile: PartitionTile, layer: str, features: Tensor, gradient: Tensor) -> bool:
        """Add the gradient with respect to a layer's features of a tile, on the cells that the tile owns, in place.

        Returns:
            Whether the gradient was also passed through the layer's ReLU.
        """
        in_view, in_tile = tile.owned_cells(layer, self._view.size)
        added, owned = gradient[in_tile.slices], features[in_tile.slices]
        relu, passed = layer != PIXELS and added.shape == gradient.shape, False
        for own, region in self._gradients.get(layer, ()):
            weights = self._view.weights(layer, in_view, region.positions)
            if not self._is_nowhere(weights):
                passed = own.add_to(added, owned, weights, relu=relu)
        return passed

    def _is_nowhere(self, weights: Tensor | None) -> bool:
        """Return whether the weights of a region in some cells are known to be all 0.

        Weights on a GPU count as unknown, because reading them would synchronize with the device.
        """
        return len(self._regions) > 1 and weights is not None and not weights.is_cuda and not bool(weights.any())


def fused_style_loss(
    statistics: LayerStatistics,
    target: tuple[Tensor, Tensor, Tensor],
    weights: tuple[float, float, float],
    feature_eps: float,
    dtype: torch.dtype = torch.bfloat16,
) -> tuple[Tensor, StyleGradient]:
    """Compute `style_loss` on a GPU.

    `target` is the style's Gram matrix, mean and standard deviation in float64. The gradient is float32.
    """
    from sgsst_core.loss import triton_kernels as kernels

    device, channels = statistics.mean.device, len(statistics.mean)
    terms = torch.empty((channels, 3), dtype=torch.float64, device=device)
    matrix = torch.empty((channels, channels), device=device)
    mean, offset, constant = torch.empty((3, channels), device=device)
    half = dtype if dtype in SPLIT_UNITS else torch.bfloat16
    high, low = torch.empty((2, channels, channels), dtype=half, device=device)
    gram_weight, mean_weight, std_weight = weights
    columns = block_of_channels(channels)
    rows = block_of_entries(channels) // columns
    with on_device(device):
        kernels.compare[(-(-channels // rows),)](
            statistics.count, statistics.mean, statistics.centered, *target, terms, matrix, mean, offset,
            high, low, constant,
            GRAM=gram_weight, MEAN=mean_weight, STD=std_weight, EPS=feature_eps, CHANNELS=channels, ROWS=rows,
            COLUMNS=columns, UNIT=SPLIT_UNITS[half],
        )  # fmt: skip
    return terms.sum(dim=0), StyleGradient(matrix, mean, offset, SplitGradient(high, low, constant))


def fused_add_style_gradient(
    gradient: Tensor,
    features: Tensor,
    style: StyleGradient,
    position_weights: Tensor | None = None,
    *,
    relu: bool = False,
) -> None:
    """Compute `StyleGradient.add_to` on a GPU, for a gradient and features [h, w, c] of the same dtype."""
    from sgsst_core.loss import triton_kernels as kernels

    height, width, channels = features.shape
    positions, tile = height * width, block_of_channels(channels, TILE)
    weights = features if position_weights is None else position_weights
    if features.dtype in SPLIT_UNITS:
        matrix, low, offset = style.split or style.about_zero(features.dtype)
        mean = None
    else:
        matrix, low, mean, offset = style.matrix, None, style.mean, style.offset
    with on_device(features.device):
        kernels.add_style_gradient[(-(-positions // POSITIONS) * -(-channels // tile),)](
            features, weights, gradient, matrix, low, mean, offset,
            positions, width, row_cells(features), *weights.stride()[:2], row_cells(gradient),
            CHANNELS=channels, TILE=tile, K=block_of_channels(channels, STEPS[features.element_size()]), P=POSITIONS,
            WEIGHTED=position_weights is not None, RELU=relu, UNIT=SPLIT_UNITS.get(features.dtype, 1.0),
        )  # fmt: skip


# --- content ---------------------------------------------------------------------------------------------------------


#: Positions per program of the GPU kernels: 4,096 values of the content layer's 512 channels.
CONTENT_POSITIONS = 8


def content_factor(count: Tensor, channels: int, weight: float) -> Tensor:
    """Return lambda_c / (n c), the factor of the content term of a whole view, float64 scalar.

    Args:
        count: n, float64 scalar: number of positions or sum of their weights. If it is 0, the factor is 0.
        weight: lambda_c.
    """
    return weight / (torch.where(count > 0, count, torch.inf) * channels)


def content_loss(features: Tensor, content: Tensor, position_weights: Tensor | None, factor: Tensor) -> Tensor:
    """Return the contribution of some cells to the content loss, float64 scalar.

    Args:
        features: [h, w, c], features of the image.
        content: [h, w, c], features of the content image at the same positions.
        position_weights: [h, w]; None for equal weights.
        factor: Result of `content_factor`.
    """
    difference, weighted = _content_difference(features, content, position_weights)
    # A float32 dot product over a whole view would lose digits, so rows are summed first and then added in float64.
    return factor * (weighted * difference).sum(dim=(1, 2)).sum(dtype=torch.float64)


def content_gradient(features: Tensor, content: Tensor, position_weights: Tensor | None, factor: Tensor) -> Tensor:
    """Return the gradient of `content_loss` with respect to the features, [h, w, c]."""
    return _content_difference(features, content, position_weights)[1] * (2 * factor)


def _content_difference(features: Tensor, content: Tensor, position_weights: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the difference [h, w, c] from the content, float32 or float64, and the same times the position weights."""
    precision = torch.promote_types(features.dtype, torch.float32)
    difference = features.to(precision) - content.to(precision)
    weighted = difference if position_weights is None else difference * position_weights[:, :, None].to(precision)
    return difference, weighted


@dataclass(frozen=True)
class ContentTerm:
    """Content term of one scale of a view: lambda_c mean((F_42 - F_42^content)^2), the mean weighted by coverage.

    If the content weight differs between regions, the squared difference of position p counts v_p <= 1 times, where
    lambda_c v_p is the blended content weight of the Gaussians there. The sum is still divided by the coverage, so a
    position counts as much as with that weight everywhere:

        lambda_c sum_p v_p |F_42 - F_42^content|_p^2 / (c sum_p a_p)
    """

    name = "content"

    view: ScaledView
    content: ContentFeatures
    position_weights: PositionWeights
    factor: Tensor

    @classmethod
    def of(cls, view: ScaledView, network: FeatureNetwork, weight: float, target: ViewTarget) -> Self:
        """Return the term of one scale of a view.

        Args:
            weight: lambda_c.
        """
        weight = weight * network.feature_unit**2 * network.loss_factor
        factor = content_factor(view.count(CONTENT_LAYER, target.coverage), network.channels(CONTENT_LAYER), weight)
        weights = target.coverage if target.content_weights is None else target.content_weights
        return cls(view, target.content[view.scale], weights, factor)

    def value(self, tile: PartitionTile, features: Mapping[str, Tensor]) -> Tensor:
        """Return the contribution of the cells that a tile owns, float64 scalar, given features by layer."""
        owned = self._owned(tile, features[CONTENT_LAYER])
        if _can_be_fused(*owned[:2]):
            return self.factor * fused_content_sum(*owned)
        return content_loss(*owned, self.factor)

    def add_gradient(self, tile: PartitionTile, layer: str, features: Tensor, gradient: Tensor) -> bool | None:
        """Add the derivative of `value` with respect to a layer's features to a gradient in place.

        It is called for every layer that the network reports, after `value` for the same tile.

        Args:
            features: [h, w, c], features of the whole tile.
            gradient: [h, w, c], gradient of the whole tile.

        Returns:
            Whether the gradient was also passed through the layer's ReLU; None if nothing was added.
        """
        if layer != CONTENT_LAYER:
            return None
        owned = self._owned(tile, features)
        added = gradient[tile.owned_cells(CONTENT_LAYER, self.view.size)[1].slices]
        if _can_be_fused(*owned[:2], added):
            relu = added.shape == gradient.shape
            fused_add_content_gradient(added, *owned, self.factor, relu=relu)
            return relu
        added += content_gradient(*owned, self.factor)
        return False

    def _owned(self, tile: PartitionTile, features: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return features, content and position weights of the cells that a tile owns."""
        in_view, in_tile = tile.owned_cells(CONTENT_LAYER, self.view.size)
        weights = self.view.weights(CONTENT_LAYER, in_view, self.position_weights)
        return features[in_tile.slices], self.content[tile], weights


def fused_content_sum(features: Tensor, content: Tensor, position_weights: Tensor | None = None) -> Tensor:
    """Return the sum of a_p |F_p - content_p|^2 as `content_loss` computes it, float64 scalar."""
    from sgsst_core.loss import triton_kernels as kernels

    launch, constants = _launch(features, content, position_weights)
    programs = -(-launch[0] // CONTENT_POSITIONS)
    sums = torch.empty(programs, device=features.device)
    weights = features if position_weights is None else position_weights
    if programs:
        with on_device(features.device):
            kernels.content_sums[(programs,)](features, content, weights, sums, *launch, **constants)
    return sums.sum(dtype=torch.float64)


def fused_add_content_gradient(
    gradient: Tensor,
    features: Tensor,
    content: Tensor,
    position_weights: Tensor | None,
    factor: Tensor,
    *,
    relu: bool = False,
) -> None:
    """Add `content_gradient` to a gradient [h, w, c], and pass it through the features' ReLU if `relu`."""
    from sgsst_core.loss import triton_kernels as kernels

    launch, constants = _launch(features, content, position_weights)
    weights = features if position_weights is None else position_weights
    if programs := -(-launch[0] // CONTENT_POSITIONS):
        with on_device(features.device):
            kernels.add_content_gradient[(programs,)](
                features, content, weights, gradient, factor, *launch, row_cells(gradient), RELU=relu, **constants
            )


def _launch(
    features: Tensor, content: Tensor, position_weights: Tensor | None
) -> tuple[tuple[int, ...], dict[str, int | bool]]:
    """Return the numbers and constants that both kernels take."""
    height, width, channels = features.shape
    steps = (0, 0) if position_weights is None else position_weights.stride()[:2]
    numbers = (height * width, width, row_cells(features), row_cells(content), *steps)
    return numbers, {
        "CHANNELS": channels,
        "BLOCK": block_of_channels(channels),
        "P": CONTENT_POSITIONS,
        "WEIGHTED": position_weights is not None,
    }


def _can_be_fused(*tensors: Tensor) -> bool:
    return all(can_be_fused(each) and each.dtype == tensors[0].dtype for each in tensors)


# --- nearest features ------------------------------------------------------------------------------------------------


#: Maximum number of style vectors to search. Style images larger than 360 x 360 pixels have more vectors, and are
#: subsampled evenly. Little is lost, because the receptive fields of neighboring vectors overlap almost completely. A
#: larger search would take longer than the forward and backward passes of the network.
MAX_VECTORS = 1 << 13


#: Number of positions and number of style vectors per block of the search, by device. The similarities of a block fit
#: in the CPU cache; on a GPU, they take a quarter of a gigabyte.
_BLOCK = {"cpu": (1 << 10, 1 << 10), "cuda": (1 << 13, 1 << 13)}


#: w_n for `nnfm`. With content_weight 1, the nearest-neighbor and content terms are balanced as in ARF for 360-degree
#: scenes (content weight 5e-3 in units of ImageNet-normalized features: github.com/Kai-46/ARF-svox2, opt/try_tnt.sh).
NNFM_WEIGHT = KAPPA**2 / 5e-3


#: w_n for `mixed`. Within 20 to 30 steps, the color gradient of the statistics terms falls to a tenth. With this
#: weight, the color gradient of the nearest-neighbor term then has the same norm. Four pairs of scene and painting need
#: 1.8e8 to 1.7e9; the constant is their geometric mean. It does not depend on the scene, so that a job has the same
#: loss wherever it runs or resumes.
MIXED_WEIGHT = 5e8


#: w_n of each loss for features in units of a 0-255 input; 0 if the loss matches no features.
NEAREST_WEIGHTS: dict[StyleLossName, float] = {"sos": 0.0, "nnfm": NNFM_WEIGHT, "mixed": MIXED_WEIGHT}


def nearest_weight(style_loss: StyleLossName, unit: float = 1.0) -> float:
    """Return w_n, the weight of the nearest-neighbor term.

    It is scaled by the square of the feature unit (`FeatureNetwork.unit`), because the terms that it is balanced
    against grow by this factor.
    """
    return NEAREST_WEIGHTS[style_loss] * unit**2


def nearest_layers(style_loss: StyleLossName, network: str) -> tuple[str, ...]:
    """Return the layers whose features are matched: all of the third block, as in ARF, or none."""
    count = BLOCKS[network][2] if NEAREST_WEIGHTS[style_loss] else 0
    return tuple(f"relu3_{index}" for index in range(1, count + 1))


def positions_per_image(counts: Sequence[int], weights: Sequence[float], most: int) -> list[int]:
    """Return how many positions to take from each image of a style.

    If there are at most `most` positions in total, all are taken. Otherwise each image contributes in proportion to its
    weight, but at least one position if it has any.
    """
    if sum(counts) <= most:
        return list(counts)
    return [min(count, max(1, int(most * weight))) for count, weight in zip(counts, weights, strict=True)]


def positions_in(positions: Tensor, width: int, cells: Rectangle) -> tuple[Tensor, Tensor, Tensor]:
    """Select the row-major positions in a feature map of the given width that lie inside a rectangle.

    Returns:
        Mask [k] bool of those inside, and their rows and columns relative to the rectangle.
    """
    row, column = positions // width, positions % width
    inside = (row >= cells.top) & (row < cells.bottom) & (column >= cells.left) & (column < cells.right)
    return inside, row[inside] - cells.top, column[inside] - cells.left


@dataclass(frozen=True)
class Matches:
    """Nearest style vectors of the positions [h, w] of a view.

    Attributes:
        nearest: Index of the nearest style vector, int64; the first one if several are equally near.
        cosine: Cosine of the angle between features and nearest style vector; 0 where the features are 0.
        inverse: 1 / |F_p|; 0 where |F_p| is within the rounding error of the features, to avoid dividing by that error.
    """

    nearest: Tensor
    cosine: Tensor
    inverse: Tensor

    @staticmethod
    def of(
        features: Mapping[str, Tensor], style: StyleVectors, rounding: float, position_weights: Tensor | None = None
    ) -> Matches:
        """Find the nearest style vector of every position.

        Args:
            features: Features [h, w, c_l] by layer.
            rounding: Relative rounding error of the features (`FeatureNetwork.rounding`).
            position_weights: [h, w]; None for equal weights. On a CPU, positions of weight 0 are skipped.
        """
        height, width = next(iter(features.values())).shape[:2]
        units = style.units
        nearest = torch.zeros((height, width), dtype=torch.int64, device=units.device)
        cosine = units.new_zeros((height, width))
        inverse = torch.zeros_like(cosine)
        rows = max(1, _BLOCK[units.device.type][0] // max(width, 1))
        for top in range(0, height, rows):
            part = slice(top, min(top + rows, height))
            block = torch.cat([at_least_float32(features[layer][part]) for layer in style.parts], dim=2)
            lengths = block.norm(dim=2)
            # NaN fails this comparison, so NaN features keep a NaN norm.
            inverse[part] = torch.where(lengths <= rounding * style.length, torch.inf, lengths).reciprocal()
            block *= inverse[part][:, :, None]
            if position_weights is not None and units.device.type == "cpu":
                covered = position_weights[part] > 0
                cosine[part][covered], nearest[part][covered] = search(block[covered], units)
            else:
                values, positions = search(block.reshape(-1, block.shape[2]), units)
                cosine[part], nearest[part] = values.view(lengths.shape), positions.view(lengths.shape)
        return Matches(nearest, cosine, inverse)

    def distance(self, position_weights: Tensor | None = None) -> Tensor:
        """Return the sum of a_p (1 - cos_p), float64 scalar."""
        away = (1 - self.cosine.double()).clamp_min(0)  # rounding can push a cosine above 1
        return (away if position_weights is None else away * position_weights).sum()

    def add_gradient(
        self,
        gradient: Tensor,
        features: Tensor,
        layer: str,
        style: StyleVectors,
        factor: Tensor,
        position_weights: Tensor | None = None,
    ) -> None:
        """Add `factor` times the gradient of `distance` with respect to the features of a layer to `gradient` in place.

        Args:
            gradient: [h, w, c_l].
            features: Features of the layer that were passed to `of`, [h, w, c_l].
            style: Style vectors that were passed to `of`.
            position_weights: [h, w]; None for equal weights.
        """
        units = style.units[:, style.parts[layer]]
        rows = max(1, _BLOCK[units.device.type][0] // max(features.shape[1], 1))
        for top in range(0, len(features), rows):
            part = slice(top, min(top + rows, len(features)))
            inverse = self.inverse[part]
            scale = inverse * factor.to(inverse)
            if position_weights is not None:
                scale = scale * position_weights[part]
            own = at_least_float32(features[part]) * (self.cosine[part] * inverse)[:, :, None]
            gradient[part] += (own - units[self.nearest[part]]) * scale[:, :, None]


def search(units: Tensor, style: Tensor) -> tuple[Tensor, Tensor]:
    """Find the style vector [k, c] with the largest dot product for each unit vector [p, c].

    Products are computed in blocks, so the full p x k matrix is never stored.

    Returns:
        Largest product [p], and the first index that attains it [p] int64.
    """
    rows, columns = _BLOCK[units.device.type]
    best = units.new_full((len(units),), -torch.inf)
    nearest = torch.zeros(len(units), dtype=torch.int64, device=units.device)
    for top in range(0, len(units), rows):
        part = slice(top, top + rows)
        for first in range(0, len(style), columns):
            values, positions = (units[part] @ style[first : first + columns].T).max(dim=1)
            nearer = values > best[part]
            best[part] = torch.where(nearer, values, best[part])
            nearest[part] = torch.where(nearer, positions + first, nearest[part])
    return best, nearest


@dataclass(frozen=True)
class NearestTerm:
    """Nearest-neighbor feature matching of one scale, after Zhang et al., "ARF: Artistic Radiance Fields" (ECCV 2022).

    E_nearest = w_n / n sum_p a_p (1 - max_k u_p . s_k)

    u_p: unit vector of the concatenated features of all layers of the third block at position p of the view; s_k: unit
    vector at position k of the style; a_p: position weights; n: their sum. The gradient treats the index k(p) of the
    nearest style vector as constant:

    dE/dF_p = -(w_n / n) a_p (s_k(p) - cos_p u_p) / |F_p|

    The search is a blocked matrix product. As in ARF, features are not centered. The matches of each tile are stored
    for the second pass: they take a few bytes per cell, while the search is slow.

    Attributes:
        layer: First of the matched layers, which all have the same cells.
        rounding: Relative rounding error of the features.
        regions: Style vectors, factor of the distances and position weights of each region.
        matches: Matches of each tile, by region.
    """

    name = "nearest"

    view: ScaledView
    layer: str
    rounding: float
    timer: Timer
    regions: list[tuple[StyleVectors, Tensor, PositionWeights]]
    matches: dict[PartitionTile, list[Matches]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        view: ScaledView,
        network: FeatureNetwork,
        style_loss: StyleLossName,
        styles: Sequence[StyleTarget],
        timer: Timer,
    ) -> Self:
        """Return the term of one scale of a view, given the style targets of its regions."""
        layer, regions = nearest_layers(style_loss, network.name)[0], []
        for style in styles:
            if style.vectors is not None:
                count = view.count(layer, style.positions)
                weight = style.weight * nearest_weight(style_loss, network.unit) * network.loss_factor
                factor = weight / torch.where(count > 0, count, torch.inf)
                regions.append((style.vectors, factor, style.positions))
        return cls(view, layer, network.rounding, timer, regions)

    def value(self, tile: PartitionTile, features: Mapping[str, Tensor]) -> Tensor:
        """Return the contribution of the cells that a tile owns, float64 scalar."""
        in_view, in_tile = tile.owned_cells(self.layer, self.view.size)
        self.matches[tile] = []
        sums = []
        for vectors, factor, pyramid in self.regions:
            weights = self.view.weights(self.layer, in_view, pyramid)
            owned = {layer: features[layer][in_tile.slices] for layer in vectors.parts}
            with self.timer("matching"):
                matches = Matches.of(owned, vectors, self.rounding, weights)
                sums.append(factor * matches.distance(weights))
            self.matches[tile].append(matches)
        return reduce(operator.add, sums)

    def add_gradient(self, tile: PartitionTile, layer: str, features: Tensor, gradient: Tensor) -> bool | None:
        """Add the derivative of `value` to a gradient in place; as `ContentTerm.add_gradient`."""
        added = None
        for (vectors, factor, pyramid), matches in zip(self.regions, self.matches[tile], strict=True):
            if layer in vectors.parts:
                in_view, in_tile = tile.owned_cells(layer, self.view.size)
                weights = self.view.weights(layer, in_view, pyramid)
                owned = gradient[in_tile.slices], features[in_tile.slices]
                matches.add_gradient(*owned, layer, vectors, factor, weights)
                added = False
        return added


# --- all terms -------------------------------------------------------------------------------------------------------


#: Names of the terms whose sum is the loss of a scale, in the order of summation.
TERMS = (*STATISTICS_TERMS, ContentTerm.name, NearestTerm.name)
#: Terms that are sums over the positions of a view. Every tile adds the positions that it owns.
PositionTerm = ContentTerm | NearestTerm


def layers_of(style_loss: StyleLossName, weights: BackboneWeights, *, content: bool) -> tuple[str, ...]:
    """Return every layer that a loss reads from a network."""
    layers = (*statistics_layers(style_loss, weights), *((CONTENT_LAYER,) if content else ()))
    return tuple(dict.fromkeys((*layers, *nearest_layers(style_loss, weights.name))))
