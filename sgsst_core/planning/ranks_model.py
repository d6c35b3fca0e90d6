"""How long an iteration takes on several ranks: the planner's model, from measured constants.

Computing is shared out by `division`; what the ranks tell each other is counted in bytes and messages, as rings move
them. One model serves the planner, which leaves out ranks that would only add communication, and the forecast for
machines that are not at hand (`benchmarks.scaling`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from sgsst_core.features.partition import choose_tile_size, computed_twice, kept_tiles, partition
from sgsst_core.parallel.collectives import Collectives, Traffic
from sgsst_core.parallel.division import Piece, divide, rounds
from sgsst_core.parallel.shown import gaussians_sent
from sgsst_core.timing import wait_for

#: Channels of the style layers: their statistics travel as n, mean and one half of C, in float64.
_STYLE_CHANNELS = (64, 128, 256, 512, 512)
_FIRST_BYTES = 8 * sum(c + 1 for c in _STYLE_CHANNELS)
_SECOND_BYTES = 8 * sum(c * (c + 1) // 2 for c in _STYLE_CHANNELS)
#: Bytes on which a link is timed, between processors and between GPUs: enough to fill it, and no more than some views'
#: images.
_PROBE_BYTES = {"cpu": 4 << 20, "cuda": 64 << 20}
#: Further ranks must save at least this share of an iteration.
LEAST_GAIN = 0.03


@dataclass(frozen=True)
class Link:
    """What connects the ranks.

    Attributes:
        bandwidth: bytes a second that a rank sends while it receives as many.
        latency: seconds of the shortest message from one rank to the next.
    """

    bandwidth: float
    latency: float

    def all_gather(self, size: int, ranks: int) -> float:
        """Seconds to bring `size` bytes in all from everybody to everybody; as many to scatter and add them."""
        return (ranks - 1) * (self.latency + size / ranks / self.bandwidth)

    def all_reduce(self, size: int, ranks: int) -> float:
        """Seconds to add up `size` bytes of every rank."""
        return 2 * self.all_gather(size, ranks)


@dataclass(frozen=True)
class IterationWork:
    """One view's iteration.

    Attributes:
        pieces: one for each scale that is computed.
        halo: pixels around a partition tile.
        pixel: seconds a pixel through the network, both passes and statistics.
        raster: seconds of render and gradient on one rank.
        fixed: seconds that every rank needs, however many there are: comparing statistics, the optimizer.
        gaussians: that are optimized.
        shown: that the view shows, for which alone its gradient travels; None for all.
        matching: seconds of the search for nearest style vectors on one rank.
        whole_image: the full-size image and its gradient are exchanged (phase 1 with kept weights needs neither).
        forward: seconds a pixel of a forward pass alone, for pixels whose activations do not stay in memory.
        held, working: pixels whose activations one rank alone can hold, and what a pass needs beside them as a share of
            them (see `choose_tile_size`).
        sharing: ranks among which that memory is divided.
    """

    pieces: tuple[Piece, ...]
    halo: int
    pixel: float
    raster: float
    fixed: float
    gaussians: int
    whole_image: bool = True
    forward: float = 0.0
    held: float = math.inf
    working: float = 0.0
    sharing: int = 1
    shown: float | None = None
    matching: float = 0.0

    def computing(self, ranks: int, groups: int = 1) -> float:
        """Seconds of the rank with most work, where so many groups of ranks take a view each."""
        shares = divide(self.pieces, self.halo, (1.0,) * ranks)
        held = self.held / min(ranks * groups, self.sharing)
        return (
            max(self._network(share, ranks, held) for share in shares)
            + (self.raster + self.matching) / ranks
            + self.fixed
        )

    def _network(self, share: Sequence[Piece], ranks: int, held: float) -> float:
        """Seconds of a rank's pieces, cut into partition tiles as its memory allows."""
        areas = {piece.scale: self._areas(piece, held) for piece in share if piece.region.pixels}
        seconds = 0.0
        for scales in rounds(list(areas), ranks):
            together = [area for scale in scales for area in areas[scale]]
            twice = computed_twice(together, kept_tiles(together, held, self.working))
            seconds += sum(together) * self.pixel + twice * self.forward
        return seconds

    def _areas(self, piece: Piece, held: float) -> list[int]:
        size = choose_tile_size(*piece.size, self.halo, held=held, working=self.working, region=piece.region)
        return [tile.outer.pixels for tile in partition(*piece.size, size, self.halo, piece.region)]

    def communication(self, ranks: int, link: Link) -> float:
        """Seconds in which ranks wait for what others send. Statistics of all scales but the last travel meanwhile."""
        if ranks == 1:
            return 0.0
        image = 2 * link.all_gather(self._image_bytes, ranks) if self.whole_image else 0.0
        statistics = link.all_reduce(_FIRST_BYTES, ranks) + link.all_reduce(_SECOND_BYTES, ranks)
        return image + statistics + link.all_reduce(self._gradient_bytes, ranks)

    def sent(self, ranks: int) -> dict[Traffic, int]:
        """Bytes that a rank sends for each purpose, of all scales; what `Collectives.sent` counts."""
        twice = 2 * (ranks - 1) / ranks  # once to bring in what belongs together, once to share it out
        statistics = len(self.pieces) * (_FIRST_BYTES + _SECOND_BYTES)
        return {
            "image": int(twice * self._image_bytes) if self.whole_image else 0,
            "statistics": int(twice * statistics),
            "gradient": int(twice * self._gradient_bytes),
        }

    @property
    def _image_bytes(self) -> int:
        # Of full size, whichever scales are computed of it.
        height, width = max((piece.size[0] << piece.scale, piece.size[1] << piece.scale) for piece in self.pieces)
        return 12 * height * width

    @property
    def _gradient_bytes(self) -> int:
        return int(12 * (self.gaussians if self.shown is None else gaussians_sent(self.shown, self.gaussians)))

    def seconds(self, ranks: int, link: Link, groups: int = 1) -> float:
        """Of one iteration of one view, on each of so many groups of ranks."""
        return self.computing(ranks, groups) + self.communication(ranks, link)


