"""Model of the iteration time on several ranks, from measured constants.

Computation is divided by `division`; communication is counted in bytes and messages, assuming ring algorithms. The
planner uses the model to leave out ranks that would only add communication, and `benchmarks.scaling` uses it to
forecast machines that are not available.
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

#: Channels of the style layers. Ranks exchange their statistics in float64: first the pixel count and the mean, then
#: one half of the symmetric covariance.
_STYLE_CHANNELS = (64, 128, 256, 512, 512)
_FIRST_BYTES = 8 * sum(c + 1 for c in _STYLE_CHANNELS)
_SECOND_BYTES = 8 * sum(c * (c + 1) // 2 for c in _STYLE_CHANNELS)
#: Bytes sent to time a link between CPUs and between GPUs: enough to saturate it, and no more than the images of a few
#: views.
_PROBE_BYTES = {"cpu": 4 << 20, "cuda": 64 << 20}
#: Minimum fraction of an iteration that additional ranks must save.
LEAST_GAIN = 0.03


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
class IterationWork:
    """Work of an iteration on one view.

    Attributes:
        pieces: One piece for each computed scale.
        halo: Pixels around a partition tile.
        pixel: Seconds per pixel through the network: both passes and statistics.
        raster: Time in seconds of render and gradient on one rank.
        fixed: Seconds that every rank needs regardless of their number: comparing statistics, and the optimizer.
        gaussians: Number of optimized Gaussians.
        forward: Seconds per pixel of a forward pass alone, for pixels whose activations are not cached.
        held: Number of pixels whose activations a single rank can hold (see `choose_tile_size`).
        working: Memory of a pass in addition to the activations, as a fraction of them.
        sharing: Number of ranks that divide the memory for activations.
        shown: Number of Gaussians that the view shows, whose gradients are sent; None for all.
        matching: Time in seconds of the nearest-neighbor search on one rank.
    """

    pieces: tuple[Piece, ...]
    halo: int
    pixel: float
    raster: float
    fixed: float
    gaussians: int
    forward: float = 0.0
    held: float = math.inf
    working: float = 0.0
    sharing: int = 1
    shown: float | None = None
    matching: float = 0.0

    def computing(self, ranks: int, groups: int = 1) -> float:
        """Return the computing time in seconds of the rank with most work.

        Args:
            ranks: Number of ranks per group.
            groups: Number of groups, each of which takes a view.
        """
        shares = divide(self.pieces, self.halo, (1.0,) * ranks)
        held = self.held / min(ranks * groups, self.sharing)
        return (
            max(self._network(share, ranks, held) for share in shares)
            + (self.raster + self.matching) / ranks
            + self.fixed
        )

    def _network(self, share: Sequence[Piece], ranks: int, held: float) -> float:
        """Return the time in seconds of a rank's pieces, split into partition tiles as its memory requires."""
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
        """Return the time in seconds that ranks wait for data.

        Only the statistics of the last scale count; other scales' reductions overlap computation.
        """
        if ranks == 1:
            return 0.0
        image = 2 * link.all_gather(self._image_bytes, ranks)
        statistics = link.all_reduce(_FIRST_BYTES, ranks) + link.all_reduce(_SECOND_BYTES, ranks)
        return image + statistics + link.all_reduce(self._gradient_bytes, ranks)

    def sent(self, ranks: int) -> dict[Traffic, int]:
        """Return the bytes that a rank sends for each purpose, at all scales, as counted by `Collectives.sent`."""
        twice = 2 * (ranks - 1) / ranks  # once to reduce, once to distribute
        statistics = len(self.pieces) * (_FIRST_BYTES + _SECOND_BYTES)
        return {
            "image": int(twice * self._image_bytes),
            "statistics": int(twice * statistics),
            "gradient": int(twice * self._gradient_bytes),
        }

    @property
    def _image_bytes(self) -> int:
        # full size, whichever scales are computed from it
        height, width = max((piece.size[0] << piece.scale, piece.size[1] << piece.scale) for piece in self.pieces)
        return 12 * height * width

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


def probe_link(collectives: Collectives, device: torch.device) -> Link:
    """Time all-reduces over all ranks; the result is identical on all ranks.

    If there is only one rank, the link is infinitely fast.
    """
    if collectives.size == 1:
        return Link(math.inf, 0.0)
    largest = _PROBE_BYTES[device.type]
    short, long = (_slowest_sum(collectives, device, size) for size in (8, largest))
    steps = 2 * (collectives.size - 1)
    moved = steps * largest / collectives.size
    return Link(moved / max(long - short, 1e-9), short / steps)


def _slowest_sum(collectives: Collectives, device: torch.device, size: int) -> float:
    """Return the time in seconds of an all-reduce of this many bytes on the slowest rank.

    The last of three runs counts.
    """
    tensor = torch.zeros(size // 4, device=device)
    seconds = 0.0
    for _ in range(3):  # the first run opens the connections
        wait_for(device)
        collectives.all_gather(None)
        started = time.perf_counter()
        collectives.all_reduce(tensor)
        wait_for(device)
        seconds = time.perf_counter() - started
    return max(collectives.all_gather(seconds))


@dataclass(frozen=True)
class RanksChoice:
    """Chosen number of ranks.

    Attributes:
        ranks: Number of ranks that take part.
        seconds: Time in seconds of the whole schedule for each number of ranks considered.
    """

    ranks: int
    seconds: dict[int, float]

    @property
    def speed_up(self) -> float:
        """Speed-up over one rank."""
        return self.seconds[1] / self.seconds[self.ranks]


def choose_ranks(
    phases: Sequence[tuple[int, Sequence[IterationWork]]], views_per_step: int, available: int, link: Link
) -> RanksChoice:
    """Choose the smallest number of ranks whose time is within `LEAST_GAIN` of the best.

    Args:
        phases: Number of steps of each phase, and the work of iterations on a sample of views.
        views_per_step: Views per step, which groups of ranks process in parallel.
        available: Number of available ranks.
        link: Connection between the ranks.
    """
    seconds = {ranks: _schedule_seconds(phases, views_per_step, ranks, link) for ranks in _candidates(available)}
    best = min(seconds.values())
    enough = min(ranks for ranks, time_ in seconds.items() if time_ <= best * (1 + LEAST_GAIN))
    return RanksChoice(enough, seconds)


def _candidates(available: int) -> list[int]:
    """Return the numbers of ranks to consider: all up to eight, then increasing by a quarter."""
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
