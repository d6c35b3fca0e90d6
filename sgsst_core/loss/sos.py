"""SOS loss of one view, E = (1/n_s) sum_s E_transfer(scale s), its gradient by pixels, and its targets.

Each scale goes through the network in partition tiles, in two passes: the first collects statistics of the whole scale,
the second back-propagates the loss computed from them. Activations of the first pass are cached as far as the memory
budget allows; only the remaining tiles are computed twice. With several ranks, each processes its own tiles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from sgsst_core import parallel
from sgsst_core.constants import COARSEST_SHORTER_SIDE
from sgsst_core.devices import Timer
from sgsst_core.errors import ImageError
from sgsst_core.features.partition import PartitionTile
from sgsst_core.features.statistics import LayerStatistics, layer_statistics, merge
from sgsst_core.features.vgg import CONTENT_LAYER, Activations, FeatureNetwork, layer_stride
from sgsst_core.loss.terms import (
    MAX_VECTORS,
    TERMS,
    ContentFeatures,
    ContentTerm,
    LayerTarget,
    LossTerms,
    NearestTerm,
    PositionTerm,
    StatisticsTerms,
    StyleTarget,
    StyleTargets,
    StyleVectors,
    ViewTarget,
    compared_layers,
    nearest_layers,
    positions_in,
    positions_per_image,
)
from sgsst_core.scales import EVEN, ScaleWeights
from sgsst_core.scene.colors import downscale, resize_area, style_size
from sgsst_core.settings import Settings, StyleLossName
from sgsst_core.style import Style, chosen_positions

#: Default memory budget for activations in bytes; leaves most of a laptop's memory free.
DEFAULT_MEMORY = 4 << 30


@dataclass(frozen=True)
class SosResult:
    """Result of one evaluation.

    Attributes:
        values: [scales, terms] float64, the loss of each scale split into `TERMS`, still on the device.
        image_gradient: This rank's summand of dE/dimage, [h, w, 3], with respect to the pixels that it was given; the
            sum over all ranks is the gradient. None if only the loss was requested.
    """

    scales: tuple[int, ...]
    values: Tensor
    image_gradient: Tensor | None
    weights: ScaleWeights = EVEN

    @property
    def terms(self) -> dict[int, LossTerms]:
        """Loss of each scale, split into terms. Synchronizes with the device."""
        rows = zip(self.scales, self.values.tolist(), strict=True)
        return {scale: LossTerms(*row) for scale, row in rows}

    @property
    def loss(self) -> float:
        """E, the weighted mean over the evaluated scales. Synchronizes with the device."""
        return self.weights.mean({scale: terms.total for scale, terms in self.terms.items()})


class SosLoss:
    """SOS loss of views against one style.

    Args:
        network: Feature network. It must report the layers of `terms.layers_of`; statistics of style layers and
            `PIXELS` are compared only if the network reports them.
        content_weight: lambda_c; 0 disables the content term.
        tile_size: Side of partition tiles, a multiple of 16; None to choose it from the memory budget.
        coarsest: Maximum shorter side of the coarsest scale in pixels.
        style_scale: Magnification of the style image relative to its default size.
        scales: Weights of the pyramid's scales; those of weight 0 are not computed.
        timer: Timer for `vgg_forward`, `vgg_backward`, `statistics`, `matching` and `communication`.
        collectives: Collectives of the ranks that evaluate each view together. All ranks must call the same methods
            with the same arguments.

    Attributes:
        network: Feature network. Another one needs the same layers, activations of the same size, and new targets.
        targets: Builder of the targets of styles and views for this loss.
        compared: Layers whose statistics are compared.
        matched: Layers whose features are matched.
    """

    def __init__(
        self,
        network: FeatureNetwork,
        *,
        content_weight: float = 1.0,
        style_loss: StyleLossName = "sos",
        memory: int = DEFAULT_MEMORY,
        tile_size: int | None = None,
        coarsest: int = COARSEST_SHORTER_SIDE,
        style_scale: float = 1.0,
        scales: ScaleWeights = EVEN,
        timer: Timer | None = None,
        collectives: parallel.Collectives = parallel.ALONE,
    ) -> None:
        self.network = network
        self.content_weight = content_weight
        self._style_loss = style_loss
        self.memory = memory
        self.weights = scales
        self.style_scale = style_scale
        self.timer = timer or Timer()
        self.collectives = collectives
        held = network.held_bytes_per_pixel()
        # Temporary memory of a pass: two tensors like relu1_1.
        working = 2 * network.channels("relu1_1") * torch.finfo(network.dtype).bits / 8 / held
        self.tiling = parallel.Tiling(
            network.halo,
            memory / held,
            working,
            coarsest,
            tile_size,
            scales,
            network.largest_tile,
            parallel.RENDERING[network.device.type],
        )
        self.divider = parallel.Divider(self.tiling, collectives)
        self.targets = TargetBuilder(self)
        self.compared = compared_layers(style_loss, network)
        self.matched = nearest_layers(style_loss, network.name)

    def halve_memory(self, pixels: int) -> None:
        """Halve the memory budget for activations, after reducing it to what views of at most `pixels` pixels need."""
        held = min(self.tiling.held, pixels * (1 + self.tiling.working)) / 2
        self.memory = int(held * self.network.held_bytes_per_pixel())
        self.tiling = self.divider.tiling = replace(self.tiling, held=held)

    def evaluate(
        self,
        image: Tensor,
        style: StyleTargets,
        view: ViewTarget,
        scales: Sequence[int] | Mapping[int, float] | None = None,
        *,
        gradient: bool = True,
    ) -> SosResult:
        """Compute the loss of an image [h, w, 3] (0..1, not clamped) and dE/dimage.

        Args:
            image: Image of the view at full size, or of the rectangle that this rank renders (`Division.shares`).
            scales: Scales to evaluate, each with a positive weight; phase 1 passes only the coarsest. A mapping gives
                their weights in the gradient, for scales that were drawn. None for the full SOS loss.
        """
        shares = view.division.shares if view.division else None
        height, width = shares.size if shares else (image.shape[0], image.shape[1])
        scales = self.tiling.scales((height, width)) if scales is None else scales
        sizes = {scale: (height >> scale, width >> scale) for scale in scales}
        division = self._division(view, sizes)
        weights = scales if isinstance(scales, Mapping) else self.weights.fractions(sizes)
        images = parallel.ViewImages(
            image.to(self.network.device), division, view.background, self.collectives, self.timer
        )
        values: dict[int, Tensor] = {}
        for some in parallel.rounds(list(sizes), self.collectives.size):
            passes = [self._pass(images.scaled(scale), division.tiles[scale], style[scale], view) for scale in some]
            self._collect(passes, cache=gradient)
            values |= {pass_.view.scale: pass_.values for pass_ in passes}
            gradients = self._backward(passes) if gradient else []
            for pass_, pixel_gradient in zip(passes, gradients, strict=gradient):
                fraction = weights[pass_.view.scale] / self.network.loss_factor
                images.add_gradient(pass_.view.scale, pixel_gradient, fraction)
        stacked = torch.stack(list(values.values())) / self.network.loss_factor
        return SosResult(tuple(values), stacked, images.gradient() if gradient else None, self.weights)

    def _division(self, view: ViewTarget, sizes: Mapping[int, parallel.Size]) -> parallel.Division:
        if view.division is not None and view.division.tiles.keys() == sizes.keys():
            return view.division
        if view.division is not None and view.division.shares is not None:
            raise ValueError(f"the view was prepared for the scales {[*view.division.tiles]}, not {[*sizes]}")
        return self.divider.divide(sizes, view.coverage)

    def _pass(
        self, scaled: parallel.ScaledView, tiles: list[PartitionTile], style: Sequence[StyleTarget], view: ViewTarget
    ) -> _ScalePass:
        regions, terms = _styled_regions(style, view), list[PositionTerm]()
        if self.content_weight:
            terms.append(ContentTerm.of(scaled, self.network, self.content_weight, view))
        if self.matched and any(region.vectors is not None for region in regions):
            terms.append(NearestTerm.of(scaled, self.network, self._style_loss, regions, self.timer))
        return _ScalePass(scaled, tiles, StatisticsTerms(scaled, self.network, regions, self.compared), terms)

    def _collect(self, passes: Sequence[_ScalePass], *, cache: bool) -> None:
        """Run the first pass of some scales, and set the values of their terms.

        The ranks' statistics of all these scales are merged together, so that ranks wait for each other only once.
        """
        collected: list[list[LayerStatistics]] = []
        numbers: list[Tensor] = []
        fits = iter(self.tiling.cached([tile.outer.pixels for pass_ in passes for tile in pass_.tiles]))
        for pass_ in passes:
            statistics: list[LayerStatistics] = []
            values = dict.fromkeys(TERMS, torch.zeros((), dtype=torch.float64, device=self.network.device))
            for tile in pass_.tiles:
                cache_this = next(fits) and cache
                activations = self._forward(pass_, tile, cache=cache_this)
                with self.timer("statistics"):
                    own = pass_.statistics.statistics(tile, activations.features)
                    statistics = [merge(*pair) for pair in zip(statistics, own, strict=True)] if statistics else own
                    for term in pass_.terms:
                        values[term.name] = values[term.name] + term.value(tile, activations.features)
                if cache_this:
                    pass_.cached[tile] = activations
            collected.append(statistics or pass_.statistics.zero())
            numbers += values.values()
        with self.timer("communication"):
            every = [each for own in collected for each in own]
            merged, sums = self.collectives.all_reduce_statistics(every, torch.stack(numbers))
        parts = iter(merged)
        with self.timer("statistics"):
            for pass_, own, added in zip(passes, collected, sums.split(len(TERMS)), strict=True):
                compared = pass_.statistics.compare([next(parts) for _ in own])
                values = dict(zip(TERMS, added.unbind(), strict=True)) | compared
                pass_.values = torch.stack(list(values.values()))

    def _backward(self, passes: Sequence[_ScalePass]) -> list[Tensor]:
        """Return the gradient of each scale with respect to the pixels [h, w, 3] of its view.

        Tiles with cached activations are processed first, which frees memory for tiles that have to be recomputed.
        """
        dtype = torch.promote_types(self.network.dtype, torch.float32)
        results = [torch.zeros(pass_.view.image.shape, dtype=dtype, device=self.network.device) for pass_ in passes]
        uncached = [[tile for tile in pass_.tiles if tile not in pass_.cached] for pass_ in passes]
        for pass_, result in zip(passes, results, strict=True):
            while pass_.cached:
                tile = next(iter(pass_.cached))
                self._backward_tile(pass_, tile, pass_.cached.pop(tile), result)
        for pass_, result, tiles in zip(passes, results, uncached, strict=True):
            for tile in tiles:
                self._backward_tile(pass_, tile, self._forward(pass_, tile), result)
        return results

    def _backward_tile(self, pass_: _ScalePass, tile: PartitionTile, activations: Activations, result: Tensor) -> None:
        """Add the pixel gradient of a tile to that of its scale, starting from the features that the tile owns."""

        def add(layer: str, features: Tensor, gradient: Tensor) -> bool:
            with self.timer("statistics"):
                passed = pass_.statistics.add_gradient(tile, layer, features, gradient)
                for term in pass_.terms:
                    added = term.add_gradient(tile, layer, features, gradient)
                    passed = passed if added is None else added
            return passed

        with self.timer("vgg_backward"):
            result[tile.outer.within(pass_.view.area).slices] += self.network.backward(activations, add)

    def _forward(self, pass_: _ScalePass, tile: PartitionTile, *, cache: bool = True) -> Activations:
        with self.timer("vgg_forward"):
            return self.network.forward(pass_.view.pixels(tile.outer), cache=cache)


@dataclass
class _ScalePass:
    """Evaluation of one scale.

    Attributes:
        values: [terms] float64, value of each of `TERMS`; set after the first pass.
        cached: Activations of the first pass by tile, as far as they are cached.
    """

    view: parallel.ScaledView
    tiles: list[PartitionTile]
    statistics: StatisticsTerms
    terms: list[PositionTerm]
    values: Tensor = field(init=False)
    cached: dict[PartitionTile, Activations] = field(default_factory=dict)


def make_loss(
    network: FeatureNetwork,
    settings: Settings,
    memory: int,
    *,
    content_weight: float | None = None,
    timer: Timer | None = None,
    collectives: parallel.Collectives = parallel.ALONE,
) -> SosLoss:
    """Create the loss of a job.

    Args:
        content_weight: Largest content weight of a region; None for that of the settings.
    """
    return SosLoss(
        network,
        content_weight=settings.content_weight if content_weight is None else content_weight,
        style_loss=settings.style_loss,
        memory=memory,
        coarsest=settings.coarsest_side,
        style_scale=settings.style_scale,
        scales=ScaleWeights(settings.scales),
        timer=timer,
        collectives=collectives,
    )


def _styled_regions(style: Sequence[StyleTarget], view: ViewTarget) -> list[StyleTarget]:
    """Return the regions of a view; without regions, the whole view is the only one."""
    if view.regions is None and len(style) == 1:
        return [replace(style[0], positions=view.coverage)]
    pairs = zip(style, view.regions or (), strict=True)
    return [replace(own, positions=weights) for own, weights in pairs if own.weight]


class TargetBuilder:
    """Builder of the targets of styles and views for one loss."""

    def __init__(self, loss: SosLoss) -> None:
        self._loss = loss

    def of_style(self, style: Style, view_size: parallel.Size) -> StyleTargets:
        """Compute the targets of a style at all scales with a positive weight.

        If a style image is so small that a layer's feature map is empty at some scale, the layer is not compared at
        that scale. With several images, the layer's target is computed from those with a feature map.

        Raises:
            ImageError: If the loss matches features, and the style image is too small to have any.
        """
        pyramids = [self._style_pyramid(image, view_size) for image in style.images]
        layers = self._mixed_layers(pyramids, style.weights) if self._loss.compared else {}
        vectors = {
            scale: self._style_vectors([pyramid[scale] for pyramid in pyramids], style.weights) for scale in pyramids[0]
        }
        if self._loss.matched and all(each is None for each in vectors.values()):
            height, width = _size(pyramids[0][min(pyramids[0])])  # from the scales with a positive weight
            raise ImageError(
                f"The style is used at {width} x {height} pixels, too few to match features with. "
                "Use a larger style image, larger views, or --style-loss sos."
            )
        return {scale: (StyleTarget(layers.get(scale, {}), each),) for scale, each in vectors.items()}

    def _style_pyramid(self, image: Tensor, view_size: parallel.Size) -> dict[int, Tensor]:
        """Return a style image at the scales that are evaluated for views of a given size, on the network's device."""
        size = style_size(_size(image), view_size, self._loss.style_scale)
        resized = resize_area(image, size).to(self._loss.network.device)
        return {scale: downscale(resized, scale) for scale in self._loss.divider.tiling.scales(view_size)}

    def _mixed_layers(
        self, pyramids: Sequence[Mapping[int, Tensor]], weights: Sequence[float]
    ) -> dict[int, dict[str, LayerTarget]]:
        """Compute the layer targets of a style at each scale, from the pyramids and weights of its images."""
        every = [self._style_statistics(pyramid) for pyramid in pyramids]
        mixed: dict[int, dict[str, LayerTarget]] = {}
        for scale in pyramids[0]:
            mixed[scale] = {}
            for layer in self._loss.compared:
                pairs = zip(every, weights, strict=True)
                some = [(own[scale][layer], weight) for own, weight in pairs if layer in own[scale]]
                if some:
                    mixed[scale][layer] = LayerTarget.mixed(*zip(*some, strict=True))
        return mixed

    def _style_statistics(self, scaled: Mapping[int, Tensor]) -> dict[int, dict[str, LayerTarget]]:
        """Compute the layer targets of a style image, given as images [h, w, 3] by scale.

        The work is divided among the ranks.
        """
        division = self._loss.divider.divide({scale: _size(image) for scale, image in scaled.items()})
        targets: dict[int, dict[str, LayerTarget]] = {}
        for scales in parallel.rounds(list(scaled), self._loss.collectives.size):
            every = [each for scale in scales for each in self._own_statistics(scaled[scale], division.tiles[scale])]
            with self._loss.timer("communication"):
                numbers = torch.zeros(0, dtype=torch.float64, device=every[0].mean.device)
                parts = iter(self._loss.collectives.all_reduce_statistics(every, numbers)[0])
            for scale in scales:
                statistics = {layer: next(parts) for layer in self._loss.compared}
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
            with self._loss.timer("statistics"):
                own = [layer_statistics(features[c][tile.owned_cells(c, size)[1].slices]) for c in self._loss.compared]
                total = [merge(*pair) for pair in zip(total, own, strict=True)] if total else own
        channels = map(self._loss.network.channels, self._loss.compared)
        return total or [LayerStatistics.zero(count, device) for count in channels]

    def _style_vectors(self, images: Sequence[Tensor], weights: Sequence[float]) -> StyleVectors | None:
        """Compute the style vectors of weighted images [h, w, 3] at one scale.

        The vectors of all images are pooled; if there are too many, each image contributes in proportion to its weight.
        The vectors are too large to send, so every rank computes all of them.

        Returns:
            Style vectors; None if the loss matches no features, or the images are too small to have any.
        """
        if not self._loss.matched:
            return None
        stride = layer_stride(self._loss.matched[0])
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
            {layer: torch.cat([each[layer] for each in vectors]).to(images[0].device) for layer in self._loss.matched}
        )

    def _vectors_of(self, image: Tensor, positions: Tensor) -> dict[str, Tensor]:
        """Return the features [k, c] of an image [h, w, 3] at some positions of the matched layers, on the CPU."""
        size = _size(image)
        width = size[1] // layer_stride(self._loss.matched[0])
        vectors = {
            layer: torch.empty((len(positions), self._loss.network.channels(layer)), dtype=self._loss.network.dtype)
            for layer in self._loss.matched
        }
        for tile in self._loss.tiling.tiles(size):
            features = self._forward(image[tile.outer.slices]).features
            in_image, in_tile = tile.owned_cells(self._loss.matched[0], size)
            inside, row, column = positions_in(positions, width, in_image)
            for layer, values in vectors.items():
                values[inside] = features[layer][in_tile.slices].cpu()[row, column]
        return vectors

    def of_view(self, content: Tensor, coverage: Tensor | None = None) -> ViewTarget:
        """Compute the targets of a view.

        Args:
            content: Content image [H, W, 3] in 0..1.
            coverage: [H, W] in 0..1; None for equal weights.
        """
        height, width = _size(content)
        weights = None if coverage is None else self.position_weights(coverage)
        scales = self._loss.divider.tiling.scales((height, width))
        division = self._loss.divider.divide({scale: (height >> scale, width >> scale) for scale in scales}, weights)
        target, device = ViewTarget(coverage=weights, division=division), self._loss.network.device
        if self._loss.content_weight > 0:
            target.content = {
                scale: self.content_features(parallel.ScaledView.of(downscale(content.to(device), scale), scale), tiles)
                for scale, tiles in division.tiles.items()
            }
        return target

    def position_weights(self, coverage: Tensor) -> list[Tensor]:
        """Downscale coverage [H, W] in 0..1 by every power of two that a layer needs at some scale."""
        coarsest = self._loss.divider.tiling.scales(_size(coverage))[-1]
        levels = coarsest + 1 + layer_stride("relu5_1").bit_length()
        finest = coverage.to(self._loss.network.device, torch.promote_types(self._loss.network.dtype, torch.float32))
        return [downscale(finest, level) for level in range(levels)]

    def content_features(self, content: parallel.ScaledView, tiles: Sequence[PartitionTile]) -> ContentFeatures:
        """Compute the content features of a scale of a content image, on the cells owned by some tiles."""
        result = {}
        for tile in tiles:
            cells = tile.owned_cells(CONTENT_LAYER, content.size)[1]
            features = self._forward(content.pixels(tile.outer), CONTENT_LAYER).features[CONTENT_LAYER]
            result[tile] = features[cells.slices].clone()  # a slice would keep the features of the halo alive too
        return result

    def content_bytes(self, pieces: Sequence[Sequence[parallel.Piece]]) -> int:
        """Return the maximum size over all ranks of the `content_features` of a scale, in bytes."""
        value = torch.finfo(self._loss.network.dtype).bits // 8 * self._loss.network.channels(CONTENT_LAYER)
        return max(sum(piece.cells(CONTENT_LAYER) for piece in own) for own in pieces) * value

    def _forward(self, pixels: Tensor, until: str | None = None) -> Activations:
        with self._loss.timer("vgg_forward"):
            return self._loss.network.forward(pixels, cache=False, until=until)


def _size(image: Tensor) -> parallel.Size:
    return image.shape[0], image.shape[1]
