"""Communication between the ranks of a job, and the division of views into partition tiles and among ranks.

`worker.ranks.process_group` has the operations of several ranks. Every rank calls the same methods in the same order.
Results that are "identical on all ranks" are bit-identical, so all ranks reach the same decisions based on such results
without further messages.

Every rank computes the whole division from the same numbers, so no messages are needed. The division affects only the
rounding of results, because partition tiles give exact gradients for any division.
"""

from __future__ import annotations

import functools
import itertools
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from sgsst_core.devices import Timer
from sgsst_core.errors import RanksDriftedError
from sgsst_core.features.partition import (
    PartitionTile,
    Rectangle,
    cached_tiles,
    choose_tile_size,
    covered_region,
    partition,
    scaled_region,
)
from sgsst_core.features.statistics import LayerStatistics
from sgsst_core.features.vgg import ALIGNMENT, layer_stride
from sgsst_core.scales import EVEN, ScaleWeights, scale_count
from sgsst_core.scene.colors import add_upscaled_, downscale
from sgsst_core.settings import Settings

T = TypeVar("T")


@dataclass(frozen=True)
class ImageExchange:
    """Rectangles of an image that ranks have and need.

    Attributes:
        parts: Rectangle of each rank's part; they are disjoint.
        windows: Rectangle that each rank needs; may be empty.
    """

    parts: Sequence[Rectangle]
    windows: Sequence[Rectangle]

    def in_part(self, part: Tensor, rank: int, other: int) -> Tensor:
        """Return the pixels [h, w, ...] of a rank's part that are in another rank's window."""
        return part[self.parts[rank].intersection(self.windows[other]).within(self.parts[rank]).slices]

    def in_window(self, window: Tensor, rank: int, other: int) -> Tensor:
        """Return the pixels [h, w, ...] of a rank's window that are in another rank's part."""
        return window[self.windows[rank].intersection(self.parts[other]).within(self.windows[rank]).slices]


class Collectives:
    """Collective operations of one rank in a group of ranks; this class implements them for a single rank.

    Attributes:
        local_size: Number of ranks on this machine, including this one.
        gpu_sharing: Largest number of ranks on one GPU; 1 without GPUs.
    """

    rank: int = 0
    size: int = 1
    local_size: int = 1
    gpu_sharing: int = 1

    def gather_parts(
        self, exchanges: Sequence[ImageExchange], parts: Sequence[Tensor], windows: Sequence[Tensor]
    ) -> None:
        """Fill each rank's windows of some images from every rank's parts of them.

        Args:
            exchanges: Rectangles of the parts and windows of each image.
            parts: [h, w, ...], part of this rank of each image.
            windows: [h, w, ...], window of this rank of each image. Pixels in no part are left unchanged.
        """
        raise NotImplementedError("a single rank has whole images")

    def reduce_parts(self, exchanges: Sequence[ImageExchange], windows: Sequence[Tensor]) -> list[Tensor]:
        """Return this rank's part [h, w, ...] of the sum of all ranks' windows, for each image.

        This is the adjoint of `gather_parts`.
        """
        raise NotImplementedError("a single rank has whole images")

    def all_reduce(self, tensor: Tensor) -> Tensor:
        """Return the sum over all ranks, identical on all ranks. The argument may be overwritten."""
        return tensor

    def all_reduce_statistics(
        self, parts: Sequence[LayerStatistics], numbers: Tensor
    ) -> tuple[list[LayerStatistics], Tensor]:
        """Merge all ranks' statistics of disjoint positions, and sum their numbers; identical on all ranks.

        Args:
            parts: Statistics of this rank's positions, such as of each layer at each scale.
            numbers: [k] float64, numbers to sum over the ranks.

        Returns:
            Merged statistics in the order of `parts`, and the sums [k] float64.
        """
        return list(parts), numbers

    def all_gather(self, value: T) -> list[T]:
        """Return every rank's value in rank order, identical on all ranks.

        Values should be small. Allowed are scalars, strings, lists, tuples, dicts, paths, arrays, tensors, and this
        project's dataclasses and errors.
        """
        return [value]

    def broadcast(self, make: Callable[[], T]) -> T:
        """Call `make` on rank 0 only, and return its result on all ranks; an `SgsstError` is raised on all ranks."""
        return make()

    def set_timeout_for(self, iteration_seconds: float) -> None:
        """Set the timeout of collectives for iterations of this length.

        After this call, all ranks communicate in every iteration, and a rank that is late by much more than an
        iteration counts as failed. Before this call, the timeout is long enough for the preparation of a job.
        """

    def split_group(self, groups: int) -> Collectives:
        """Split the ranks into `groups` equal groups of consecutive ranks, and return this rank's group.

        Every rank must call this at the same point.
        """
        return self


