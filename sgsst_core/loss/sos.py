"""SOS loss of one view, E = (1/n_s) sum_s E_transfer(scale s), and its gradient with respect to the pixels.

Each scale goes through the network in partition tiles, in two passes: the first collects statistics of the whole scale,
the second back-propagates the loss computed from them. Activations of the first pass are cached as far as the memory
budget allows; only the remaining tiles are computed twice. With several ranks, each processes its own tiles
(`division`).
"""

from __future__ import annotations

import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce

import torch
from torch import Tensor

from sgsst_core.constants import COARSEST_SHORTER_SIDE
from sgsst_core.errors import ImageError
from sgsst_core.features.fused_statistics import can_be_fused, fused_statistics
from sgsst_core.features.partition import PartitionTile, Rectangle, covered_region, scaled_region
from sgsst_core.features.statistics import LayerStatistics, layer_statistics, merge
from sgsst_core.features.vgg import (
    CONTENT_LAYER,
    PIXELS,
    STYLE_LAYERS,
    Activations,
    FeatureGradient,
    FeatureNetwork,
    layer_stride,
)
from sgsst_core.loss.nearest import Matches, StyleVectors, chosen_places, places_in, positions_per_image
from sgsst_core.loss.scale_weights import EVEN, ScaleWeights
from sgsst_core.loss.style_losses import has_statistics, nearest_layers, nearest_weight, term_weights
from sgsst_core.loss.terms import (
    TERMS,
    ContentDifference,
    LayerTarget,
    LossTerms,
    StyleGradient,
    content_factor,
    style_loss,
)
from sgsst_core.loss.tiling import Tiling
from sgsst_core.parallel.collectives import ALONE, Collectives, Merged
from sgsst_core.parallel.division import Piece, Size, divide, rounds
from sgsst_core.scene.pyramid import (
    add_upscaled_,
    coverage_pyramid,
    downscale,
    style_size,
)
from sgsst_core.settings import StyleLossName
from sgsst_core.style import Style
from sgsst_core.timing import Timer

#: Default memory budget for activations in bytes; leaves most of a laptop's memory free.
DEFAULT_MEMORY = 4 << 30


@dataclass(frozen=True)
class ScaleTarget:
    """Style target of one scale.

    Attributes:
        layers: Statistics by layer, for compared layers with at least one cell at this scale.
        vectors: Style vectors for nearest-neighbor matching; None if the loss matches no features.
        regions: Targets of the scene's regions, which replace `layers` and `vectors`; empty if the scene has no
            regions.
    """

    layers: Mapping[str, LayerTarget]
    vectors: StyleVectors | None = None
    regions: tuple[RegionTarget, ...] = ()


@dataclass(frozen=True)
class RegionTarget:
    """Style target of one region at one scale, and the weight of its loss."""

    style: ScaleTarget
    weight: float = 1.0


@dataclass(frozen=True)
class SosResult:
    """Result of one evaluation.

    Attributes:
        scales: Evaluated scales.
        values: [scales, 5] float64, the loss of each scale split into `TERMS`, still on the device.
        image_gradient: This rank's summand of dE/dimage, [H, W, 3]; the sum over all ranks is the gradient. None if
            only the loss was requested.
        weights: Weights of the scales in the loss.
    """

    scales: tuple[int, ...]
    values: Tensor
    image_gradient: Tensor | None
    weights: ScaleWeights = EVEN

    @property
    def terms(self) -> dict[int, LossTerms]:
        """Loss of each scale, split into terms. Synchronizes with the device."""
        return self.terms_from(self.values.flatten().tolist())

    def terms_from(self, values: Sequence[float]) -> dict[int, LossTerms]:
        """Return the loss of each scale, split into terms, from `values` flattened row by row."""
        count = len(TERMS)
        return {s: LossTerms.of(values[place * count :][:count]) for place, s in enumerate(self.scales)}

    @property
    def loss(self) -> float:
        """E, the weighted mean over the evaluated scales. Synchronizes with the device."""
        return self.weights.mean({scale: part.total for scale, part in self.terms.items()})


