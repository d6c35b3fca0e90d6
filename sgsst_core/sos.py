"""The SOS loss of one view, E = (1/n_s) sum_s E_transfer(scale s), and its gradient with respect to the pixels.

Each scale goes through the network in partition tiles, in two passes: statistics of the whole scale first, then
back-propagation of the loss that they give. Activations of the first pass are kept as far as the memory budget
reaches; only tiles beyond it are computed twice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from sgsst_core.constants import COARSEST_SHORTER_SIDE
from sgsst_core.loss import LayerTarget, LossTerms, StyleGradient, content_loss, style_loss
from sgsst_core.partition import PartitionTile, Rectangle, choose_tile_size, covered_region, partition
from sgsst_core.pyramid import (
    add_upscaled_,
    coverage_pyramid,
    downscale,
    scale_count,
    style_size,
)
from sgsst_core.statistics import LayerStatistics, layer_statistics, merge
from sgsst_core.timing import Timer
from sgsst_core.vgg import CONTENT_LAYER, STYLE_LAYERS, Activations, FeatureGradient, FeatureNetwork, layer_stride

ScaleTarget = Mapping[str, LayerTarget]
#: Bytes for activations where the caller names no budget: leaves most of a laptop to others.
DEFAULT_MEMORY = 4 << 30


@dataclass(frozen=True)
class SosResult:
    """What one evaluation gives.

    Attributes:
        terms: the split loss of each scale that was evaluated.
        image_gradient: dE/dimage [H, W, 3]; None if only the loss was asked for.
    """

    terms: dict[int, LossTerms]
    image_gradient: Tensor | None

    @property
    def loss(self) -> float:
        """E, the mean over the scales that were evaluated."""
        return sum(terms.total for terms in self.terms.values()) / len(self.terms)


@dataclass
class ViewTarget:
    """What a view is compared with, apart from the style.

    Attributes:
        content: scale to content features [h/8, w/8, 512], as far as they are kept.
        content_image: [H, W, 3], from which they can be computed again.
        coverage: position weights at powers of two, [H >> k, W >> k] each; None for equal weights.
    """

    content_image: Tensor | None = None
    content: dict[int, Tensor] = field(default_factory=dict)
    coverage: list[Tensor] | None = None


class SosLoss:
    """Evaluates the SOS loss of views against one style.

    Args:
        network: the feature network; it must report the style layers, and the content layer if it is used.
        content_weight: lambda_c; 0 leaves the content branch out.
        memory: bytes that activations may take.
        tile_size: side of partition tiles, multiple of 16; None lets the memory budget decide.
        coarsest: pixels of the coarsest scale's shorter side at most.
        leave_out: pixels without weight do not go through the network; False for comparison.
        keep_activations: as many as fit between the two passes; False computes each tile twice, for comparison.
        timer: receives the seconds of `vgg_forward`, `vgg_backward` and `statistics`.
    """

    def __init__(
        self,
        network: FeatureNetwork,
        *,
        content_weight: float = 1.0,
        memory: int = DEFAULT_MEMORY,
        tile_size: int | None = None,
        coarsest: int = COARSEST_SHORTER_SIDE,
        leave_out: bool = True,
        keep_activations: bool = True,
        timer: Timer | None = None,
    ) -> None:
        self.network = network
        self.content_weight = content_weight
        self.memory = memory
        self.tile_size = tile_size
        self.coarsest = coarsest
        self.leave_out = leave_out
        self.keep_activations = keep_activations
        self.timer = timer or Timer()
        self.style_layers = [layer for layer in STYLE_LAYERS if layer in network.layers]

    def scale_count(self, height: int, width: int) -> int:
        """n_s of views of a size."""
        return scale_count(height, width, self.coarsest)

    def tiles(self, height: int, width: int, coverage: Tensor | None = None) -> list[PartitionTile]:
        """The partition of a scaled view; what has no weight (coverage [h, w] of 0) belongs to no tile."""
        if not self.leave_out:
            coverage = None
        region = None if coverage is None else covered_region(coverage)
        halo = self.network.halo
        size = self.tile_size
        if size is None:
            held = self.network.held_bytes_per_pixel()
            working = self.network.working_bytes_per_pixel() / held
            size = choose_tile_size(height, width, halo, held=self.memory / held, working=working, region=region)
        tiles = partition(height, width, size, halo, region)
        return tiles if coverage is None else [tile for tile in tiles if coverage[tile.inner.slices].any()]

    def style_targets(self, style: Tensor, view_size: tuple[int, int]) -> dict[int, dict[str, LayerTarget]]:
        """Targets of every scale of views of view_size (height, width) from a style image [H, W, 3] in 0..1.

        A layer that has no cell at a scale of a very small style is missing there and is left out of the loss.
        """
        image = resize_area(style, style_size((style.shape[0], style.shape[1]), view_size))
        targets: dict[int, dict[str, LayerTarget]] = {}
        for scale in range(self.scale_count(*view_size)):
            scaled = downscale(image, scale).to(self.network.device)
            pass_ = _ScalePass(self, (scaled.shape[0], scaled.shape[1]), scale, ViewTarget(), None)
            statistics, _, _ = self._first_pass(scaled, pass_, keep=False)
            targets[scale] = {layer: LayerTarget.of(part) for layer, part in statistics.items() if not part.empty}
        return targets

    def view_target(self, content: Tensor, coverage: Tensor | None = None, *, keep_content: bool = True) -> ViewTarget:
        """Prepare a view: content image [H, W, 3] in 0..1 and coverage [H, W] in 0..1 (None: equal weights)."""
        scales = self.scale_count(content.shape[0], content.shape[1])
        weights = None if coverage is None else self.position_weights(coverage)
        target = ViewTarget(content_image=content, coverage=weights)
        if self.content_weight and keep_content:
            target.content = {scale: self.content_features(content, scale, weights) for scale in range(scales)}
            target.content_image = None
        return target

    def position_weights(self, coverage: Tensor) -> list[Tensor]:
        """Coverage [H, W] in 0..1 at every power of two that a layer of a scale needs."""
        levels = self.scale_count(coverage.shape[0], coverage.shape[1]) + layer_stride("relu5_1").bit_length()
        return coverage_pyramid(coverage.to(self.network.device, _gradient_dtype(self.network)), levels)

    def content_features(self, content: Tensor, scale: int, coverage: list[Tensor] | None = None) -> Tensor:
        """Features of the content layer [h/8, w/8, 512] of a content image [H, W, 3] at a scale; 0 without coverage."""
        image = downscale(content.to(self.network.device), scale)
        size = (image.shape[0], image.shape[1])
        stride = layer_stride(CONTENT_LAYER)
        shape = (size[0] // stride, size[1] // stride, self.network.channels(CONTENT_LAYER))
        result = torch.zeros(shape, dtype=self.network.dtype, device=self.network.device)
        for tile in self.tiles(*size, None if coverage is None else coverage[scale]):
            view, own = tile.owned_cells(CONTENT_LAYER, size)
            features = self._forward(image, tile, keep=False).features[CONTENT_LAYER]
            result[view.slices] = features[own.slices]
        return result

    def evaluate(
        self,
        image: Tensor,
        style: Mapping[int, ScaleTarget],
        view: ViewTarget,
        scales: Sequence[int] | None = None,
        *,
        gradient: bool = True,
    ) -> SosResult:
        """Loss of an image [H, W, 3] (0..1, not clamped), and dE/dimage.

        Args:
            style: targets by scale, from `style_targets`.
            view: from `view_target`.
            scales: which scales; None for all (SOS). Phase 1 passes the coarsest alone.
            gradient: False evaluates the loss only.
        """
        scales = range(self.scale_count(image.shape[0], image.shape[1])) if scales is None else scales
        total = torch.zeros(image.shape, dtype=_gradient_dtype(self.network), device=self.network.device)
        terms: dict[int, LossTerms] = {}
        for scale in scales:
            scaled = downscale(image.to(self.network.device), scale)
            terms[scale], pixel_gradient = self._scale(scaled, style[scale], view, scale, gradient)
            if pixel_gradient is not None:
                add_upscaled_(total, pixel_gradient, scale, 1.0 / len(scales))
        return SosResult(terms, total if gradient else None)

    def evaluate_scale(self, image: Tensor, style: ScaleTarget, view: ViewTarget, scale: int) -> SosResult:
        """Loss of one scale from the image at that scale, [H >> scale, W >> scale, 3], and dE/dimage of that size."""
        terms, gradient = self._scale(image.to(self.network.device), style, view, scale, gradient=True)
        return SosResult({scale: terms}, gradient)

    def _scale(
        self, image: Tensor, style: ScaleTarget, view: ViewTarget, scale: int, gradient: bool
    ) -> tuple[LossTerms, Tensor | None]:
        """One scale's loss and pixel gradient [h, w, 3]."""
        size = (image.shape[0], image.shape[1])
        pass_ = _ScalePass(self, size, scale, view, self._content(view, scale))
        statistics, content, kept = self._first_pass(image, pass_, keep=gradient)
        terms = LossTerms(content=content)
        for layer, part in statistics.items():
            if layer in style and not part.empty:
                eps = torch.finfo(self.network.dtype).eps
                layer_terms, pass_.maps[layer] = style_loss(part, style[layer], feature_eps=eps)
                terms += layer_terms
        if not gradient:
            return terms, None
        result = torch.zeros(image.shape, dtype=_gradient_dtype(self.network), device=image.device)
        for tile in list(kept):
            activations = kept.pop(tile) or self._forward(image, tile)
            with self.timer("vgg_backward"):
                result[tile.outer.slices] += self.network.backward(activations, pass_.feature_gradient(tile))
        return terms, result

    def _content(self, view: ViewTarget, scale: int) -> Tensor | None:
        if not self.content_weight:
            return None
        if scale in view.content:
            return view.content[scale]
        if view.content_image is None:
            raise ValueError("the view was prepared without content, but content_weight is not 0")
        return self.content_features(view.content_image, scale, view.coverage)

    def _first_pass(
        self, image: Tensor, pass_: _ScalePass, *, keep: bool
    ) -> tuple[dict[str, LayerStatistics], float, dict[PartitionTile, Activations | None]]:
        """Merged statistics of each style layer, the content loss, and the activations that fit the budget."""
        merged = {
            layer: LayerStatistics.zero(self.network.channels(layer), image.device) for layer in self.style_layers
        }
        content = 0.0
        kept: dict[PartitionTile, Activations | None] = {}
        tiles = self.tiles(*pass_.size, pass_.coverage)
        held = self.network.held_bytes_per_pixel()
        # Whatever is kept, there must be room to back-propagate the largest tile.
        budget = self.memory - max((tile.outer.pixels for tile in tiles), default=0) * (
            held + self.network.working_bytes_per_pixel()
        )
        for tile in tiles:
            keep_this = keep and self.keep_activations and (len(tiles) == 1 or tile.outer.pixels * held <= budget)
            budget -= tile.outer.pixels * held if keep_this else 0
            activations = self._forward(image, tile, keep=keep_this)
            with self.timer("statistics"):
                for layer in self.style_layers:
                    view, own = tile.owned_cells(layer, pass_.size)
                    part = layer_statistics(activations.features[layer][own.slices], pass_.weights(layer, view))
                    merged[layer] = merge(merged[layer], part)
                content += pass_.content_loss(tile, activations.features.get(CONTENT_LAYER))[0]
            kept[tile] = activations if keep_this else None
        return merged, content, kept

    def _forward(self, image: Tensor, tile: PartitionTile, *, keep: bool = True) -> Activations:
        with self.timer("vgg_forward"):
            return self.network.forward(image[tile.outer.slices], keep=keep)