ALONE = Collectives()


#: Steps between two checks that all ranks have the same colors.
DRIFT_STEPS = 50


class Team:
    """Ranks of a job, and the position of this rank among them.

    Attributes:
        groups: Number of groups that these ranks form; each group processes its own views.
        group: Ranks that process the same views as this one.
    """

    def __init__(self, settings: Settings, collectives: Collectives) -> None:
        self.everybody = collectives
        self.groups = math.gcd(settings.views_per_step, collectives.size)
        self.group = collectives.split_group(self.groups)

    @property
    def own_group(self) -> int:
        """Index of this rank's group."""
        return self.everybody.rank // self.group.size

    def check_drift(self, step: int, colors: Tensor) -> None:
        """Check every `DRIFT_STEPS` steps that all ranks have the same colors [n, 3].

        Raises:
            RanksDriftedError: If they differ.
        """
        if self.everybody.size == 1 or step % DRIFT_STEPS:
            return
        checksum = zlib.crc32(colors.detach().cpu().numpy().tobytes())
        if len(set(self.everybody.all_gather(checksum))) > 1:
            raise RanksDriftedError(
                f"Step {step}: the ranks' colors are no longer the same. They compute differently: run on "
                "machines of one kind, with the same versions of this program and of PyTorch."
            )


Size = tuple[int, int]  # height, width in pixels


#: Position weights [H >> k, W >> k] for each power of two 2^k; None for equal weights.
PositionWeights = Sequence[Tensor] | None


@dataclass(frozen=True)
class Piece:
    """Rectangle of one scale of a view, as a unit of work: one rank owns it and computes its features.

    Attributes:
        region: Rectangle; its edges are at multiples of 16 or at the border of the view.
    """

    scale: int
    size: Size
    region: Rectangle

    def cost(self, halo: int) -> int:
        """Return the number of pixels, including the halo, that the network processes if the piece is one tile."""
        return self.tile(halo).outer.pixels if self.region.pixels else 0

    def cells(self, layer: str) -> int:
        """Return the number of cells of a layer that the piece owns."""
        return self.tile(0).owned_cells(layer, self.size)[0].pixels if self.region.pixels else 0

    def tile(self, halo: int) -> PartitionTile:
        """Return the piece as one partition tile."""
        return partition(*self.size, None, halo, self.region)[0]


