"""Forecast of an iteration on several ranks: each rank's portion of the work, and the messages between ranks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sgsst_core.features.partition import cached_tiles, choose_tile_size, computed_twice, partition
from sgsst_core.parallel.collectives import TRAFFIC, ImageExchange, Traffic, gaussians_sent
from sgsst_core.parallel.division import Piece, Shares, divide, rounds

#: Channels of the style layers. Ranks exchange their statistics in float64: first the pixel count and the mean, then
#: one half of the symmetric covariance.
_STYLE_CHANNELS = (64, 128, 256, 512, 512)
_FIRST_BYTES = 8 * sum(c + 1 for c in _STYLE_CHANNELS)
_SECOND_BYTES = 8 * sum(c * (c + 1) // 2 for c in _STYLE_CHANNELS)


def loads(division: Sequence[Sequence[Piece]], halo: int) -> list[int]:
    """Return the number of pixels that each rank passes through the network."""
    return [sum(piece.cost(halo) for piece in own) for own in division]


def moved(exchange: ImageExchange, rank: int) -> tuple[int, int]:
    """Return the number of pixels that a rank sends to others, and that it receives from them."""
    others = [other for other in range(len(exchange.parts)) if other != rank]
    return (
        sum(exchange.parts[rank].intersection(exchange.windows[other]).pixels for other in others),
        sum(exchange.parts[other].intersection(exchange.windows[rank]).pixels for other in others),
    )


@dataclass(frozen=True)
class Link:
    """Connection between ranks.

    Attributes:
        bandwidth: Bytes per second that a rank sends while receiving as many.
        latency: Time in seconds of the shortest message from one rank to the next.
    """

    bandwidth: float
    latency: float

    def all_gather(self, size: int, ranks: int) -> float:
        """Return the time in seconds of an all-gather of `size` bytes in total; a reduce-scatter takes as long."""
        return (ranks - 1) * (self.latency + size / ranks / self.bandwidth)

    def all_reduce(self, size: int, ranks: int) -> float:
        """Return the time in seconds of an all-reduce of `size` bytes per rank."""
        return 2 * self.all_gather(size, ranks)


@dataclass(frozen=True)
class RankPart:
    """Part of the work on each view that a rank does.

    Attributes:
        ranks: Number of ranks that divide a view.
        window: Fraction of a view's covered pixels that the rank renders: its part of the view and the halo.
        memory: Memory budget of the rank, relative to `Machine.memory`; more than 1 if some ranks do not take part.
    """

    ranks: int = 1
    window: float = 1.0
    memory: float = 1.0

    def seconds(self, whole: float, fixed: float = 0.0) -> float:
        """Return the rank's time in seconds; `whole` is that of a whole view, `fixed` its size-independent portion."""
        fixed = min(fixed, whole)
        return fixed + (whole - fixed) * self.window


