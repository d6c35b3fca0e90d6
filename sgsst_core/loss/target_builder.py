"""Computation of the targets of styles and views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from sgsst_core.errors import ImageError
from sgsst_core.features.partition import PartitionTile
from sgsst_core.features.statistics import LayerStatistics, layer_statistics, merge
from sgsst_core.features.vgg import CONTENT_LAYER, Activations, FeatureNetwork, layer_stride
from sgsst_core.loss.nearest import MAX_VECTORS, nearest_layers, positions_in, positions_per_image
from sgsst_core.loss.position_term import ScaledView
from sgsst_core.loss.statistics_terms import compared_layers
from sgsst_core.loss.targets import ContentFeatures, LayerTarget, StyleTarget, StyleTargets, StyleVectors, ViewTarget
from sgsst_core.loss.tiling import Divider
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.parallel.division import Piece, Size, rounds
from sgsst_core.scene.pyramid import downscale, resize_area, style_size
from sgsst_core.settings import StyleLossName
from sgsst_core.style import Style, chosen_positions
from sgsst_core.timing import Timer


class TargetBuilder:
    """Builder of the targets of styles and views for one loss.

    Args:
        timer: Timer for `vgg_forward`, `statistics` and `communication`.
        collectives: Collectives of the ranks that build each style target together.
        style_scale: Magnification of style images relative to their default size.
    """

    def __init__(
        self,
        network: FeatureNetwork,
        divider: Divider,
        timer: Timer,
        collectives: Collectives = ALONE,
        *,
        style_loss: StyleLossName = "sos",
        has_content: bool = True,
        style_scale: float = 1.0,
    ) -> None:
        self.style_scale = style_scale
        self.network = network
        self._divider = divider
        self._timer = timer
        self._collectives = collectives
        self._has_content = has_content
        self._compared = compared_layers(style_loss, network)
        self._matched = nearest_layers(style_loss, network.name)

    def of_style(self, style: Style, view_size: Size) -> StyleTargets:
        """Compute the targets of a style at all scales with a positive weight.

        If a style image is so small that a layer's feature map is empty at some scale, the layer is not compared at
        that scale. With several images, the layer's target is computed from those with a feature map.

        Raises:
            ImageError: If the loss matches features, and the style image is too small to have any.
        """
        pyramids = [self._style_pyramid(image, view_size) for image in style.images]
        layers = self._mixed_layers(pyramids, style.weights) if self._compared else {}
        vectors = {
            scale: self._style_vectors([pyramid[scale] for pyramid in pyramids], style.weights) for scale in pyramids[0]
        }
        if self._matched and all(each is None for each in vectors.values()):
            height, width = _size(pyramids[0][min(pyramids[0])])  # from the scales with a positive weight
            raise ImageError(
                f"The style is used at {width} x {height} pixels, too few to match features with. "
                "Use a larger style image, larger views, or --style-loss sos."
            )
        return {scale: (StyleTarget(layers.get(scale, {}), each),) for scale, each in vectors.items()}

    def _style_pyramid(self, image: Tensor, view_size: Size) -> dict[int, Tensor]:
        """Return a style image at the scales that are evaluated for views of a given size, on the network's device."""
        size = style_size(_size(image), view_size, self.style_scale)
        resized = resize_area(image, size).to(self.network.device)
        return {scale: downscale(resized, scale) for scale in self._divider.tiling.scales(view_size)}

    def _mixed_layers(
        self, pyramids: Sequence[Mapping[int, Tensor]], weights: Sequence[float]
    ) -> dict[int, dict[str, LayerTarget]]:
        """Compute the layer targets of a style at each scale, from the pyramids and weights of its images."""
        every = [self._style_statistics(pyramid) for pyramid in pyramids]
        mixed: dict[int, dict[str, LayerTarget]] = {}
        for scale in pyramids[0]:
            mixed[scale] = {}
            for layer in self._compared:
                pairs = zip(every, weights, strict=True)
                some = [(own[scale][layer], weight) for own, weight in pairs if layer in own[scale]]
                if some:
                    mixed[scale][layer] = LayerTarget.mixed(*zip(*some, strict=True))
        return mixed

    def _style_statistics(self, scaled: Mapping[int, Tensor]) -> dict[int, dict[str, LayerTarget]]:
        """Compute the layer targets of a style image, given as images [h, w, 3] by scale.

        The work is divided among the ranks.
        """
        division = self._divider.divide({scale: _size(image) for scale, image in scaled.items()})
        targets: dict[int, dict[str, LayerTarget]] = {}
        for scales in rounds(list(scaled), self._collectives.size):
            every = [each for scale in scales for each in self._own_statistics(scaled[scale], division.tiles[scale])]
            with self._timer("communication"):
                numbers = torch.zeros(0, dtype=torch.float64, device=every[0].mean.device)
                parts = iter(self._collectives.all_reduce_statistics(every, numbers)[0])
            for scale in scales:
                statistics = {layer: next(parts) for layer in self._compared}
                targets[scale] = {
                    layer: LayerTarget.of(own)
                    for layer, own in statistics.items()
                    if min(_size(scaled[scale])) >= layer_stride(layer)
                }
        return targets

    def _own_statistics(self, image: Tensor, tiles: Sequence[PartitionTile]) -> list[LayerStatistics]:
        """Return the statistics of this rank's tiles of an image [h, w, 3], by layer."""
        size, device = _size(image), image.device
        total: list[LayerStatistics] = []
        for tile in tiles:
            features = self._forward(image[tile.outer.slices]).features
            with self._timer("statistics"):
                own = [layer_statistics(features[c][tile.owned_cells(c, size)[1].slices]) for c in self._compared]
                total = [merge(*pair) for pair in zip(total, own, strict=True)] if total else own
        return total or [LayerStatistics.zero(self.network.channels(layer), device) for layer in self._compared]

    def _style_vectors(self, images: Sequence[Tensor], weights: Sequence[float]) -> StyleVectors | None:
        """Compute the style vectors of weighted images [h, w, 3] at one scale.

        The vectors of all images are pooled; if there are too many, each image contributes in proportion to its weight.
        The vectors are too large to send, so every rank computes all of them.

        Returns:
            Style vectors; None if the loss matches no features, or the images are too small to have any.
        """
        if not self._matched:
            return None
        stride = layer_stride(self._matched[0])
        counts = [(size[0] // stride) * (size[1] // stride) for size in map(_size, images)]
        chosen = positions_per_image(counts, weights, MAX_VECTORS)
        vectors = [
            self._vectors_of(image, chosen_positions(count, some))
            for image, count, some in zip(images, counts, chosen, strict=True)
            if count
        ]
        if not vectors:
            return None
        return StyleVectors.of(
            {layer: torch.cat([each[layer] for each in vectors]).to(images[0].device) for layer in self._matched}
        )

    def _vectors_of(self, image: Tensor, positions: Tensor) -> dict[str, Tensor]:
        """Return the features [k, c] of an image [h, w, 3] at some positions of the matched layers, on the CPU."""
        size = _size(image)
        width = size[1] // layer_stride(self._matched[0])
        vectors = {
            layer: torch.empty((len(positions), self.network.channels(layer)), dtype=self.network.dtype)
            for layer in self._matched
        }
        for tile in self._divider.tiles(size):
            features = self._forward(image[tile.outer.slices]).features
            in_image, in_tile = tile.owned_cells(self._matched[0], size)
            inside, row, column = positions_in(positions, width, in_image)
            for layer, values in vectors.items():
                values[inside] = features[layer][in_tile.slices].cpu()[row, column]
        return vectors

    def of_view(self, content: Tensor, coverage: Tensor | None = None, *, cache_content: bool = True) -> ViewTarget:
        """Compute the targets of a view.

        Args:
            content: Content image [H, W, 3] in 0..1.
            coverage: [H, W] in 0..1; None for equal weights.
            cache_content: Whether to compute and cache the content features now, instead of in every evaluation.
        """
        height, width = _size(content)
        weights = None if coverage is None else self.position_weights(coverage)
        scales = self._divider.tiling.scales((height, width))
        division = self._divider.divide({scale: (height >> scale, width >> scale) for scale in scales}, weights)
        target = ViewTarget(content_image=content, coverage=weights, division=division)
        if self._has_content and cache_content:
            target.content = {
                scale: self.content_features(self.scaled(content, scale), tiles)
                for scale, tiles in division.tiles.items()
            }
            target.content_image = None
        return target

    def position_weights(self, coverage: Tensor) -> list[Tensor]:
        """Downscale coverage [H, W] in 0..1 by every power of two that a layer needs at some scale."""
        coarsest = self._divider.tiling.scales(_size(coverage))[-1]
        levels = coarsest + 1 + layer_stride("relu5_1").bit_length()
        dtype = torch.promote_types(self.network.dtype, torch.float32)
        finest = coverage.to(self.network.device, dtype)
        return [downscale(finest, level) for level in range(levels)]

    def scaled(self, content: Tensor, scale: int) -> ScaledView:
        """Return a scale of a content image [H, W, 3]."""
        return ScaledView.of(downscale(content.to(self.network.device), scale), scale)

    def content_features(self, content: ScaledView, tiles: Sequence[PartitionTile]) -> ContentFeatures:
        """Compute the content features of a scale of a content image, on the cells owned by some tiles."""
        result = {}
        for tile in tiles:
            cells = tile.owned_cells(CONTENT_LAYER, content.size)[1]
            features = self._forward(content.pixels(tile.outer), CONTENT_LAYER).features[CONTENT_LAYER]
            result[tile] = features[cells.slices].clone()  # a slice would keep the features of the halo alive too
        return result

    def content_bytes(self, pieces: Sequence[Sequence[Piece]]) -> int:
        """Return the maximum size over all ranks of the `content_features` of a scale, in bytes."""
        value = torch.finfo(self.network.dtype).bits // 8 * self.network.channels(CONTENT_LAYER)
        return max(sum(piece.cells(CONTENT_LAYER) for piece in own) for own in pieces) * value

    def _forward(self, pixels: Tensor, until: str | None = None) -> Activations:
        with self._timer("vgg_forward"):
            return self.network.forward(pixels, cache=False, until=until)


def _size(image: Tensor) -> Size:
    return image.shape[0], image.shape[1]