@dataclass(frozen=True)
class Shares:
    """Rectangles of a view, at full size, that the ranks render. Those of a rank without pixels are empty.

    Attributes:
        scale: Finest computed scale; no rank needs pixels of its pieces of it from another rank.
        parts: Each rank's piece of the finest scale. They are disjoint and contain every covered pixel.
        windows: Each rank's part and its halo, which the rank renders.
        halo: Width in pixels of the halo around a tile.
    """

    size: Size
    scale: int
    parts: tuple[Rectangle, ...]
    windows: tuple[Rectangle, ...]
    halo: int

    @staticmethod
    def of(size: Size, by_rank: Sequence[Sequence[Piece]], halo: int) -> Shares:
        """Return the rectangles that follow from a division of all computed scales of a view (`divide`)."""
        scale = min(piece.scale for pieces in by_rank for piece in pieces)
        own = [next((p for p in pieces if p.scale == scale and p.region.pixels), None) for pieces in by_rank]
        return Shares(
            size,
            scale,
            tuple(piece.region.at_full_size(scale) if piece else _NOTHING for piece in own),
            tuple(piece.tile(halo).outer.at_full_size(scale) if piece else _NOTHING for piece in own),
            halo,
        )

    def exchanged_scale(self, scale: int) -> int:
        """Return the scale of the exchanged image from which ranks compute their pixels of a coarser scale.

        It is the scale itself, unless its pixels are too large for the edges of parts to lie between them.
        """
        return min(scale, self.scale + ALIGNMENT.bit_length() - 1)

    def exchanges(self, by_rank: Sequence[Sequence[Piece]]) -> dict[int, ImageExchange]:
        """Return the exchange of each image, by its scale, that gives ranks their pieces of coarser scales."""
        coarser = [[piece for piece in pieces if piece.scale != self.scale] for pieces in by_rank]
        scales = sorted({self.exchanged_scale(piece.scale) for pieces in coarser for piece in pieces})
        return {
            scale: ImageExchange(
                tuple(part.at_scale(scale) for part in self.parts),
                tuple(
                    self._window([p for p in pieces if self.exchanged_scale(p.scale) == scale], scale)
                    for pieces in coarser
                ),
            )
            for scale in scales
        }

    def _window(self, pieces: Sequence[Piece], scale: int) -> Rectangle:
        """Return the rectangle of an exchanged image that contains the pixels of some pieces and of their halos."""
        pieces = [piece for piece in pieces if piece.region.pixels]
        if not pieces:
            return _NOTHING
        outer = [piece.tile(self.halo).outer.at_full_size(piece.scale - scale) for piece in pieces]
        # Edges between the pixels of the coarsest of these scales, or at the border of the view.
        step = 1 << max(piece.scale for piece in pieces) - scale
        height, width = self.size[0] >> scale, self.size[1] >> scale
        return Rectangle(
            min(area.top for area in outer) // step * step,
            min(area.left for area in outer) // step * step,
            min(-(-max(area.bottom for area in outer) // step) * step, height),
            min(-(-max(area.right for area in outer) // step) * step, width),
        )


_NOTHING = Rectangle(0, 0, 0, 0)


def divide(pieces: tuple[Piece, ...], halo: int, ranks: int, rendering: float = 0.0) -> tuple[tuple[Piece, ...], ...]:
    """Divide pieces among ranks, in equal portions of their cost.

    The ranks are recursively split into two halves, and the pieces are divided between the halves. Only pieces that
    cost more than a rank's average are split, because each split adds two halos; smaller pieces go to the half with
    less work. The largest piece is split last, so that the costs, including halos, are alike. Coarse scales are
    thereby spread over the ranks: each rank has few pieces, and no rank receives most of the exchanged images.

    Args:
        pieces: One piece per scale.
        rendering: Cost of a rendered pixel, relative to that of a pixel in the network. A rank renders its piece of the
            finest scale; 0 if what it renders does not depend on this division.

    Returns:
        Pieces of each rank, scale 0 first. A rank may get none if there are fewer than 16 x 16 pixels per rank.
    """
    finest = min((piece.scale for piece in pieces), default=0)
    return _divide(pieces, ranks, _Costs(halo, finest, rendering))


@dataclass(frozen=True)
class _Costs:
    """Costs of pieces; see `divide`."""

    halo: int
    finest: int
    rendering: float

    def of(self, piece: Piece) -> float:
        """Return the cost of a piece in pixels through the network."""
        rendered = self.rendering * 4**self.finest if piece.scale == self.finest else 0.0
        return piece.cost(self.halo) * (1 + rendered)


@functools.lru_cache(maxsize=1024)
def _divide(pieces: tuple[Piece, ...], ranks: int, costs: _Costs) -> tuple[tuple[Piece, ...], ...]:
    if ranks == 1:
        return (tuple(sorted(pieces, key=lambda piece: piece.scale)),)
    half = ranks // 2
    first, second = _halves(pieces, half / ranks, ranks, costs)
    return _divide(first, half, costs) + _divide(second, ranks - half, costs)


def _halves(
    pieces: tuple[Piece, ...], fraction: float, ranks: int, costs: _Costs
) -> tuple[tuple[Piece, ...], tuple[Piece, ...]]:
    """Divide the pieces of some ranks into two sets; the first set has a given fraction of the cost."""
    total = sum(map(costs.of, pieces))
    if not total:
        return pieces, ()
    largest, *others = sorted(pieces, key=lambda piece: -costs.of(piece))
    halves: tuple[list[Piece], list[Piece]] = [], []
    loads = [0.0, 0.0]

    def load(parts: tuple[Piece | None, Piece | None]) -> float:
        own, other = (costs.of(part) if part else 0 for part in parts)
        return max((loads[0] + own) / fraction, (loads[1] + other) / (1 - fraction))

    for piece in [*others, largest]:
        is_split = piece is largest or costs.of(piece) > total / ranks
        parts = min(_splits(piece) if is_split else _whole(piece), key=load)
        for side, part in enumerate(parts):
            if part is not None:
                halves[side].append(part)
                loads[side] += costs.of(part)
    return tuple(halves[0]), tuple(halves[1])


def _whole(piece: Piece) -> list[tuple[Piece | None, Piece | None]]:
    """Return both ways to divide a piece without splitting it."""
    return [(piece, None), (None, piece)]


def _splits(piece: Piece) -> list[tuple[Piece | None, Piece | None]]:
    """Return all ways to split a piece in two: at every 16th row or column, or not at all."""
    area = piece.region
    splits = _whole(piece)
    for row in range(area.top + ALIGNMENT, area.bottom, ALIGNMENT):  # rows first, because they are contiguous in memory
        upper = replace(piece, region=Rectangle(area.top, area.left, row, area.right))
        splits.append((upper, replace(piece, region=Rectangle(row, area.left, area.bottom, area.right))))
    for column in range(area.left + ALIGNMENT, area.right, ALIGNMENT):
        left = replace(piece, region=Rectangle(area.top, area.left, area.bottom, column))
        splits.append((left, replace(piece, region=Rectangle(area.top, column, area.bottom, area.right))))
    return splits


def rounds(scales: Sequence[int], ranks: int) -> list[list[int]]:
    """Return groups of scales whose activations are in memory at the same time.

    A single rank processes one scale at a time, to store the activations of only one scale. Several ranks process all
    scales together: work is balanced over all scales, not within each scale, so ranks that process one scale at a time
    would wait for each other.
    """
    return [[scale] for scale in scales] if ranks == 1 else [list(scales)]


#: Cost of rendering a pixel and its gradient, relative to that of a pixel in the network, by device. It is a constant,
#: so that the division of work, and with it the rounding, does not depend on timings. On a CPU it was measured as 0.004
#: with cached weights at 1280x720; on GPUs, for which meta tensors stand in a forecast, it is an estimate.
RENDERING = {"cpu": 0.0, "cuda": 0.125, "meta": 0.125}


@dataclass(frozen=True)
class Tiling:
    """Rules for partitioning views.

    Attributes:
        halo: Width in pixels of the halo around a partition tile.
        held: Number of pixels whose activations fit in memory.
        working: Additional memory that a tile needs during a pass, as a fraction of the memory of its activations.
        coarsest: Maximum shorter side of the coarsest scale in pixels.
        tile_size: Side of partition tiles, a multiple of 16; None to choose it from the memory budget.
        largest: Maximum pixels of a partition tile whose size is chosen; None for no limit.
        rendering: Cost of rendering a pixel, relative to that of a pixel in the network (`RENDERING`).
    """

    halo: int
    held: float
    working: float
    coarsest: int
    tile_size: int | None = None
    weights: ScaleWeights = EVEN
    largest: int | None = None
    rendering: float = 0.0

    def scales(self, size: Size) -> list[int]:
        """Return the scales with a positive weight for views of a size (height, width), finest first."""
        return self.weights.chosen(scale_count(*size, self.coarsest))

    def tiles(self, size: Size, region: Rectangle | None = None) -> list[PartitionTile]:
        """Return the tiles of a region of a scaled view of size (height, width).

        Tiles are as large as the memory budget allows.
        """
        tile_size = self.tile_size or choose_tile_size(
            *size, self.halo, held=self.held, working=self.working, region=region, largest=self.largest
        )
        return partition(*size, tile_size, self.halo, region)

    def cached(self, areas: Sequence[int]) -> list[bool]:
        """Return which of the tiles with these pixel counts cache their activations.

        The memory budget applies to the sum over all given tiles.
        """
        return cached_tiles(areas, self.held, self.working)


@dataclass(frozen=True)
class Division:
    """Division of the work on some scales of a view among ranks.

    Attributes:
        pieces: For each scale, the pieces of every rank; identical on all ranks.
        tiles: Partition tiles of this rank by scale.
        shares: Rectangles that the ranks render; None if every rank has the whole image.
    """

    pieces: dict[int, tuple[tuple[Piece, ...], ...]]
    tiles: dict[int, list[PartitionTile]]
    shares: Shares | None = None

    def cost(self, rank: int, halo: int) -> int:
        """Return the number of pixels that a rank passes through the network."""
        return sum(piece.cost(halo) for every in self.pieces.values() for piece in every[rank])


class Divider:
    """Divider of the work on views among ranks.

    Args:
        collectives: Collectives of the ranks that evaluate each view together.
    """

    def __init__(self, tiling: Tiling, collectives: Collectives = ALONE) -> None:
        self.tiling = tiling
        self.collectives = collectives

    def divide(
        self, sizes: Mapping[int, Size], coverage: Sequence[Tensor] | None = None, region: Rectangle | None = None
    ) -> Division:
        """Divide the work on some scales of a view.

        Args:
            coverage: Position weights in the format of `ViewTarget.coverage`; None for equal weights.
            region: Rectangle of the full-size view that contains every covered pixel. If it is given, `coverage` is not
                read, which avoids synchronizing with the device. The pieces of coarser scales may then be a few cells
                larger.
        """
        weights = {scale: coverage[scale] if coverage and region is None else None for scale in sizes}

        def needed(scale: int, size: Size) -> Rectangle:
            if region is not None:
                return scaled_region(region, scale, size)
            own = weights[scale]
            return Rectangle(0, 0, *size) if own is None else covered_region(own)

        pieces = tuple(Piece(scale, size, needed(scale, size)) for scale, size in sizes.items())
        return self._division(divide(pieces, self.tiling.halo, self.collectives.size), sizes, weights)

    def divide_view(
        self, size: Size, scales: Sequence[int], coverage: Sequence[Tensor] | None, region: Rectangle | None
    ) -> Division:
        """Divide the work on some scales of a view if each rank renders only a part of it.

        The parts do not depend on the scales. If the finest computed scale is among them, each rank's piece of it is
        the part that the rank renders.

        Args:
            coverage: Position weights in the format of `ViewTarget.coverage`; None for equal weights.
            region: Rectangle of the view that contains every covered pixel; None for the whole view.
        """
        by_rank = self._divided(size, self.tiling.scales(size), region)
        shares = Shares.of(size, by_rank, self.tiling.halo)
        if shares.scale not in scales:
            by_rank = self._divided(size, scales, region, rendered=False)
        sizes = {scale: (size[0] >> scale, size[1] >> scale) for scale in scales}
        weights = {scale: coverage[scale] if coverage else None for scale in scales}
        return replace(self._division(by_rank, sizes, weights), shares=shares)

    def shares(self, size: Size, region: Rectangle | None) -> Shares:
        """Return the rectangles that the ranks render of a view; see `divide_view`."""
        return Shares.of(size, self._divided(size, self.tiling.scales(size), region), self.tiling.halo)

    def _divided(
        self, size: Size, scales: Sequence[int], region: Rectangle | None, *, rendered: bool = True
    ) -> tuple[tuple[Piece, ...], ...]:
        whole = Rectangle(0, 0, *size) if region is None else region
        sizes = [(size[0] >> scale, size[1] >> scale) for scale in scales]
        pieces = [
            Piece(scale, each, scaled_region(whole, scale, each)) for scale, each in zip(scales, sizes, strict=True)
        ]
        rendering = self.tiling.rendering if rendered else 0.0
        return divide(tuple(pieces), self.tiling.halo, self.collectives.size, rendering)

    def _division(
        self,
        by_rank: Sequence[Sequence[Piece]],
        sizes: Mapping[int, Size],
        weights: Mapping[int, Tensor | None],
    ) -> Division:
        own = by_rank[self.collectives.rank]
        return Division(
            {scale: tuple(tuple(p for p in each if p.scale == scale) for each in by_rank) for scale in sizes},
            {
                scale: [tile for p in own if p.scale == scale for tile in self._partition(p, weights[scale])]
                for scale in sizes
            },
        )

    def _partition(self, piece: Piece, coverage: Tensor | None) -> list[PartitionTile]:
        """Return the covered partition tiles of a piece, as large as the memory budget allows."""
        tiles = self.tiling.tiles(piece.size, piece.region)
        return tiles if coverage is None else [tile for tile in tiles if coverage[tile.inner.slices].any()]


@dataclass(frozen=True)
class ScaledView:
    """One scale of a view, or the pixels of it that a rank needs.

    Attributes:
        image: [h, w, 3], pixels of `area` on the network's device.
        size: (height, width) of the whole scaled view.
        area: Rectangle of the scaled view; empty if the rank needs no pixels.
    """

    image: Tensor
    scale: int
    size: Size
    area: Rectangle

    @staticmethod
    def of(image: Tensor, scale: int) -> ScaledView:
        """Return the whole of a scaled view [h, w, 3]."""
        size = (image.shape[0], image.shape[1])
        return ScaledView(image, scale, size, Rectangle(0, 0, *size))

    def pixels(self, rectangle: Rectangle) -> Tensor:
        """Return the pixels of a rectangle of the scaled view."""
        return self.image[rectangle.within(self.area).slices]

    def weights(self, layer: str, cells: Rectangle, pyramid: PositionWeights) -> Tensor | None:
        """Return the weights [h, w] of a block of cells of a layer, as box averages; None for equal weights."""
        return None if pyramid is None else pyramid[self.scale + layer_stride(layer).bit_length() - 1][cells.slices]

    def count(self, layer: str, pyramid: PositionWeights) -> Tensor:
        """Return the sum of the weights of all cells of a layer, float64 scalar; their number for equal weights."""
        stride = layer_stride(layer)
        cells = Rectangle(0, 0, self.size[0] // stride, self.size[1] // stride)
        weights = self.weights(layer, cells, pyramid)
        if weights is not None:
            return weights.sum(dtype=torch.float64)
        return torch.full((), cells.pixels, dtype=torch.float64, device=self.image.device)


class ViewImages:
    """Image of a view at several scales.

    All ranks must create it and call `gradient` together.

    Args:
        image: [h, w, 3], image of the view, or of this rank's window of `division.shares`.
        background: Color of the pixels that no rank renders.
    """

    def __init__(
        self,
        image: Tensor,
        division: Division,
        background: tuple[float, float, float],
        collectives: Collectives,
        timer: Timer,
    ) -> None:
        self._collectives, self._timer = collectives, timer
        shares = division.shares
        whole = Rectangle(0, 0, image.shape[0], image.shape[1])
        self._own = _Pixels(image, 0, whole if shares is None else shares.windows[collectives.rank])
        self._size = whole.shape if shares is None else shares.size
        self._shares = shares
        #: Rectangles of each image that ranks exchange, by scale, and the pixels of it that this rank needs.
        self._exchanges: dict[int, ImageExchange] = {}
        self._coarse: dict[int, _Pixels] = {}
        if shares is not None and any(scale != shares.scale for scale in division.pieces):
            by_rank = [list(itertools.chain(*own)) for own in zip(*division.pieces.values(), strict=True)]
            self._exchanges = shares.exchanges(by_rank)
            #: This rank's part of the view, relative to its window.
            self._part = shares.parts[collectives.rank].within(self._own.area)
            self._gather(background)

    def _gather(self, background: tuple[float, float, float]) -> None:
        """Exchange the coarser images between ranks."""
        own = [downscale(self._own.image[self._part.slices], scale) for scale in self._exchanges]
        for scale, exchange in self._exchanges.items():
            area = exchange.windows[self._collectives.rank]
            image = self._own.image.new_empty((*area.shape, 3))
            for channel, color in zip(image.unbind(-1), background, strict=True):
                channel.fill_(color)  # scalars are kernel arguments, so the host does not wait for a copy to the device
            self._coarse[scale] = _Pixels(image, scale, area)
        with self._timer("communication"):
            windows = [pixels.image for pixels in self._coarse.values()]
            self._collectives.gather_parts([*self._exchanges.values()], own, windows)

    def scaled(self, scale: int) -> ScaledView:
        """Return the pixels of a scale that this rank needs."""
        return self._source(scale).scaled(scale, (self._size[0] >> scale, self._size[1] >> scale))

    def add_gradient(self, scale: int, gradient: Tensor, factor: float) -> None:
        """Add the gradient with respect to the pixels of `scaled(scale)`, times a factor."""
        self._source(scale).add_gradient(scale, gradient, factor)

    def gradient(self) -> Tensor:
        """Return this rank's summand of the gradient with respect to the image, [h, w, 3]."""
        if self._exchanges:
            gradients = [image.gradient for image in self._coarse.values() if image.gradient is not None]
            with self._timer("communication"):
                own = self._collectives.reduce_parts([*self._exchanges.values()], gradients)
            for scale, gradient in zip(self._exchanges, own, strict=True):
                self._own.add_gradient(scale, gradient, area=self._part)
        assert self._own.gradient is not None
        return self._own.gradient

    def _source(self, scale: int) -> _Pixels:
        """Return the pixels from which those of a scale are computed."""
        if self._shares is None or scale == self._shares.scale:
            return self._own
        return self._coarse[self._shares.exchanged_scale(scale)]


@dataclass
class _Pixels:
    """Rectangle of a scaled view, and the gradient with respect to it.

    Attributes:
        area: Rectangle of the scaled view.
        gradient: [h, w, 3]; None before the first `add_gradient`.
    """

    image: Tensor
    scale: int
    area: Rectangle
    gradient: Tensor | None = None

    def scaled(self, scale: int, size: tuple[int, int]) -> ScaledView:
        """Return these pixels at a scale of the view of size (height, width)."""
        further = scale - self.scale
        return ScaledView(downscale(self.image, further), scale, size, self.area.at_scale(further))

    def add_gradient(self, scale: int, gradient: Tensor, factor: float = 1.0, area: Rectangle | None = None) -> None:
        """Add the gradient with respect to these pixels at a scale, or to an area of them, times a factor."""
        if self.gradient is None:
            self.gradient = gradient.new_zeros(self.image.shape)
        target = self.gradient if area is None else self.gradient[area.slices]
        add_upscaled_(target, gradient, scale - self.scale, factor)
