"""Collectives over torch.distributed: NCCL between GPUs, gloo between CPUs and between ranks that share a GPU.

torch.distributed does not authenticate its peers. Ranks therefore listen on one interface only, which is loopback if
all ranks run on one machine. They never unpickle what they receive: decoding a message creates plain values, tensors,
and dataclasses and errors of this project, and runs no code that the sender chooses.

The order of a sum depends only on the number of ranks and the size of the tensors. All ranks therefore receive the
same bits, and repeated runs are bit-identical.
"""

import os
import socket
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from ipaddress import ip_address
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from sgsst_core.errors import SgsstError
from sgsst_core.features.statistics import LayerStatistics
from sgsst_core.messages import decode, encode
from sgsst_core.parallel import ALONE, Collectives, ImageExchange
from worker.processes import interface_towards, listen, split_address

T = TypeVar("T")
#: Minimum timeout of a rank that waits for another one.
DEFAULT_TIMEOUT = timedelta(seconds=120)
#: Timeout during preparation, when one rank may read or plan for a long time while the others wait.
PREPARING = timedelta(minutes=30)
#: Timeout as a number of iterations, used if it is longer than the minimum. Ranks are never that far apart.
ITERATIONS = 5


@contextmanager
def process_group(
    rank: int,
    size: int,
    address: str,
    *,
    device: torch.device | str = "cpu",
    timeout: timedelta = DEFAULT_TIMEOUT,
    listener: socket.socket | None = None,
) -> Iterator[Collectives]:
    """Join the process group of a job, and leave it at the end of the block.

    Args:
        rank: Rank of this process, 0 to size - 1.
        size: Number of ranks; for a single rank, no group is formed.
        address: Address "host:port" at which rank 0 listens.
        device: Device of this rank, which holds the tensors of all exchanges; a GPU with its index.
        timeout: Timeout of each exchange after `Collectives.set_timeout_for` was called.
        listener: Socket that rank 0 listens on; None opens one at the address.
    """
    if size == 1:
        yield ALONE
        return
    patience = max(timeout, PREPARING)
    _stay_on_interface(address)
    device, sharing, store = _meet(rank, size, address, torch.device(device), patience, listener)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    backend = _backend(device, sharing)
    # No device is bound to the group, so that subgroups get connections of their own, rather than those of this group,
    # which ranks that are left out could close.
    dist.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=patience)
    try:
        yield ProcessGroupCollectives(dist.group.WORLD, timeout, sharing)
    finally:
        dist.destroy_process_group()


def _stay_on_interface(address: str) -> None:
    """Restrict gloo and NCCL to the interface that leads to rank 0's "host:port".

    Operators can choose another interface by the libraries' own variables, unless all ranks run on one machine.
    """
    host, _ = split_address(address)
    interface = interface_towards(host)
    for name in ("GLOO_SOCKET_IFNAME", "NCCL_SOCKET_IFNAME"):
        if interface and (ip_address(host).is_loopback or name not in os.environ):
            os.environ[name] = interface


def _meet(
    rank: int,
    size: int,
    address: str,
    device: torch.device,
    timeout: timedelta,
    listener: socket.socket | None = None,
) -> tuple[torch.device, int, Any]:
    """Return the device of this rank's tensors, the largest number of ranks on one GPU, and the key-value store.

    The device is a GPU if every rank has one, else the CPU. Ranks agree on this before they form a group, because all
    of them must form it with the same back ends.
    """
    host, port = split_address(address)
    # Without an explicit socket, the store listens on all interfaces.
    descriptor = (listener or listen(host, port)).detach() if rank == 0 else None
    store: Any = dist.TCPStore(  # type: ignore[attr-defined]  # public, but not listed
        host, port, size, rank == 0, timeout, master_listen_fd=descriptor
    )
    store.set(f"device/{rank}", _processor(device))
    processors = [store.get(f"device/{other}").decode() for other in range(size)]
    if "cpu" in processors:
        return torch.device("cpu"), 1, store
    return device, max(Counter(processors).values()), store


def _processor(device: torch.device) -> str:
    """Return an identifier of a GPU, the same for all of its MIG slices; "cpu" for a CPU."""
    if device.type == "cpu":
        return "cpu"
    properties: Any = torch.cuda.get_device_properties(device)  # the type stubs lack its place on the bus
    return f"{socket.gethostname()} {properties.pci_domain_id}:{properties.pci_bus_id}:{properties.pci_device_id}"


