"""The SOS loss of one view, E = (1/n_s) sum_s E_transfer(scale s), and its gradient with respect to the pixels.

Each scale goes through the network in partition tiles, in two passes: statistics of the whole scale first, then
back-propagation of the loss that they give. Activations of the first pass are kept as far as the memory budget
reaches; only tiles beyond it are computed twice. Of several ranks, each has its share of the tiles (`division`).
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
from sgsst_core.loss.mixture import StyleMixture, mixed_target, shares_of
from sgsst_core.loss.nearest import MOST_VECTORS, Matches, StyleVectors, chosen_places, places_in
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
from sgsst_core.timing import Timer

#: Bytes for activations where the caller names no budget: leaves most of a laptop to others.
DEFAULT_MEMORY = 4 << 30


@dataclass(frozen=True)
class ScaleTarget:
    """What the style asks of a scale.

    Attributes:
        layers: layer to its statistics, for those that are compared and have a cell at this scale.
        vectors: that positions are matched with; None where nothing is matched.
        regions: in place of both, what each region of the scene is compared with; empty where it has none.
    """

    layers: Mapping[str, LayerTarget]
    vectors: StyleVectors | None = None
    regions: tuple[RegionTarget, ...] = ()


@dataclass(frozen=True)
class RegionTarget:
    """What one region's style asks of a scale, and how much that counts."""

    style: ScaleTarget
    weight: float = 1.0


@dataclass(frozen=True)
class SosResult:
    """What one evaluation gives.

    Attributes:
        scales: that were evaluated.
        values: [scales, 5] float64, each scale's loss split into `TERMS`, still on the device.
        image_gradient: dE/dimage [H, W, 3], of which every rank has a part: they add up to the whole. None if only the
            loss was asked for.
        weights: of the scales in the loss.
    """

    scales: tuple[int, ...]
    values: Tensor
    image_gradient: Tensor | None
    weights: ScaleWeights = EVEN

    @property
    def terms(self) -> dict[int, LossTerms]:
        """The split loss of each scale. Waits for the device."""
        return self.terms_from(self.values.flatten().tolist())

    def terms_from(self, values: Sequence[float]) -> dict[int, LossTerms]:
        """The split loss of each scale, from `values` as they were read, row by row."""
        count = len(TERMS)
        return {s: LossTerms.of(values[place * count :][:count]) for place, s in enumerate(self.scales)}

    @property
    def loss(self) -> float:
        """E, the weighted mean over the scales that were evaluated. Waits for the device."""
        return self.weights.mean({scale: part.total for scale, part in self.terms.items()})


@dataclass(frozen=True)
class Share:
    """How some scales of a view are shared out.

    Attributes:
        pieces: scale to every rank's pieces of it; the same on every rank.
        tiles: scale to the partition tiles of this rank.
    """

    pieces: dict[int, tuple[tuple[Piece, ...], ...]]
    tiles: dict[int, list[PartitionTile]]

    def cost(self, rank: int, halo: int) -> int:
        """Pixels through the network on a rank."""
        return sum(piece.cost(halo) for every in self.pieces.values() for piece in every[rank])


#: Content features [h, w, 512] of the cells that each of this rank's partition tiles owns.
ContentFeatures = dict[PartitionTile, Tensor]


@dataclass
class ViewTarget:
    """What a view is compared with, apart from the style.

    Attributes:
        content: scale to content features, as far as they are kept.
        content_image: [H, W, 3], from which they can be computed again.
        coverage: position weights at powers of two, [H >> k, W >> k] each; None for equal weights.
        share: for which the content was prepared; None for one rank, whose share is always everything.
        regions: position weights of each region, as `coverage`: its Gaussians' share of the blend weights. In the order
            of `ScaleTarget.regions`; None where the scene has none.
    """

    content_image: Tensor | None = None
    content: dict[int, ContentFeatures] = field(default_factory=dict)
    coverage: list[Tensor] | None = None
    share: Share | None = None
    regions: list[list[Tensor]] | None = None


@dataclass(frozen=True)
class _Part:
    """A share of a scale's positions, and what they are compared with.

    Attributes:
        weights: of the positions, at powers of two; None for equal ones.
        style: what they are compared with; None where only their statistics are wanted.
        factor: of the loss.
    """

    weights: Sequence[Tensor] | None
    style: ScaleTarget | None = None
    factor: float = 1.0

    @staticmethod
    def of(view: ViewTarget, style: ScaleTarget) -> list[_Part]:
        """All of a view's positions, or those of each region."""
        if not style.regions:
            return [_Part(view.coverage, style)]
        if view.regions is None or len(view.regions) != len(style.regions):
            raise ValueError("the view was not prepared for the regions that the style has")
        pairs = zip(view.regions, style.regions, strict=True)
        return [_Part(weights, region.style, region.weight) for weights, region in pairs]