@dataclass(frozen=True)
class Share:
    """Division of the work on some scales of a view among ranks.

    Attributes:
        pieces: For each scale, the pieces of every rank; identical on all ranks.
        tiles: Partition tiles of this rank by scale.
    """

    pieces: dict[int, tuple[tuple[Piece, ...], ...]]
    tiles: dict[int, list[PartitionTile]]

    def cost(self, rank: int, halo: int) -> int:
        """Return the number of pixels that a rank passes through the network."""
        return sum(piece.cost(halo) for every in self.pieces.values() for piece in every[rank])


#: Content features [h, w, 512] of the cells owned by each partition tile of this rank.
ContentFeatures = dict[PartitionTile, Tensor]


@dataclass
class ViewTarget:
    """Targets of a view, apart from the style.

    Attributes:
        content_image: Content image [H, W, 3] from which uncached content features are computed; None if they are not
            needed.
        content: Cached content features by scale.
        coverage: Position weights [H >> k, W >> k] for each power of two 2^k; None for equal weights.
        share: Division of work for which the content was prepared; None to divide the work in every evaluation.
        regions: Position weights of each region (its fraction of the blend weights), in the format of `coverage` and
            the order of `ScaleTarget.regions`. None if the scene has no regions.
    """

    content_image: Tensor | None = None
    content: dict[int, ContentFeatures] = field(default_factory=dict)
    coverage: list[Tensor] | None = None
    share: Share | None = None
    regions: list[list[Tensor]] | None = None


@dataclass(frozen=True)
class _Part:
    """Weighted set of positions of a scale, and the style to compare them with.

    Attributes:
        weights: Position weights in the format of `ViewTarget.coverage`; None for equal weights.
        style: Style target; None if only statistics are needed.
        factor: Factor of the part's loss.
    """

    weights: Sequence[Tensor] | None
    style: ScaleTarget | None = None
    factor: float = 1.0

    @staticmethod
    def of(view: ViewTarget, style: ScaleTarget) -> list[_Part]:
        """Return one part per region; if there are no regions, return one part for the whole view."""
        if not style.regions:
            return [_Part(view.coverage, style)]
        if view.regions is None or len(view.regions) != len(style.regions):
            raise ValueError("the view was not prepared for the regions that the style has")
        pairs = zip(view.regions, style.regions, strict=True)
        return [_Part(weights, region.style, region.weight) for weights, region in pairs]