def _backend(device: torch.device, sharing: int) -> str:
    """Return the back ends of torch.distributed. Values that are not tensors are always exchanged between CPUs.

    Without NCCL, or if ranks share a GPU, which NCCL refuses, gloo copies tensors of GPUs to the host and back.
    """
    return "cpu:gloo,cuda:nccl" if device.type == "cuda" and sharing == 1 and dist.is_nccl_available() else "gloo"


def _stacked(parts: Sequence[LayerStatistics]) -> LayerStatistics:
    """Stack statistics of the same number of channels: count [k, 1], mean [k, c], centered [k, c, c]."""
    counts, means, moments = zip(*((part.count[None], part.mean, part.centered) for part in parts), strict=True)
    return LayerStatistics(torch.stack(counts), torch.stack(means), torch.stack(moments))


def _half(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Return the row indices [n] and column indices [n] of a matrix's upper triangle with diagonal."""
    rows, columns = torch.triu_indices(len(matrix), len(matrix), device=matrix.device).unbind()
    return rows, columns


def _symmetric(halves: Tensor, channels: int) -> Tensor:
    """Return the symmetric matrices [k, channels, channels] that have these upper triangles [k, n]."""
    matrices = halves.new_empty((len(halves), channels, channels))
    rows, columns = _half(matrices[0])
    matrices[:, rows, columns] = halves
    matrices[:, columns, rows] = halves
    return matrices


class ProcessGroupCollectives(Collectives):
    """`Collectives` of a torch.distributed group.

    Args:
        timeout: Timeout of each exchange; see `process_group`.
        gpu_sharing: Largest number of ranks of the job on one GPU; 1 without GPUs.
    """

    def __init__(self, group: Any, timeout: timedelta, gpu_sharing: int = 1) -> None:
        self.rank = dist.get_rank(group)
        self.size = dist.get_world_size(group)
        self._group = group
        self.gpu_sharing = gpu_sharing
        self._timeout = timeout
        self.local_size = self.all_gather(_machine()).count(_machine())

    def gather_parts(
        self, exchanges: Sequence[ImageExchange], parts: Sequence[Tensor], windows: Sequence[Tensor]
    ) -> None:
        """See `Collectives`."""
        ranks, own = range(self.size), self.rank
        sent = [[each.in_part(part, own, r) for r in ranks] for each, part in zip(exchanges, parts, strict=True)]
        received = [[each.in_window(w, own, r) for r in ranks] for each, w in zip(exchanges, windows, strict=True)]
        for target, values in self._exchange(sent, received):
            target.copy_(values)

    def reduce_parts(self, exchanges: Sequence[ImageExchange], windows: Sequence[Tensor]) -> list[Tensor]:
        """See `Collectives`."""
        ranks, own = range(self.size), self.rank
        totals = [
            window.new_zeros((*each.parts[own].shape, *window.shape[2:]))
            for each, window in zip(exchanges, windows, strict=True)
        ]
        sent = [[each.in_window(w, own, r) for r in ranks] for each, w in zip(exchanges, windows, strict=True)]
        received = [[each.in_part(total, own, r) for r in ranks] for each, total in zip(exchanges, totals, strict=True)]
        for target, values in self._exchange(sent, received):
            target += values  # in the order of ranks, whichever this one is
        return totals

    def _exchange(
        self, sent: Sequence[Sequence[Tensor]], received: Sequence[Sequence[Tensor]]
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Send a rectangle of each image to each rank, all in one message.

        Args:
            sent: Rectangles of each image for each rank; may be empty.
            received: Rectangles of the sizes that each rank sends to this one.

        Yields:
            Each of `received` and the values for it, ordered by rank.
        """
        others = [rank for rank in range(self.size) if rank != self.rank]
        flat = torch.cat([image[rank].reshape(-1) for rank in others for image in sent])
        counts, expected = (
            [sum(image[rank].numel() for image in images) * (rank != self.rank) for rank in range(self.size)]
            for images in (sent, received)
        )
        into = flat.new_empty(sum(expected))
        dist.all_to_all_single(into, flat, expected, counts, group=self._group)
        values = iter(into.split([image[rank].numel() for rank in others for image in received]))
        for rank in range(self.size):
            for source, target in zip(sent, received, strict=True):
                yield target[rank], source[rank] if rank == self.rank else next(values).view_as(target[rank])

    def all_reduce(self, tensor: Tensor) -> Tensor:
        """See `Collectives`."""
        tensor = tensor.contiguous()
        dist.all_reduce(tensor, group=self._group)
        return tensor

    def all_reduce_statistics(
        self, parts: Sequence[LayerStatistics], numbers: Tensor
    ) -> tuple[list[LayerStatistics], Tensor]:
        """See `Collectives`.

        First the means are merged, then the second moments about the common mean. The second moment C of all positions
        is the sum over ranks r of C_r + n_r (mean_r - mean)(mean_r - mean)^T. This generalizes the pairwise update of
        Chan et al. (1979) to many parts. All terms are positive semidefinite, so there is no cancellation.

        Parts with the same number of channels are processed together, because on a GPU the time to launch many small
        kernels would be longer than the exchange.
        """
        if not parts:
            return [], self.all_reduce(numbers)
        indices: dict[int, list[int]] = {}
        for index, part in enumerate(parts):
            indices.setdefault(len(part.mean), []).append(index)
        stacks = [_stacked([parts[index] for index in some]) for some in indices.values()]
        sums = [torch.cat([stack.count, stack.count * stack.mean], dim=1) for stack in stacks]
        flat = self.all_reduce(torch.cat([*(each.flatten() for each in sums), numbers]))
        *totals, added = flat.split([*(each.numel() for each in sums), len(numbers)])
        counts, means, moments = [], [], []
        for stack, total in zip(stacks, totals, strict=True):
            count, weighted = total.view(len(stack.count), -1).tensor_split([1], dim=1)
            mean = weighted / count.clamp_min(torch.finfo(total.dtype).tiny)
            away = stack.mean - mean
            moment = stack.centered + away[:, :, None] * away[:, None, :] * stack.count[..., None]
            rows, columns = _half(moment[0])
            moments.append(moment[:, rows, columns])  # symmetric: one triangle is enough
            counts.append(count)
            means.append(mean)
        halves = self.all_reduce(torch.cat([each.flatten() for each in moments]))
        merged: dict[int, LayerStatistics] = {}
        values = halves.split([each.numel() for each in moments])
        for some, count, mean, half in zip(indices.values(), counts, means, values, strict=True):
            centered = _symmetric(half.view(len(some), -1), mean.shape[1])
            merged |= zip(some, map(LayerStatistics, count[:, 0], mean, centered), strict=True)
        return [merged[index] for index in range(len(parts))], added

    def all_gather(self, value: T) -> list[T]:
        """See `Collectives`."""
        own = encode(value)
        return [decode(self._broadcast(rank, own)) for rank in range(self.size)]

    def broadcast(self, make: Callable[[], T]) -> T:
        """See `Collectives`."""
        message = torch.empty(0, dtype=torch.uint8)
        if self.rank == 0:
            try:
                message = encode((make(), None))
            except SgsstError as error:
                message = encode((None, error))
        value: T
        value, problem = decode(self._broadcast(0, message))
        if problem is not None:
            raise problem
        return value

    def _broadcast(self, source: int, message: Tensor) -> Tensor:
        """Return the message of a rank, given that of this rank."""
        size = torch.tensor([len(message)])
        dist.broadcast(size, group=self._group, group_src=source)
        if self.rank != source:
            message = message.new_empty(int(size))
        dist.broadcast(message, group=self._group, group_src=source)
        return message

    def set_timeout_for(self, iteration_seconds: float) -> None:
        """See `Collectives`."""
        self._group.set_timeout(max(self._timeout, timedelta(seconds=ITERATIONS * iteration_seconds)))

    def split_group(self, groups: int) -> Collectives:
        """See `Collectives`."""
        each = self.size // groups
        parts = [self._subgroup(range(start, start + each)) for start in range(0, self.size, each)]
        return next(part for part in parts if part is not None)

    def _subgroup(self, ranks: range) -> Collectives | None:
        """Return a group of ranks; None on other ranks. Every rank of the job must call this, as of `new_group`."""
        if len(ranks) == self.size:
            return self
        if len(ranks) == 1:
            return ALONE if self.rank in ranks else None
        group = dist.new_group(list(ranks), timeout=max(self._timeout, PREPARING))
        if self.rank not in ranks:
            return None
        return ProcessGroupCollectives(group, self._timeout, self.gpu_sharing)


def _machine() -> tuple[str, str]:
    """Return an identifier of the machine. A container counts as a machine, because it has its own memory limit."""
    return socket.gethostname(), os.environ.get("HOSTNAME", "")
