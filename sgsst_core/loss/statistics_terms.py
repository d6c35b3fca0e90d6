"""Style terms of one scale: Gram matrix, mean and standard deviation of features, and their gradient in closed form.

E_style = sum over layers of w_G mean((G - G_v)^2) + w_m mean((mu - mu_v)^2) + w_s mean((sigma - sigma_v)^2)

with w_G = 1e3 / c^2 and w_m = w_s = 1e4 (SGSST, CVPR 2025). Means are over the entries of each matrix or vector. If
there are position weights a_p, the statistics G, mu and sigma are weighted by them, and n is their sum instead of the
number of positions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from sgsst_core.devices import on_device
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.partition import PartitionTile
from sgsst_core.features.statistics import (
    TILE,
    LayerStatistics,
    block_of_channels,
    block_of_entries,
    block_of_positions,
    blocks_of,
    can_be_fused,
    center,
    has_kernels,
    layer_statistics,
    row_cells,
)
from sgsst_core.features.vgg import PIXELS, STYLE_LAYERS, FeatureNetwork
from sgsst_core.loss.position_term import TermInputs
from sgsst_core.loss.targets import LayerTarget, StyleTarget
from sgsst_core.settings import StyleLossName

#: Terms of the statistics: name in files and reports, and display name.
STATISTICS_TERMS = {"gram": "Gram matrix", "mean": "mean", "std": "standard deviation"}

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


def has_statistics(style_loss: StyleLossName) -> bool:
    """Return whether a loss compares Gram matrices, means and standard deviations."""
    return style_loss != "nnfm"


def statistics_layers(style_loss: StyleLossName, weights: BackboneWeights) -> tuple[str, ...]:
    """Return the layers whose statistics a loss compares; empty if it compares none."""
    if not has_statistics(style_loss):
        return ()
    return (PIXELS, *STYLE_LAYERS) if PIXELS in weights.scales else STYLE_LAYERS


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

    def apply(self, features: Tensor, position_weights: Tensor | None = None) -> Tensor:
        """Return dE/dfeatures [h, w, c] for features [h, w, c] and position weights [h, w]."""
        result = torch.zeros(features.shape, dtype=features.dtype, device=features.device)
        self.add_to(result, features, position_weights)
        return result

    def add_to(
        self, gradient: Tensor, features: Tensor, position_weights: Tensor | None = None, *, relu: bool = False
    ) -> bool:
        """Add the result of `apply` to a gradient [h, w, c] in place.

        The computation runs in blocks, so no tensor as large as the features is allocated.

        Args:
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


def compared_layers(style_loss: StyleLossName, network: FeatureNetwork) -> list[str]:
    """Return the reported layers of a network whose statistics a loss compares."""
    return [layer for layer in (PIXELS, *STYLE_LAYERS) if layer in network.layers] if has_statistics(style_loss) else []


class StatisticsTerms:
    """Style terms of one scale of a view, which need statistics of the whole scale before they have a gradient."""

    def __init__(self, inputs: TermInputs, layers: Sequence[str]) -> None:
        self._view = inputs.view
        self._network = inputs.network
        self._regions = inputs.regions
        self._layers = layers
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
                nowhere = self._is_nowhere(weights)
                zero = LayerStatistics.zero(owned.shape[-1], owned.device) if nowhere else None
                statistics.append(zero or layer_statistics(owned, weights))
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


# --- on a GPU: one kernel launch each ---


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
    from sgsst_core.loss import statistics_terms_kernels as kernels

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
    from sgsst_core.loss import statistics_terms_kernels as kernels

    height, width, channels = features.shape
    positions, tile, block = height * width, block_of_channels(channels, TILE), block_of_positions(POSITIONS)
    weights = features if position_weights is None else position_weights
    if features.dtype in SPLIT_UNITS:
        matrix, low, offset = style.split or style.about_zero(features.dtype)
        mean = None
    else:
        matrix, low, mean, offset = style.matrix, None, style.mean, style.offset
    with on_device(features.device):
        kernels.add_style_gradient[(-(-positions // block) * -(-channels // tile),)](
            features, weights, gradient, matrix, low, mean, offset,
            positions, width, row_cells(features), *weights.stride()[:2], row_cells(gradient),
            CHANNELS=channels, TILE=tile, K=block_of_channels(channels, STEPS[features.element_size()]), P=block,
            WEIGHTED=position_weights is not None, RELU=relu, UNIT=SPLIT_UNITS.get(features.dtype, 1.0),
        )  # fmt: skip
