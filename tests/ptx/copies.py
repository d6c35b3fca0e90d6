"""Asynchronous copies from global to shared memory (PTX ISA, "cp.async")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tests.ptx.memory import SharedMemory


@dataclass(frozen=True)
class _Copy:
    """Data of one instruction that has not arrived: threads, their current groups, addresses and bytes."""

    lanes: np.ndarray
    groups: np.ndarray
    addresses: np.ndarray
    values: np.ndarray

    def where(self, chosen: np.ndarray) -> _Copy:
        return _Copy(self.lanes[chosen], self.groups[chosen], self.addresses[chosen], self.values[chosen])


class AsyncCopies:
    """Copies of all threads. Data may arrive at any time until the thread waits for its group.

    The addresses are therefore written twice: by undefined bytes when the copy starts, by the data when the thread
    waits. Accesses by other threads in between are races, unless barriers separate them.

    Args:
        threads: Number of threads of all program instances.
    """

    def __init__(self, threads: int) -> None:
        self._groups = np.zeros(threads, np.int64)
        self._pending: list[_Copy] = []

    def start(self, shared: SharedMemory, lanes: np.ndarray, addresses: np.ndarray, values: np.ndarray) -> None:
        """Start copies of some threads: bytes [threads, width] to addresses [threads]."""
        shared.store(addresses, values.shape[1], np.full_like(values, 0xFF), lanes)
        self._pending.append(_Copy(lanes, self._groups[lanes], addresses, values))

    def commit(self, lanes: np.ndarray) -> None:
        """End the current group of some threads."""
        self._groups[lanes] += 1

    def wait(self, shared: SharedMemory, lanes: np.ndarray, latest: int) -> None:
        """Let some threads wait for all of their groups except the latest ones."""
        waits = np.zeros(len(self._groups), bool)
        waits[lanes] = True
        pending, self._pending = self._pending, []
        for copy in pending:
            due = waits[copy.lanes] & (copy.groups < self._groups[copy.lanes] - latest)
            arrived, left = copy.where(due), copy.where(~due)
            if len(arrived.lanes):
                shared.store(arrived.addresses, arrived.values.shape[1], arrived.values, arrived.lanes)
            if len(left.lanes):
                self._pending.append(left)