@dataclass(frozen=True)
class IterationWork:
    """Work of an iteration on one view, divided among ranks by `division`.

    Communication is counted in bytes and messages, assuming ring algorithms for sums.

    Attributes:
        pieces: One piece for each computed scale.
        halo: Pixels around a partition tile.
        pixel: Seconds per pixel through the network: both passes and statistics.
        raster: Function that returns the time in seconds of render, gradient and uncached data of the view for a part.
        fixed: Seconds that every rank needs regardless of their number, such as those of the optimizer.
        gaussians: Number of optimized Gaussians.
        forward: Seconds per pixel of a forward pass alone, for pixels whose activations are not cached.
        held: Number of pixels whose activations a single rank can hold (see `choose_tile_size`).
        working: Memory of a pass in addition to the activations, as a fraction of them.
        sharing: Number of ranks that divide the memory for activations.
        shown: Number of Gaussians that the view shows, whose gradients are sent; None for all.
        matching: Time in seconds of the nearest-neighbor search on one rank.
        largest_tile: Maximum pixels of a partition tile; None for no limit.
        rendered: One piece for each scale of the job, whose division determines what each rank renders; empty if these
            are `pieces`.
        rendering: Cost of rendering a pixel that the division assumes; see `Tiling`.
        launch: Seconds to launch the kernels of a partition tile, during which a GPU works on; 0 on a CPU.
        graphs: Whether a single rank launches all kernels of the loss as one CUDA graph, in almost no time.
    """

    pieces: tuple[Piece, ...]
    halo: int
    pixel: float
    raster: Callable[[RankPart], float]
    fixed: float
    gaussians: int
    forward: float = 0.0
    held: float = math.inf
    working: float = 0.0
    sharing: int = 1
    shown: float | None = None
    matching: float = 0.0
    largest_tile: int | None = None
    rendered: tuple[Piece, ...] = ()
    rendering: float = 0.0
    launch: float = 0.0
    graphs: bool = False

    def computing(self, ranks: int, groups: int = 1) -> float:
        """Return the computing time in seconds of the rank with most work.

        Args:
            ranks: Number of ranks per group.
            groups: Number of groups, each of which takes a view.
        """
        held = self.held / min(ranks * groups, self.sharing)
        own = (
            self._network(shard, ranks, held) + self.raster(part)
            for shard, part in zip(self.shards(ranks), self.parts(ranks, groups), strict=True)
        )
        return max(own) + self.matching / ranks + self.fixed

    def parts(self, ranks: int, groups: int = 1) -> list[RankPart]:
        """Return the part of the view that each rank of a group renders; see `computing`."""
        memory = self.sharing / min(ranks * groups, self.sharing)
        whole = max(self._shares(1).windows[0].pixels, 1)
        return [RankPart(ranks, window.pixels / whole, memory) for window in self._shares(ranks).windows]

    def _network(self, shard: Sequence[Piece], ranks: int, held: float) -> float:
        """Return the time in seconds of a rank's pieces, split into partition tiles as its memory requires."""
        areas = {piece.scale: self._areas(piece, held) for piece in shard if piece.region.pixels}
        launching = 0.0 if self.graphs and ranks == 1 else self.launch * sum(map(len, areas.values()))
        seconds = 0.0
        for scales in rounds(list(areas), ranks):
            together = [area for scale in scales for area in areas[scale]]
            twice = computed_twice(together, cached_tiles(together, held, self.working))
            seconds += sum(together) * self.pixel + twice * self.forward
        return max(seconds, launching)

    def _areas(self, piece: Piece, held: float) -> list[int]:
        size = choose_tile_size(
            *piece.size, self.halo, held=held, working=self.working, region=piece.region, largest=self.largest_tile
        )
        return [tile.outer.pixels for tile in partition(*piece.size, size, self.halo, piece.region)]

    def communication(self, ranks: int, link: Link) -> float:
        """Return the time in seconds that ranks wait for data."""
        return sum(self.waiting(ranks, link).values())

    def waiting(self, ranks: int, link: Link) -> dict[Traffic, float]:
        """Return the time in seconds that ranks wait for data, by purpose."""
        if ranks == 1:
            return dict.fromkeys(TRAFFIC, 0.0)
        busiest = max(max(sent, received) for sent, received in self._image_bytes(ranks))
        scales = len(self.pieces)
        return {
            "image": 2 * (link.all_gather(0, ranks) + busiest / link.bandwidth),
            "statistics": sum(link.all_reduce(scales * size, ranks) for size in (_FIRST_BYTES, _SECOND_BYTES)),
            "gradient": link.all_reduce(self._gradient_bytes, ranks),
        }

    def sent(self, ranks: int) -> dict[Traffic, int]:
        """Return the bytes that a rank sends for each purpose, at all scales, as counted by `Collectives.sent`.

        Ranks send different parts of the image; the value is that of the rank that sends most.
        """
        twice = 2 * (ranks - 1) / ranks  # once to reduce, once to distribute
        statistics = len(self.pieces) * (_FIRST_BYTES + _SECOND_BYTES)
        return {
            "image": max(sent + received for sent, received in self._image_bytes(ranks)),
            "statistics": int(twice * statistics),
            "gradient": int(twice * self._gradient_bytes),
        }

    def _shares(self, ranks: int) -> Shares:
        pieces = self.rendered or self.pieces
        height, width = max((piece.size[0] << piece.scale, piece.size[1] << piece.scale) for piece in pieces)
        by_rank = divide(pieces, self.halo, ranks, self.rendering)
        return Shares.of((height, width), by_rank, self.halo)

    def shards(self, ranks: int) -> tuple[tuple[Piece, ...], ...]:
        """Return the pieces that each rank of a group passes through the network."""
        rendering = self.rendering if self.rendered in ((), self.pieces) else 0.0
        return divide(self.pieces, self.halo, ranks, rendering)

    def _image_bytes(self, ranks: int) -> list[tuple[int, int]]:
        """Return the bytes of the image that each rank sends and receives; those of its gradient go the other way."""
        exchanges = self._shares(ranks).exchanges(self.shards(ranks), self.halo).values()
        moved = [[moved(exchange, rank) for exchange in exchanges] for rank in range(ranks)]
        return [(12 * sum(sent for sent, _ in each), 12 * sum(received for _, received in each)) for each in moved]

    @property
    def _gradient_bytes(self) -> int:
        return int(12 * (self.gaussians if self.shown is None else gaussians_sent(self.shown, self.gaussians)))

    def seconds(self, ranks: int, link: Link, groups: int = 1) -> float:
        """Return the time in seconds of an iteration of one view, including communication.

        Args:
            ranks: Number of ranks per group.
            link: Connection between the ranks.
            groups: Number of groups, each of which takes a view.
        """
        return self.computing(ranks, groups) + self.communication(ranks, link)


def proportional(seconds: float) -> Callable[[RankPart], float]:
    """Return a function that scales `seconds` of a whole view to the pixels that a rank renders."""
    return lambda part: part.seconds(seconds)