def probe_link(collectives: Collectives, device: torch.device) -> Link:
    """Time sums over all ranks; the same result on every rank. One rank has nobody to send to."""
    if collectives.size == 1:
        return Link(math.inf, 0.0)
    largest = _PROBE_BYTES[device.type]
    short, long = (_slowest_sum(collectives, device, size) for size in (8, largest))
    steps = 2 * (collectives.size - 1)
    moved = steps * largest / collectives.size
    return Link(moved / max(long - short, 1e-9), short / steps)


def _slowest_sum(collectives: Collectives, device: torch.device, size: int) -> float:
    """Seconds of the rank that waits longest for the sum of tensors of so many bytes; the last of three counts."""
    tensor = torch.zeros(size // 4, device=device)
    seconds = 0.0
    for _ in range(3):  # the first one makes the connections
        wait_for(device)
        collectives.all_gather(None)
        started = time.perf_counter()
        collectives.all_reduce(tensor)
        wait_for(device)
        seconds = time.perf_counter() - started
    return max(collectives.all_gather(seconds))


@dataclass(frozen=True)
class RanksChoice:
    """How many ranks take part.

    Attributes:
        ranks: how many.
        seconds: of the whole schedule for each number that was looked at.
    """

    ranks: int
    seconds: dict[int, float]

    @property
    def speed_up(self) -> float:
        """Over one rank."""
        return self.seconds[1] / self.seconds[self.ranks]


def choose_ranks(
    phases: Sequence[tuple[int, Sequence[IterationWork]]], views_per_step: int, available: int, link: Link
) -> RanksChoice:
    """The fewest ranks with which no larger number would be worth its communication.

    Args:
        phases: steps of each phase, and an iteration of some of its views.
        views_per_step: groups of ranks take views of their own.
        available: most ranks that there are.
        link: between them.
    """
    seconds = {ranks: _schedule_seconds(phases, views_per_step, ranks, link) for ranks in _candidates(available)}
    best = min(seconds.values())
    enough = min(ranks for ranks, time_ in seconds.items() if time_ <= best * (1 + LEAST_GAIN))
    return RanksChoice(enough, seconds)


def _candidates(available: int) -> list[int]:
    """Numbers of ranks worth a look: up to eight all of them, then at steps of a quarter."""
    found, ranks = [], 1
    while ranks < available:
        found.append(ranks)
        ranks += max(ranks // 4, 1) if ranks >= 8 else 1
    return [*found, available]


def _schedule_seconds(
    phases: Sequence[tuple[int, Sequence[IterationWork]]], views_per_step: int, ranks: int, link: Link
) -> float:
    groups = math.gcd(views_per_step, ranks)
    each = ranks // groups
    total = 0.0
    for steps, works in phases:
        mean = sum(work.seconds(each, link, groups) for work in works) / len(works)
        across = link.all_reduce(works[0].gaussians * 12, ranks) if groups > 1 else 0.0
        total += steps * (mean * views_per_step / groups + across)
    return total
