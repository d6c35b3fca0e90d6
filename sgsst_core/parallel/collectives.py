"""Collective operations between the ranks of a job, and the groups that they form.

`worker.ranks.process_group` has the operations of several ranks. Every rank calls the same methods in the same order.
Results that are "identical on all ranks" are bit-identical, so all ranks reach the same decisions based on such results
without further messages.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, TypeVar, get_args

from torch import Tensor

from sgsst_core.errors import RanksDriftedError
from sgsst_core.features.partition import Rectangle
from sgsst_core.features.statistics import LayerStatistics
from sgsst_core.settings import Settings

T = TypeVar("T")

#: Purposes for which tensors are sent.
Traffic = Literal["image", "statistics", "gradient"]
TRAFFIC: tuple[Traffic, ...] = get_args(Traffic)


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
        sent: Bytes of tensors sent by this rank so far, assuming ring algorithms; other messages are negligible. The
            count is shared between this group, its parent group and its subgroups.
    """

    rank: int = 0
    size: int = 1
    local_size: int = 1
    gpu_sharing: int = 1
    sent: Mapping[Traffic, int] = MappingProxyType(dict.fromkeys(TRAFFIC, 0))

    def gather_parts(
        self, exchanges: Sequence[ImageExchange], parts: Sequence[Tensor], windows: Sequence[Tensor]
    ) -> None:
        """Fill each rank's windows of some images from every rank's parts of them.

        Args:
            exchanges: Rectangles of the parts and windows of each image.
            parts: [h, w, ...], part of this rank of each image.
            windows: [h, w, ...], window of this rank of each image. Pixels in no part are left unchanged.
        """
        for exchange, part, window in zip(exchanges, parts, windows, strict=True):
            exchange.in_window(window, 0, 0).copy_(exchange.in_part(part, 0, 0))

    def reduce_parts(self, exchanges: Sequence[ImageExchange], windows: Sequence[Tensor]) -> list[Tensor]:
        """Return this rank's part [h, w, ...] of the sum of all ranks' windows, for each image.

        This is the adjoint of `gather_parts`.
        """
        totals = []
        for exchange, window in zip(exchanges, windows, strict=True):
            totals.append(window.new_zeros((*exchange.parts[0].shape, *window.shape[2:])))
            exchange.in_part(totals[-1], 0, 0).copy_(exchange.in_window(window, 0, 0))
        return totals

    def all_reduce(self, tensor: Tensor, traffic: Traffic = "gradient") -> Tensor:
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


def same_on_all(collectives: Collectives, value: Any) -> bool:
    """Return whether all ranks have equal values; the result is identical on all ranks."""
    return all(other == value for other in collectives.all_gather(value))


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

    def expect(self, seconds: float) -> None:
        """Set the timeouts of the ranks for steps that take so many seconds."""
        for ranks in (self.everybody, self.group):
            ranks.set_timeout_for(seconds)

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
        if not same_on_all(self.everybody, checksum):
            raise RanksDriftedError(
                f"Step {step}: the ranks' colors are no longer the same. They compute differently: run on "
                "machines of one kind, with the same versions of this program and of PyTorch."
            )