class SosLoss:
    """Evaluates the SOS loss of views against one style.

    Args:
        network: the feature network; it must report the style layers, and the content layer if it is used. Statistics
            are compared of those style layers, and of `PIXELS`, that it reports.
        content_weight: lambda_c; 0 leaves the content branch out.
        style_loss: what is compared with the style; see `style_losses`.
        memory: bytes that activations may take.
        tile_size: side of partition tiles, multiple of 16; None lets the memory budget decide.
        coarsest: pixels of the coarsest scale's shorter side at most.
        scales: weights of the pyramid's scales; what has none is not computed.
        leave_out: pixels without weight do not go through the network; False for comparison.
        keep_activations: as many as fit between the two passes; False computes each tile twice, for comparison.
        timer: receives the seconds of `vgg_forward`, `vgg_backward`, `statistics`, `matching` and `communication`.
        collectives: of the ranks that evaluate each view together; all call the same methods with the same arguments.

    Attributes:
        speeds: of these ranks, in any unit: work is shared out in proportion.
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
        """n_s of views of a size."""
        return self.tiling.scale_count((height, width))

    def scales(self, height: int, width: int) -> list[int]:
        """The scales that count of views of a size, the finest first."""
        return self.tiling.scales((height, width))

    def tiles(self, height: int, width: int, coverage: Tensor | None = None) -> list[PartitionTile]:
        """The partition of a scaled view; what has no weight (coverage [h, w] of 0) belongs to no tile."""
        return self._partition(self._piece(0, (height, width), coverage), coverage)

    def share(
        self,
        sizes: Mapping[int, Size],
        coverage: Sequence[Tensor] | None = None,
        region: Rectangle | None = None,
    ) -> Share:
        """Share out the work on some scales of a view.

        Args:
            sizes: (height, width) of each scale.
            coverage: from `position_weights`.
            region: of the full-size view, that holds every covered pixel. Where it is given, the coverage is not looked
                at, for which a device would have to be waited for: regions of coarser scales may be some cells larger.
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
        """All of a scale that has to go through the network."""
        if coverage is None or not self.leave_out:
            return Piece(scale, size, Rectangle(0, 0, *size))
        return Piece(scale, size, covered_region(coverage))

    def _partition(self, piece: Piece, coverage: Tensor | None) -> list[PartitionTile]:
        """The partition tiles of a piece, as large as the memory allows."""
        tiles = self.tiling.tiles(piece.size, piece.region)
        if coverage is None or not self.leave_out:
            return tiles
        return [tile for tile in tiles if coverage[tile.inner.slices].any()]

    def style_targets(self, style: Tensor | StyleMixture, view_size: Size) -> dict[int, ScaleTarget]:
        """Targets of every scale that counts, for views of view_size (height, width), from pictures [H, W, 3] in 0..1.

        A layer that has no cell at a scale of a very small style is missing there and is left out of the loss; of
        several pictures, those that have cells stand for all.

        Raises:
            ImageError: features are to be matched, and the style is too small to have any.
        """
        mixture = StyleMixture.of(style)
        pyramids = [self._style_pyramid(picture, view_size) for picture in mixture.pictures]
        layers = self._mixed_layers(pyramids, mixture.weights) if self.style_layers else {}
        vectors = {
            scale: self._style_vectors([pyramid[scale] for pyramid in pyramids], mixture.weights)
            for scale in pyramids[0]
        }
        if self.nearest_layers and all(found is None for found in vectors.values()):
            height, width = _size(pyramids[0][min(pyramids[0])])  # of the scales that count
            raise ImageError(
                f"The style is used at {width} x {height} pixels, too few to match features with. "
                "Give a larger picture, or larger views, or leave --style-loss at sos."
            )
        return {scale: ScaleTarget(layers.get(scale, {}), found) for scale, found in vectors.items()}

    def _style_pyramid(self, picture: Tensor, view_size: Size) -> dict[int, Tensor]:
        """A picture of the style at every scale of views of a size, on the network's device."""
        size = style_size(_size(picture), view_size, self.style_scale)
        image = resize_area(picture, size).to(self.network.device)
        return {scale: downscale(image, scale) for scale in self.scales(*view_size)}

    def _mixed_layers(
        self, pyramids: Sequence[Mapping[int, Tensor]], weights: Sequence[float]
    ) -> dict[int, dict[str, LayerTarget]]:
        """What pictures with their weights ask of each layer at each scale."""
        every = [self._style_statistics(pyramid) for pyramid in pyramids]
        mixed: dict[int, dict[str, LayerTarget]] = {}
        for scale in pyramids[0]:
            mixed[scale] = {}
            for layer in self.style_layers:
                pairs = zip(every, weights, strict=True)
                some = [(own[scale][layer], weight) for own, weight in pairs if layer in own[scale]]
                if some:
                    mixed[scale][layer] = mixed_target([target for target, _ in some], [weight for _, weight in some])
        return mixed

    def _style_statistics(self, scaled: Mapping[int, Tensor]) -> dict[int, dict[str, LayerTarget]]:
        """Statistics of a style image [h, w, 3] at some scales, shared out over the ranks."""
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
        """Vectors of pictures [h, w, 3] with weights at one scale; None where nothing is matched, or there is none.

        They are those of all pictures together. Where that is too many, each has its share by weight. They are too many
        to be sent: every rank computes them all.
        """
        if not self.nearest_layers:
            return None
        stride = layer_stride(self.nearest_layers[0])
        counts = [(size[0] // stride) * (size[1] // stride) for size in map(_size, images)]
        most = shares_of(counts, weights, MOST_VECTORS)
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
        """Features [k, c] of a picture [h, w, 3] at some places of the layers that are matched, on the CPU."""
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
        """Prepare a view: content image [H, W, 3] in 0..1 and coverage [H, W] in 0..1 (None: equal weights)."""
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
        """(height, width) of scales of a view, whose size is given at one of them; None for all that count."""
        scales = self.scales(*size) if scales is None else scales
        return {scale: (size[0] >> scale - image_scale, size[1] >> scale - image_scale) for scale in scales}

    def position_weights(self, coverage: Tensor) -> list[Tensor]:
        """Coverage [H, W] in 0..1 at every power of two that a layer of a scale needs."""
        coarsest = self.scales(coverage.shape[0], coverage.shape[1])[-1]
        levels = coarsest + 1 + layer_stride("relu5_1").bit_length()
        return coverage_pyramid(coverage.to(self.network.device, _gradient_dtype(self.network)), levels)

    def content_features(self, content: Tensor, scale: int, tiles: Sequence[PartitionTile]) -> ContentFeatures:
        """Features of the content layer on the cells that some tiles own, of a content image [H, W, 3] at a scale."""
        image = downscale(content.to(self.network.device), scale)
        result = {}
        for tile in tiles:
            own = tile.owned_cells(CONTENT_LAYER, _size(image))[1]
            # A copy: a slice would keep the features of the halo in memory too.
            result[tile] = self._forward(image, tile, keep=False).features[CONTENT_LAYER][own.slices].clone()
        return result

    def content_bytes(self, pieces: Sequence[Sequence[Piece]]) -> int:
        """What `content_features` of a scale takes on the rank that holds most, from every rank's pieces of it."""
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
        """Loss of an image [H, W, 3] (0..1, not clamped), and dE/dimage.

        Args:
            image: of the view at its scale `image_scale`.
            style: targets by scale, from `style_targets`.
            view: from `view_target`.
            scales: which scales, all with a weight and none of them finer than the image; None for all that count
                (SOS), of a full-size image. Phase 1 passes the coarsest alone.
            gradient: False evaluates the loss only.
            image_scale: 0 for full size.
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
        """Loss (in the pass) and pixel gradient [h, w, 3] of some scales, whose statistics travel together."""
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
        """Style loss of a part of a scale, added to its terms, and gradient maps; statistics are of the whole scale."""
        style = part.style.layers if part.style else {}
        for layer, found in statistics.items():
            if layer in style:
                rounding, weights = self.network.rounding_of(layer), term_weights(layer, self.network.pixel_weight)
                layer_terms, gradient = style_loss(found, style[layer], feature_eps=rounding, weights=weights)
                if layer == PIXELS and gradient.matrix.dtype == torch.float64:  # kernels have done so
                    gradient = gradient.about_rounded_mean()
                if part.factor != 1:
                    layer_terms, gradient = part.factor * layer_terms, gradient.times(part.factor)
                pass_.terms = pass_.terms + layer_terms
                pass_.maps.setdefault(layer, []).append((gradient, part))

    def _backward(self, passes: Sequence[_ScalePass], kept: list[dict[PartitionTile, Activations]]) -> list[Tensor]:
        """Pixel gradient [h, w, 3] of each scale: first of what was kept, which makes room for what was not."""
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
        """For each scale, the merge of its statistics and terms under way, and the activations that fit."""
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
        """Of a scale of which no tile is this rank's."""
        return [LayerStatistics.zero(self.network.channels(layer), device) for layer in self.style_layers]

    def _forward(self, image: Tensor, tile: PartitionTile, *, keep: bool = True) -> Activations:
        with self.timer("vgg_forward"):
            return self.network.forward(image[tile.outer.slices], keep=keep)


class _ScalePass:
    """What the tiles of one scale share: pixels, position weights, content; loss and gradient maps once known.

    Each of its parts is compared with a style of its own; content belongs to all positions.
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
        #: Of each part with features to be matched: the vectors, the factor of its distances, and the part.
        self._matched: list[tuple[StyleVectors, Tensor, _Part]] = []
        for part in parts if loss.nearest_layers else ():
            if part.style is not None and part.style.vectors is not None:
                self._nearest_layer = loss.nearest_layers[0]  # the others' cells are the same
                count = self._all_positions(self._nearest_layer, part.weights)
                factor = part.factor * loss.nearest_weight / torch.where(count > 0, count, torch.inf)
                self._matched.append((part.style.vectors, factor, part))
                self._rounding = loss.network.rounding

    def _all_positions(self, layer: str, pyramid: Sequence[Tensor] | None) -> Tensor:
        """How many cells of a layer the whole scale has, or the sum of their weights: float64 scalar."""
        stride = layer_stride(layer)
        cells = Rectangle(0, 0, self.size[0] // stride, self.size[1] // stride)
        weights = self._weights(layer, cells, pyramid)
        if weights is not None:
            return weights.sum(dtype=torch.float64)
        return torch.full((), cells.pixels, dtype=torch.float64, device=self.image.device)

    def _weights(self, layer: str, cells: Rectangle, pyramid: Sequence[Tensor] | None) -> Tensor | None:
        """Weights [h, w] of some cells of a layer, box-averaged to the cells; None for equal weights."""
        if pyramid is None:
            return None
        return pyramid[self.scale + layer_stride(layer).bit_length() - 1][cells.slices]

    def _is_nowhere(self, weights: Tensor | None) -> bool:
        """Whether a region is known to have no share of some cells; a GPU is not waited for to be asked."""
        return len(self.parts) > 1 and weights is not None and not weights.is_cuda and not bool(weights.any())

    def statistics(self, layers: Sequence[str], tile: PartitionTile, activations: Activations) -> list[LayerStatistics]:
        """Of the cells that a tile owns: for each part those of all layers."""
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
        """The tile's share [5] of the terms that are sums over positions; the others follow from the whole scale."""
        content = self._content_difference(tile, activations.features.get(CONTENT_LAYER))
        nothing = torch.zeros_like(self.terms)
        sums = [None if content is None else content.loss(), self._match(tile, activations)]
        if sums == [None, None]:
            return nothing
        return torch.cat([nothing[2:], *(nothing[:1] if found is None else found[None] for found in sums)])

    def _match(self, tile: PartitionTile, activations: Activations) -> Tensor | None:
        """Match the cells that a tile owns; their share of the nearest-neighbor term, None where nothing is matched.

        What was found is kept for the second pass: a few bytes a cell, and the search takes long.
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
        """On owned cells; features are those of all the tile's cells. None where content does not count."""
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
        """Adds dE/dfeatures of one tile, which is zero on cells that it does not own."""

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
    """Image [H, W, 3] brought down to size (height, width) with an antialiasing filter."""
    if (image.shape[0], image.shape[1]) == size:
        return image
    planes = image.permute(2, 0, 1).unsqueeze(0)
    resized = torch.nn.functional.interpolate(planes, size=size, mode="bilinear", antialias=True, align_corners=False)
    return resized[0].permute(1, 2, 0).contiguous()


def _size(image: Tensor) -> Size:
    return image.shape[0], image.shape[1]


def _gradient_dtype(network: FeatureNetwork) -> torch.dtype:
    return torch.promote_types(network.dtype, torch.float32)