class SosLoss:
    """SOS loss of views against one style.

    Args:
        network: Feature network. It must report the layers of `style_losses.layers_of`; statistics of style layers and
            `PIXELS` are compared only if the network reports them.
        content_weight: lambda_c; 0 disables the content term.
        style_loss: Style loss; see `style_losses`.
        memory: Memory budget for activations in bytes.
        tile_size: Side of partition tiles, a multiple of 16; None to choose it from the memory budget.
        coarsest: Maximum shorter side of the coarsest scale in pixels.
        style_scale: Magnification of the style image relative to its default size.
        scales: Weights of the pyramid's scales; those of weight 0 are not computed.
        leave_out: Whether the network skips pixels of weight 0. False is meant for comparisons.
        keep_activations: Whether to cache as many activations as fit between the two passes. False computes each tile
            twice; it is meant for comparisons.
        timer: Timer for `vgg_forward`, `vgg_backward`, `statistics`, `matching` and `communication`.
        collectives: Collectives of the ranks that evaluate each view together. All ranks must call the same methods
            with the same arguments.

    Attributes:
        speeds: Relative speeds of the ranks; work is divided in proportion to them.
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
        leave_out: bool = True,
        keep_activations: bool = True,
        timer: Timer | None = None,
        collectives: Collectives = ALONE,
    ) -> None:
        self.network = network
        self.content_weight = content_weight
        self.memory = memory
        self.tile_size = tile_size
        self.coarsest = coarsest
        self.style_scale = style_scale
        self.leave_out = leave_out
        held = network.held_bytes_per_pixel()
        working = network.working_bytes_per_pixel() / held
        self.weights = scales
        self.tiling = Tiling(network.halo, memory / held, working, coarsest, tile_size, keep_activations, scales)
        self.timer = timer or Timer()
        self.collectives = collectives
        self.speeds = (1.0,) * collectives.size
        statistics = (PIXELS, *STYLE_LAYERS) if has_statistics(style_loss) else ()
        self.style_layers = [layer for layer in statistics if layer in network.layers]
        self.nearest_layers = nearest_layers(style_loss, network.name)
        self.nearest_weight = nearest_weight(style_loss, network.unit)

    def scale_count(self, height: int, width: int) -> int:
        """Return n_s for views of a size."""
        return self.tiling.scale_count((height, width))

    def scales(self, height: int, width: int) -> list[int]:
        """Return the scales with a positive weight for views of a size, finest first."""
        return self.tiling.scales((height, width))

    def tiles(self, height: int, width: int, coverage: Tensor | None = None) -> list[PartitionTile]:
        """Return the partition tiles of a scaled view.

        If `coverage` [h, w] is given, pixels with coverage 0 may not belong to any tile.
        """
        return self._partition(self._piece(0, (height, width), coverage), coverage)

    def share(
        self,
        sizes: Mapping[int, Size],
        coverage: Sequence[Tensor] | None = None,
        region: Rectangle | None = None,
    ) -> Share:
        """Divide the work on some scales of a view among the ranks.

        Args:
            sizes: (height, width) of each scale.
            coverage: Result of `position_weights`; None for equal weights.
            region: Rectangle of the full-size view that contains every covered pixel. If it is given, `coverage` is not
                read, which avoids synchronizing with the device. The pieces of coarser scales may then be a few cells
                larger.
        """
        look = coverage if region is None else None
        weights = {scale: look[scale] if look else None for scale in sizes}
        if region is None or not self.leave_out:
            pieces = tuple(self._piece(scale, size, weights[scale]) for scale, size in sizes.items())
        else:
            pieces = tuple(Piece(scale, size, scaled_region(region, scale, size)) for scale, size in sizes.items())
        shares = divide(pieces, self.network.halo, self.speeds)
        own = shares[self.collectives.rank]
        return Share(
            {scale: tuple(tuple(part for part in each if part.scale == scale) for each in shares) for scale in sizes},
            {
                scale: [tile for part in own if part.scale == scale for tile in self._partition(part, weights[scale])]
                for scale in sizes
            },
        )

    def _piece(self, scale: int, size: Size, coverage: Tensor | None) -> Piece:
        """Return the piece of one scale that contains all pixels that the network has to process."""
        if coverage is None or not self.leave_out:
            return Piece(scale, size, Rectangle(0, 0, *size))
        return Piece(scale, size, covered_region(coverage))

    def _partition(self, piece: Piece, coverage: Tensor | None) -> list[PartitionTile]:
        """Return the covered partition tiles of a piece, as large as the memory budget allows."""
        tiles = self.tiling.tiles(piece.size, piece.region)
        if coverage is None or not self.leave_out:
            return tiles
        return [tile for tile in tiles if coverage[tile.inner.slices].any()]

    def style_targets(self, style: Tensor | Style, view_size: Size) -> dict[int, ScaleTarget]:
        """Compute the style targets of all scales with a positive weight.

        If a style image is so small that a layer's feature map is empty at some scale, the layer is not compared at
        that scale. In a mixture, the layer's target is computed from the images with a feature map.

        Args:
            style: Image [H, W, 3] in 0..1, or a mixture of images.
            view_size: (height, width) of the views.

        Raises:
            ImageError: If the loss matches features, and the style image is too small to have any.
        """
        mixture = Style.of(style)
        pyramids = [self._style_pyramid(picture, view_size) for picture in mixture.images]
        layers = self._mixed_layers(pyramids, mixture.weights) if self.style_layers else {}
        vectors = {
            scale: self._style_vectors([pyramid[scale] for pyramid in pyramids], mixture.weights)
            for scale in pyramids[0]
        }
        if self.nearest_layers and all(found is None for found in vectors.values()):
            height, width = _size(pyramids[0][min(pyramids[0])])  # from the scales with a positive weight
            raise ImageError(
                f"The style is used at {width} x {height} pixels, too few to match features with. "
                "Use a larger style image, larger views, or --style-loss sos."
            )
        return {scale: ScaleTarget(layers.get(scale, {}), found) for scale, found in vectors.items()}

    def _style_pyramid(self, picture: Tensor, view_size: Size) -> dict[int, Tensor]:
        """Return a style image at the scales that are evaluated for views of a given size, on the network's device."""
        size = style_size(_size(picture), view_size, self.style_scale)
        image = resize_area(picture, size).to(self.network.device)
        return {scale: downscale(image, scale) for scale in self.scales(*view_size)}

    def _mixed_layers(
        self, pyramids: Sequence[Mapping[int, Tensor]], weights: Sequence[float]
    ) -> dict[int, dict[str, LayerTarget]]:
        """Compute the layer targets of a mixture at each scale, from the pyramids and weights of its images."""
        every = [self._style_statistics(pyramid) for pyramid in pyramids]
        mixed: dict[int, dict[str, LayerTarget]] = {}
        for scale in pyramids[0]:
            mixed[scale] = {}
            for layer in self.style_layers:
                pairs = zip(every, weights, strict=True)
                some = [(own[scale][layer], weight) for own, weight in pairs if layer in own[scale]]
                if some:
                    mixed[scale][layer] = LayerTarget.mixed(
                        [target for target, _ in some], [weight for _, weight in some]
                    )
        return mixed

    def _style_statistics(self, scaled: Mapping[int, Tensor]) -> dict[int, dict[str, LayerTarget]]:
        """Compute the layer targets of a style image, given as images [h, w, 3] by scale.

        The work is divided among the ranks.
        """
        share = self.share({scale: _size(picture) for scale, picture in scaled.items()})
        targets: dict[int, dict[str, LayerTarget]] = {}
        for scales in rounds(list(scaled), self.collectives.size):
            passes = [_ScalePass(self, scaled[s], s, share.tiles[s], ViewTarget(), None, [_Part(None)]) for s in scales]
            for pass_, merged in zip(passes, self._first_passes(passes, keep=False)[0], strict=True):
                parts = zip(self.style_layers, self._wait(merged)[0], strict=True)
                targets[pass_.scale] = {
                    layer: LayerTarget.of(part) for layer, part in parts if min(pass_.size) >= layer_stride(layer)
                }
        return targets

    def _style_vectors(self, images: Sequence[Tensor], weights: Sequence[float]) -> StyleVectors | None:
        """Compute the style vectors of weighted images [h, w, 3] at one scale.

        The vectors of all images are pooled; if there are too many, each image contributes in proportion to its weight.
        The vectors are too large to send, so every rank computes all of them.

        Returns:
            Style vectors; None if the loss matches no features, or the images are too small to have any.
        """
        if not self.nearest_layers:
            return None
        stride = layer_stride(self.nearest_layers[0])
        counts = [(size[0] // stride) * (size[1] // stride) for size in map(_size, images)]
        most = positions_per_image(counts, weights)
        parts = [
            self._vectors_of(image, chosen_places(count, some))
            for image, count, some in zip(images, counts, most, strict=True)
            if count
        ]
        if not parts:
            return None
        return StyleVectors.of(
            {layer: torch.cat([part[layer] for part in parts]).to(images[0].device) for layer in self.nearest_layers}
        )

    def _vectors_of(self, image: Tensor, places: Tensor) -> dict[str, Tensor]:
        """Return the features [k, c] of an image [h, w, 3] at some positions of the matched layers, on the CPU."""
        size = _size(image)
        width = size[1] // layer_stride(self.nearest_layers[0])
        vectors = {
            layer: torch.empty((len(places), self.network.channels(layer)), dtype=self.network.dtype)
            for layer in self.nearest_layers
        }
        for tile in self._partition(Piece(0, size, Rectangle(0, 0, *size)), None):
            features = self._forward(image, tile, keep=False).features
            view, own = tile.owned_cells(self.nearest_layers[0], size)
            inside, row, column = places_in(places, width, view)
            for layer, found in vectors.items():
                found[inside] = features[layer][own.slices].cpu()[row, column]
        return vectors

    def view_target(self, content: Tensor, coverage: Tensor | None = None, *, keep_content: bool = True) -> ViewTarget:
        """Prepare the targets of a view.

        Args:
            content: Content image [H, W, 3] in 0..1.
            coverage: [H, W] in 0..1; None for equal weights.
            keep_content: Whether to compute and cache the content features now, instead of in every evaluation.
        """
        weights = None if coverage is None else self.position_weights(coverage)
        share = self.share(self._sizes(_size(content)), weights)
        target = ViewTarget(content_image=content, coverage=weights, share=share)
        if self.content_weight and keep_content:
            target.content = {
                scale: self.content_features(content, scale, tiles) for scale, tiles in share.tiles.items()
            }
            target.content_image = None
        return target

    def _sizes(self, size: Size, scales: Sequence[int] | None = None, image_scale: int = 0) -> dict[int, Size]:
        """Return (height, width) of some scales of a view, given its size at `image_scale`.

        `scales` is None for all scales with a positive weight.
        """
        scales = self.scales(*size) if scales is None else scales
        return {scale: (size[0] >> scale - image_scale, size[1] >> scale - image_scale) for scale in scales}

    def position_weights(self, coverage: Tensor) -> list[Tensor]:
        """Downscale coverage [H, W] in 0..1 by every power of two that a layer needs at some scale."""
        coarsest = self.scales(coverage.shape[0], coverage.shape[1])[-1]
        levels = coarsest + 1 + layer_stride("relu5_1").bit_length()
        return coverage_pyramid(coverage.to(self.network.device, _gradient_dtype(self.network)), levels)

    def content_features(self, content: Tensor, scale: int, tiles: Sequence[PartitionTile]) -> ContentFeatures:
        """Compute the content features of a content image [H, W, 3] at a scale, on the cells owned by some tiles."""
        image = downscale(content.to(self.network.device), scale)
        result = {}
        for tile in tiles:
            own = tile.owned_cells(CONTENT_LAYER, _size(image))[1]
            # Copy: a slice would keep the features of the halo alive too.
            result[tile] = self._forward(image, tile, keep=False).features[CONTENT_LAYER][own.slices].clone()
        return result

    def content_bytes(self, pieces: Sequence[Sequence[Piece]]) -> int:
        """Return the maximum size over all ranks of the `content_features` of a scale, in bytes.

        Args:
            pieces: Pieces of the scale for every rank.
        """
        value = torch.finfo(self.network.dtype).bits // 8 * self.network.channels(CONTENT_LAYER)
        cells = [sum(part.cells(CONTENT_LAYER) for part in own) for own in pieces]
        return max(cells) * value

    def evaluate(
        self,
        image: Tensor,
        style: Mapping[int, ScaleTarget],
        view: ViewTarget,
        scales: Sequence[int] | None = None,
        *,
        gradient: bool = True,
        image_scale: int = 0,
    ) -> SosResult:
        """Compute the loss of an image [H, W, 3] (0..1, not clamped) and dE/dimage.

        Args:
            image: Image of the view at scale `image_scale`.
            style: Style targets by scale, from `style_targets`.
            view: View targets from `view_target`.
            scales: Scales to evaluate, each with a positive weight and none finer than the image; phase 1 passes only
                the coarsest. None for the full SOS loss of a full-size image.
            gradient: Whether to compute the gradient.
            image_scale: Scale of the image; 0 is full size.
        """
        sizes = self._sizes(_size(image), scales, image_scale)
        share, weights = self._share_of(view, sizes), self.weights.shares(sizes)
        total = torch.zeros(image.shape, dtype=_gradient_dtype(self.network), device=self.network.device)
        terms: dict[int, Tensor] = {}
        for some in rounds(list(sizes), self.collectives.size):
            scaled = {scale: downscale(image.to(self.network.device), scale - image_scale) for scale in some}
            for pass_, pixel_gradient in self._round(scaled, style, view, share, gradient):
                terms[pass_.scale] = pass_.terms
                if pixel_gradient is not None:
                    add_upscaled_(total, pixel_gradient, pass_.scale - image_scale, weights[pass_.scale])
        values = torch.stack(list(terms.values()))
        return SosResult(tuple(terms), values, total if gradient else None, self.weights)

    def _share_of(self, view: ViewTarget, sizes: Mapping[int, Size]) -> Share:
        if view.share is not None and view.share.tiles.keys() == sizes.keys():
            return view.share
        return self.share(sizes, view.coverage)

    def _round(
        self,
        scaled: Mapping[int, Tensor],
        style: Mapping[int, ScaleTarget],
        view: ViewTarget,
        share: Share,
        gradient: bool,
    ) -> Iterator[tuple[_ScalePass, Tensor | None]]:
        """Evaluate some scales together; yield the pass of each scale and its pixel gradient [h, w, 3].

        Ranks start merging the statistics of all these scales before the first backward pass. If `gradient` is False,
        the pixel gradients are None.
        """
        passes = [
            _ScalePass(
                self,
                image,
                scale,
                share.tiles[scale],
                view,
                self._content(view, scale, share.tiles[scale]),
                _Part.of(view, style[scale]),
            )
            for scale, image in scaled.items()
        ]
        merged, kept = self._first_passes(passes, keep=gradient)
        for pass_, waiting in zip(passes, merged, strict=True):
            parts, pass_.terms = self._wait(waiting)
            with self.timer("statistics"):
                layers = len(self.style_layers)
                for place, part in enumerate(pass_.parts):
                    own = parts[place * layers : (place + 1) * layers]
                    self._compare(pass_, part, dict(zip(self.style_layers, own, strict=True)))
        yield from zip(passes, self._backward(passes, kept) if gradient else [None] * len(passes), strict=True)

    def _wait(self, merged: Merged) -> tuple[list[LayerStatistics], Tensor]:
        with self.timer("communication"):
            return merged()

    def _compare(self, pass_: _ScalePass, part: _Part, statistics: Mapping[str, LayerStatistics]) -> None:
        """Add the style loss of a part and its gradient maps to the pass, given statistics of the whole scale."""
        style = part.style.layers if part.style else {}
        for layer, found in statistics.items():
            if layer in style:
                rounding, weights = self.network.rounding_of(layer), term_weights(layer, self.network.pixel_weight)
                layer_terms, gradient = style_loss(found, style[layer], feature_eps=rounding, weights=weights)
                if layer == PIXELS and gradient.matrix.dtype == torch.float64:  # the GPU kernels already do this
                    gradient = gradient.about_rounded_mean()
                if part.factor != 1:
                    layer_terms, gradient = part.factor * layer_terms, gradient.times(part.factor)
                pass_.terms = pass_.terms + layer_terms
                pass_.maps.setdefault(layer, []).append((gradient, part))

    def _backward(self, passes: Sequence[_ScalePass], kept: list[dict[PartitionTile, Activations]]) -> list[Tensor]:
        """Return the pixel gradient [h, w, 3] of each scale.

        Tiles with cached activations are processed first, which frees memory for tiles that have to be recomputed.
        """
        dtype = _gradient_dtype(self.network)
        results = [torch.zeros(pass_.image.shape, dtype=dtype, device=pass_.image.device) for pass_ in passes]
        again = [[tile for tile in pass_.tiles if tile not in own] for pass_, own in zip(passes, kept, strict=True)]
        for pass_, result, own in zip(passes, results, kept, strict=True):
            while own:
                tile = next(iter(own))
                self._backward_tile(pass_, tile, own.pop(tile), result)
        for pass_, result, tiles in zip(passes, results, again, strict=True):
            for tile in tiles:
                self._backward_tile(pass_, tile, self._forward(pass_.image, tile), result)
        return results

    def _backward_tile(self, pass_: _ScalePass, tile: PartitionTile, activations: Activations, result: Tensor) -> None:
        with self.timer("vgg_backward"):
            result[tile.outer.slices] += self.network.backward(activations, pass_.feature_gradient(tile))

    def _content(self, view: ViewTarget, scale: int, tiles: Sequence[PartitionTile]) -> ContentFeatures | None:
        if not self.content_weight:
            return None
        if scale in view.content:
            return view.content[scale]
        if view.content_image is None:
            raise ValueError("the view was prepared without content, but content_weight is not 0")
        return self.content_features(view.content_image, scale, tiles)

    def _first_passes(
        self, passes: Sequence[_ScalePass], *, keep: bool
    ) -> tuple[list[Merged], list[dict[PartitionTile, Activations]]]:
        """Run the first pass of some scales.

        Returns:
            For each scale, the pending merge of its statistics and terms, and the cached activations.
        """
        merged: list[Merged] = []
        kept: list[dict[PartitionTile, Activations]] = []
        fits = iter(self.tiling.kept([tile.outer.pixels for pass_ in passes for tile in pass_.tiles]))
        for pass_ in passes:
            parts: list[list[LayerStatistics]] = []
            terms = pass_.terms
            kept.append({})
            for tile in pass_.tiles:
                keep_this = next(fits) and keep
                activations = self._forward(pass_.image, tile, keep=keep_this)
                with self.timer("statistics"):
                    own = pass_.statistics(self.style_layers, tile, activations)
                    parts = [[merge(*pair) for pair in zip(parts[0], own, strict=True)]] if parts else [own]
                    terms = terms + pass_.tile_terms(tile, activations)
                if keep_this:
                    kept[-1][tile] = activations
            statistics = parts[0] if parts else len(pass_.parts) * self._no_statistics(pass_.image.device)
            merged.append(self.collectives.all_reduce_statistics(statistics, terms))
        return merged, kept

    def _no_statistics(self, device: torch.device) -> list[LayerStatistics]:
        """Return empty statistics, for a scale in which this rank has no tile."""
        return [LayerStatistics.zero(self.network.channels(layer), device) for layer in self.style_layers]

    def _forward(self, image: Tensor, tile: PartitionTile, *, keep: bool = True) -> Activations:
        with self.timer("vgg_forward"):
            return self.network.forward(image[tile.outer.slices], keep=keep)


class _ScalePass:
    """State shared by the tiles of one scale: pixels, weights and content, then the loss and its gradient maps.

    Each part is compared with its own style. The content term covers all positions.
    """

    def __init__(
        self,
        loss: SosLoss,
        image: Tensor,
        scale: int,
        tiles: list[PartitionTile],
        view: ViewTarget,
        content: ContentFeatures | None,
        parts: list[_Part],
    ) -> None:
        self.image = image
        self.scale = scale
        self.tiles = tiles
        self.size = _size(image)
        self.parts = parts
        self.maps: dict[str, list[tuple[StyleGradient, _Part]]] = {}
        self.matches: dict[PartitionTile, list[Matches]] = {}
        self.terms = torch.zeros(len(TERMS), dtype=torch.float64, device=image.device)
        self._coverage = view.coverage
        self._timer = loss.timer
        self._content = content
        if content is not None:
            count = self._all_positions(CONTENT_LAYER, view.coverage)
            self._content_factor = content_factor(count, loss.network.channels(CONTENT_LAYER), loss.content_weight)
        #: For each part with matched features: style vectors, factor of its distances, and the part.
        self._matched: list[tuple[StyleVectors, Tensor, _Part]] = []
        for part in parts if loss.nearest_layers else ():
            if part.style is not None and part.style.vectors is not None:
                self._nearest_layer = loss.nearest_layers[0]  # all matched layers have the same cells
                count = self._all_positions(self._nearest_layer, part.weights)
                factor = part.factor * loss.nearest_weight / torch.where(count > 0, count, torch.inf)
                self._matched.append((part.style.vectors, factor, part))
                self._rounding = loss.network.rounding

    def _all_positions(self, layer: str, pyramid: Sequence[Tensor] | None) -> Tensor:
        """Return the number of cells of a layer in the whole scale, or the sum of their weights, float64 scalar."""
        stride = layer_stride(layer)
        cells = Rectangle(0, 0, self.size[0] // stride, self.size[1] // stride)
        weights = self._weights(layer, cells, pyramid)
        if weights is not None:
            return weights.sum(dtype=torch.float64)
        return torch.full((), cells.pixels, dtype=torch.float64, device=self.image.device)

    def _weights(self, layer: str, cells: Rectangle, pyramid: Sequence[Tensor] | None) -> Tensor | None:
        """Return the weights [h, w] of some cells of a layer, as box averages; None for equal weights."""
        if pyramid is None:
            return None
        return pyramid[self.scale + layer_stride(layer).bit_length() - 1][cells.slices]

    def _is_nowhere(self, weights: Tensor | None) -> bool:
        """Return whether the weights of a region in some cells are known to be all 0.

        Weights on a GPU count as unknown, because reading them would synchronize with the device.
        """
        return len(self.parts) > 1 and weights is not None and not weights.is_cuda and not bool(weights.any())

    def statistics(self, layers: Sequence[str], tile: PartitionTile, activations: Activations) -> list[LayerStatistics]:
        """Return the statistics of the cells that a tile owns, ordered by part and then by layer."""
        found = []
        for part in self.parts:
            for layer in layers:
                view, own = tile.owned_cells(layer, self.size)
                owned, weights = activations.features[layer][own.slices], self._weights(layer, view, part.weights)
                if self._is_nowhere(weights):
                    found.append(LayerStatistics.zero(owned.shape[-1], owned.device))
                elif can_be_fused(owned):
                    found.append(fused_statistics(owned, weights))
                else:
                    found.append(layer_statistics(owned, weights))
        return found

    def tile_terms(self, tile: PartitionTile, activations: Activations) -> Tensor:
        """Return the tile's contribution [5] to terms that are sums over positions.

        The other terms need statistics of the whole scale.
        """
        content = self._content_difference(tile, activations.features.get(CONTENT_LAYER))
        nothing = torch.zeros_like(self.terms)
        sums = [None if content is None else content.loss(), self._match(tile, activations)]
        if sums == [None, None]:
            return nothing
        return torch.cat([nothing[2:], *(nothing[:1] if found is None else found[None] for found in sums)])

    def _match(self, tile: PartitionTile, activations: Activations) -> Tensor | None:
        """Match the cells that a tile owns, and return their contribution to the nearest-neighbor term.

        The matches are stored for the second pass: they take a few bytes per cell, while the search is slow.

        Returns:
            Float64 scalar; None if the loss matches no features.
        """
        if not self._matched:
            return None
        view, own = tile.owned_cells(self._nearest_layer, self.size)
        self.matches[tile] = []
        sums = []
        for vectors, factor, part in self._matched:
            weights = self._weights(self._nearest_layer, view, part.weights)
            features = {layer: activations.features[layer][own.slices] for layer in vectors.parts}
            with self._timer("matching"):
                found = Matches.of(features, vectors, self._rounding, weights)
                sums.append(factor * found.distance(weights))
            self.matches[tile].append(found)
        return reduce(operator.add, sums)

    def _content_difference(self, tile: PartitionTile, features: Tensor | None) -> ContentDifference | None:
        """Return the content difference on the cells that a tile owns, given the features of the whole tile.

        Return None if there is no content term.
        """
        if self._content is None or features is None:
            return None
        view, own = tile.owned_cells(CONTENT_LAYER, self.size)
        return ContentDifference.of(
            features[own.slices],
            self._content[tile],
            self._content_factor,
            self._weights(CONTENT_LAYER, view, self._coverage),
        )

    def feature_gradient(self, tile: PartitionTile) -> FeatureGradient:
        """Return a callback that adds dE/dfeatures of a tile to a gradient, on the cells that the tile owns."""

        def add(layer: str, features: Tensor, gradient: Tensor) -> None:
            view, own = tile.owned_cells(layer, self.size)
            with self._timer("statistics"):
                for found, part in self.maps.get(layer, ()):
                    weights = self._weights(layer, view, part.weights)
                    if not self._is_nowhere(weights):
                        found.add_to(gradient[own.slices], features[own.slices], weights)
                if layer == CONTENT_LAYER and (content := self._content_difference(tile, features)) is not None:
                    gradient[own.slices] += content.gradient()
                for place, (vectors, factor, part) in enumerate(self._matched):
                    if layer in vectors.parts:
                        weights = self._weights(layer, view, part.weights)
                        places = gradient[own.slices], features[own.slices]
                        self.matches[tile][place].add_gradient(*places, layer, vectors, factor, weights)

        return add


def resize_area(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Downscale an image [H, W, 3] to size (height, width) with an antialiasing filter."""
    if (image.shape[0], image.shape[1]) == size:
        return image
    planes = image.permute(2, 0, 1).unsqueeze(0)
    resized = torch.nn.functional.interpolate(planes, size=size, mode="bilinear", antialias=True, align_corners=False)
    return resized[0].permute(1, 2, 0).contiguous()


def _size(image: Tensor) -> Size:
    return image.shape[0], image.shape[1]


def _gradient_dtype(network: FeatureNetwork) -> torch.dtype:
    return torch.promote_types(network.dtype, torch.float32)
