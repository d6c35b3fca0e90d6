"""What the ranks of a job tell each other, as one small interface; `ALONE` is a job of one rank, with nobody to tell.

Every rank calls the same methods in the same order; that is what makes them meet. Results that are "the same on every
rank" are the same bits, so that whatever follows from them is decided alike everywhere without another message.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, Protocol, TypeVar, get_args

from torch import Tensor

from sgsst_core.features.statistics import LayerStatistics
from sgsst_core.rasterizer.arguments import Rows

T = TypeVar("T")

#: Waits for statistics under way: those of all ranks together, and the sums [k] float64 of the numbers that went with
#: them. On a GPU the device waits, not the caller.
Merged = Callable[[], tuple[list[LayerStatistics], Tensor]]

#: What tensors are sent for.
Traffic = Literal["image", "statistics", "gradient"]
TRAFFIC: tuple[Traffic, ...] = get_args(Traffic)


class Collectives(Protocol):
    """One rank's end of the exchanges of a group of ranks.

    Attributes:
        rank: this one's number in the group.
        size: how many there are.
        local_size: how many of them share this machine's memory, this one included.
    """

    rank: int
    size: int
    local_size: int

    @property
    def sent(self) -> Mapping[Traffic, int]:
        """Bytes of tensors that this rank has sent so far, as rings move them; of other values, all are small.

        One count for this group, the one that it was made of, and those made of it.
        """
        ...

    def all_gather_rows(self, band: Tensor, bands: Sequence[Rows]) -> Tensor:
        """The image [H, ...] of every rank's band of rows [h, ...]; `bands` says which rows each has, in order."""
        ...

    def reduce_scatter_rows(self, image: Tensor, bands: Sequence[Rows]) -> Tensor:
        """This rank's band [h, ...] of the sum over all ranks' images [H, ...]: the adjoint of `all_gather_rows`."""
        ...

    def all_reduce(self, tensor: Tensor, traffic: Traffic = "gradient") -> Tensor:
        """The sum over all ranks, the same on every rank. The argument may be overwritten."""
        ...

    def union(self, mask: Tensor) -> Tensor:
        """[n] bool: where any rank's mask [n] bool is true; the same on every rank."""
        ...

    def all_reduce_statistics(self, parts: Sequence[LayerStatistics], numbers: Tensor) -> Merged:
        """Start merging the statistics of disjoint positions, layer by layer, and adding up numbers [k] float64.

        Returns at once; what it returns waits for the result, the same on every rank. No other exchange may be started
        before all results have been waited for, but for further ones of this kind.
        """
        ...

    def all_gather(self, value: T) -> list[T]:
        """Every rank's value, by rank: the same on every rank.

        Values are small: plain ones, lists, tuples, dicts, paths, arrays, tensors, and dataclasses and errors of ours.
        """
        ...

    def broadcast(self, make: Callable[[], T]) -> T:
        """What `make` returns on rank 0, the only one that calls it; an `SgsstError` of it is raised on every rank."""
        ...

    def set_timeout_for(self, iteration_seconds: float) -> None:
        """From now on ranks meet in every iteration: one that keeps the others waiting for much longer is given up.

        Until this is called, they wait for as long as it may take to prepare a job.
        """
        ...

    def leading_group(self, count: int) -> Collectives | None:
        """The group of the first `count` ranks; None on the others."""
        ...

    def split_group(self, groups: int) -> Collectives:
        """The group of this rank when neighboring ranks form so many groups of equal size."""
        ...


class RankLeftOut(Exception):  # noqa: N818 (not an error: the job goes on without this rank)
    """Raised on ranks that the plan leaves out, because they would only add communication."""


class _Alone:
    """The collectives of one rank."""

    rank, size, local_size = 0, 1, 1
    sent: Mapping[Traffic, int] = MappingProxyType(dict.fromkeys(TRAFFIC, 0))

    def all_gather_rows(self, band: Tensor, bands: Sequence[Rows]) -> Tensor:
        return band

    def reduce_scatter_rows(self, image: Tensor, bands: Sequence[Rows]) -> Tensor:
        return image

    def all_reduce(self, tensor: Tensor, traffic: Traffic = "gradient") -> Tensor:
        return tensor

    def union(self, mask: Tensor) -> Tensor:
        return mask

    def all_reduce_statistics(self, parts: Sequence[LayerStatistics], numbers: Tensor) -> Merged:
        return lambda: (list(parts), numbers)

    def all_gather(self, value: T) -> list[T]:
        return [value]

    def broadcast(self, make: Callable[[], T]) -> T:
        return make()

    def set_timeout_for(self, iteration_seconds: float) -> None:
        return None

    def leading_group(self, count: int) -> Collectives | None:
        return self

    def split_group(self, groups: int) -> Collectives:
        return self


ALONE: Collectives = _Alone()


def same_on_all(collectives: Collectives, value: Any) -> bool:
    """Whether every rank has an equal value; the same answer on every rank."""
    return all(other == value for other in collectives.all_gather(value))
