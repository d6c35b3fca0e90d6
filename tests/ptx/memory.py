"""Global and shared memory of the PTX interpreter, with the checks of a GPU and with race detection."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable

import numpy as np
import torch

#: Tensors above this size are not checked for races: the trackers take eight times their size.
MAX_TRACKED_BYTES = 1 << 28


class FaultError(Exception):
    """Access that a GPU would refuse, or whose result depends on the order of threads."""


class Region:
    """Memory of one tensor, with the last program that wrote each byte and the programs that read it.

    Trackers hold 0 for "none", otherwise the program's number plus 1; `SEVERAL` stands for more than one reader.
    """

    SEVERAL = -1

    def __init__(self, tensor: torch.Tensor) -> None:
        storage = tensor.untyped_storage()
        self.start, self.size = storage.data_ptr(), storage.nbytes()
        self.bytes = np.ctypeslib.as_array(
            ctypes.cast(self.start, ctypes.POINTER(ctypes.c_uint8)), (max(self.size, 1),)
        )
        self.tracked = self.size <= MAX_TRACKED_BYTES
        size = self.size if self.tracked else 0
        self.writer, self.reader = np.zeros(size, np.int32), np.zeros(size, np.int32)


class GlobalMemory:
    """Memory of all tensors that a launch may access.

    Args:
        tensors: Tensors on the CPU. Views of one storage are one region, as on a GPU.
    """

    def __init__(self, tensors: Iterable[torch.Tensor]) -> None:
        regions = {tensor.untyped_storage().data_ptr(): Region(tensor) for tensor in tensors if tensor.numel()}
        self.regions = [regions[start] for start in sorted(regions)]
        self.starts = np.array([region.start for region in self.regions], np.uint64)

    def load(self, addresses: np.ndarray, width: int, programs: np.ndarray) -> np.ndarray:
        """Return bytes [n, width] at addresses [n] uint64, read by programs [n] int32 (number plus 1)."""
        result = np.empty((len(addresses), width), np.uint8)
        for region, lanes, index in self._locate(addresses, width):
            result[lanes] = region.bytes[index]
            if region.tracked:
                reader, program = region.reader[index], programs[lanes, None]
                if ((region.writer[index] != 0) & (region.writer[index] != program)).any():
                    raise FaultError("race: a program reads what another one wrote")
                region.reader[index] = np.where((reader == 0) | (reader == program), program, Region.SEVERAL)
                if (region.reader[index] != program).any():  # several programs in this instruction
                    shared = index[(region.reader[index] != program).any(axis=1)]
                    region.reader[shared] = Region.SEVERAL
        return result

    def store(self, addresses: np.ndarray, width: int, values: np.ndarray, programs: np.ndarray) -> None:
        """Store bytes [n, width] at addresses [n] uint64, written by programs [n] int32 (number plus 1)."""
        for region, lanes, index in self._locate(addresses, width):
            region.bytes[index] = values[lanes]
            if (region.bytes[index] != values[lanes]).any():
                raise FaultError("race: threads write different values to one address at once")
            if region.tracked:
                program = programs[lanes, None]
                writer, reader = region.writer[index], region.reader[index]
                region.writer[index] = program
                if ((writer != 0) & (writer != program)).any() or (region.writer[index] != program).any():
                    raise FaultError("race: two programs write to one address")
                if ((reader != 0) & (reader != program)).any():
                    raise FaultError("race: a program writes what another one read")

    def _locate(self, addresses: np.ndarray, width: int) -> Iterable[tuple[Region, np.ndarray, np.ndarray]]:
        """Yield region, lanes and byte index [lanes, width] of each tensor accessed by an instruction."""
        if (addresses % np.uint64(width)).any():
            raise FaultError(f"misaligned access of {width} bytes")
        index = np.searchsorted(self.starts, addresses, side="right") - 1
        for number in np.unique(index):
            lanes = np.nonzero(index == number)[0]
            region = self.regions[number]
            offset = (addresses[lanes] - np.uint64(region.start)).astype(np.int64)
            if number < 0 or int(offset.max()) + width > region.size:
                raise FaultError(
                    f"access outside of all tensors, {int(offset.max()) - region.size} bytes after the end"
                )
            yield region, lanes, offset[:, None] + np.arange(width)


class SharedMemory:
    """Shared memory of several programs, with each byte's last writer and its readers since the last barrier.

    Args:
        programs: Number of programs.
        size: Shared memory per program in bytes.
        threads: Threads per program.
    """

    def __init__(self, programs: int, size: int, threads: int) -> None:
        self.size = size
        self.warp = np.tile(np.arange(threads) // 32, programs).astype(np.int32)
        self.program = np.repeat(np.arange(programs), threads)
        self.bytes = np.zeros(programs * size, np.uint8)
        self.barriers = np.zeros(programs, np.int32)
        self.writer = np.zeros(programs * size, np.int32)
        self.readers = np.zeros(programs * size, np.uint32)
        # Number of the barrier after which the last write and the last reads happened.
        self.written = np.full(programs * size, -1, np.int32)
        self.read = np.full(programs * size, -1, np.int32)

    def load(self, addresses: np.ndarray, width: int, lanes: np.ndarray) -> np.ndarray:
        """Return bytes [n, width] at addresses [n] int64, read by threads `lanes` [n]."""
        index, barrier = self._locate(addresses, width, lanes)
        fresh = self.read[index] == barrier
        self.readers[index[~fresh]] = 0
        self.read[index] = barrier
        bits = np.broadcast_to(np.uint32(1) << self.warp[lanes].astype(np.uint32)[:, None], index.shape)
        np.bitwise_or.at(self.readers, index, bits)
        return self.bytes[index]

    def store(self, addresses: np.ndarray, width: int, values: np.ndarray, lanes: np.ndarray) -> None:
        """Store bytes [n, width] at addresses [n] int64, written by threads `lanes` [n]."""
        index, barrier = self._locate(addresses, width, lanes)
        warp = self.warp[lanes, None]
        others = self.readers[index] & ~(np.uint32(1) << warp.astype(np.uint32))
        if ((self.read[index] == barrier) & (others != 0)).any():
            raise FaultError("race in shared memory: a warp writes what another one read, without a barrier in between")
        self.writer[index], self.written[index] = warp, barrier
        self.bytes[index] = values
        # Replicated data are written by several warps at once.
        if (self.bytes[index] != values).any():
            raise FaultError("race in shared memory: threads write different values to one address at once")

    def _locate(self, addresses: np.ndarray, width: int, lanes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return byte index [n, width], and each thread's barrier count [n, 1]; check earlier writes."""
        if (addresses % width).any():
            raise FaultError(f"misaligned access of {width} bytes to shared memory")
        if addresses.min() < 0 or addresses.max() + width > self.size:
            raise FaultError(f"access to byte {addresses.max() + width - 1} of {self.size} bytes of shared memory")
        program = self.program[lanes]
        index = (addresses + program * self.size)[:, None] + np.arange(width)
        barrier = self.barriers[program][:, None]
        if ((self.written[index] == barrier) & (self.writer[index] != self.warp[lanes, None])).any():
            raise FaultError(
                "race in shared memory: a warp accesses what another one wrote, without a barrier in between"
            )
        return index, barrier