class _ScalePass:
    """What the tiles of one scale share: size, position weights, content, and the gradient maps once known."""

    def __init__(
        self, loss: SosLoss, size: tuple[int, int], scale: int, view: ViewTarget, content: Tensor | None
    ) -> None:
        self.size = size
        self.maps: dict[str, StyleGradient] = {}
        self._scale = scale
        self._coverage = view.coverage
        self._content_weight = loss.content_weight
        self._timer = loss.timer
        self._content = content
        self._content_count = 0.0
        if content is not None:
            cells = Rectangle(0, 0, content.shape[0], content.shape[1])
            weights = self.weights(CONTENT_LAYER, cells)
            self._content_count = cells.pixels if weights is None else float(weights.sum(dtype=torch.float64))

    @property
    def coverage(self) -> Tensor | None:
        """Coverage [h, w] of the scaled view's pixels; None for equal weights."""
        return None if self._coverage is None else self._coverage[self._scale]

    def weights(self, layer: str, cells: Rectangle) -> Tensor | None:
        """Weights [h, w] of some cells of a layer: the coverage, box-averaged to the cells; None for equal weights."""
        if self._coverage is None:
            return None
        return self._coverage[self._scale + layer_stride(layer).bit_length() - 1][cells.slices]

    def content_loss(self, tile: PartitionTile, features: Tensor | None) -> tuple[float, Tensor | None]:
        """The tile's share of the content loss and its gradient on owned cells; features are those of all its cells."""
        if self._content is None or features is None or not self._content_count > 0:
            return 0.0, None
        view, own = tile.owned_cells(CONTENT_LAYER, self.size)
        return content_loss(
            features[own.slices],
            self._content[view.slices],
            self._content_count,
            self._content_weight,
            self.weights(CONTENT_LAYER, view),
        )

    def feature_gradient(self, tile: PartitionTile) -> FeatureGradient:
        """dE/dfeatures of one tile, zero on cells that it does not own."""

        def gradient(layer: str, features: Tensor) -> Tensor | None:
            with self._timer("statistics"):
                return timed(layer, features)

        def timed(layer: str, features: Tensor) -> Tensor | None:
            view, own = tile.owned_cells(layer, self.size)
            if layer == CONTENT_LAYER:
                owned = self.content_loss(tile, features)[1]
            elif layer in self.maps:
                owned = self.maps[layer].apply(features[own.slices], self.weights(layer, view))
            else:
                owned = None
            if owned is None or owned.shape == features.shape:
                return owned
            embedded = torch.zeros(features.shape, dtype=owned.dtype, device=owned.device)
            embedded[own.slices] = owned
            return embedded

        return gradient


def resize_area(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Image [H, W, 3] brought down to size (height, width) with an antialiasing filter."""
    if (image.shape[0], image.shape[1]) == size:
        return image
    planes = image.permute(2, 0, 1).unsqueeze(0)
    resized = torch.nn.functional.interpolate(planes, size=size, mode="bilinear", antialias=True, align_corners=False)
    return resized[0].permute(1, 2, 0).contiguous()


def _gradient_dtype(network: FeatureNetwork) -> torch.dtype:
    return torch.promote_types(network.dtype, torch.float32)
