"""Spherical harmonics of large scenes, left in the scene's file until a view needs them.

The coefficients above degree 0 make up three quarters of a scene of degree 3. They never change, and each view reads
them once. The file is read in blocks, into a buffer that stays in the CPU cache. The operating system's page cache
holds the file: it uses memory that is otherwise free, and all processes that read the file share it.

The file is not memory-mapped. If another program truncates or rewrites a mapped file, the next access to its pages
kills the process (SIGBUS), and a user's file may be overwritten at any time during a job of several hours. A short
read, in contrast, raises an ordinary error. Reading 4 million Gaussians takes a tenth of a second longer than mapping
them.
"""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.errors import SceneError, reading_scene

#: Bytes per read; a block stays in the L2 cache of one core until it has been used.
BLOCK_BYTES = 1 << 20

#: Callback for a block of file rows that contains n consecutive Gaussians of the scene. Arguments: index of the first
#: of these Gaussians, coefficients [R, K, 3] float32 of all rows of the block, and the row [n] int32 of each Gaussian
#: in the block. The coefficients are overwritten after the callback returns.
BlockWork = Callable[[int, NDArray[np.float32], NDArray[np.int32]], None]


@dataclass(frozen=True)
class RowLayout:
    """Layout of coefficients in a file: rows of equal length.

    Each row contains all float32 coefficients of red, then green, then blue.

    Attributes:
        stamp: Size in bytes and modification time in ns.
        offset: Byte offset of the first row.
        row_bytes: Length of a row in bytes, a multiple of 4.
        column: Byte offset of the coefficients within a row, a multiple of 4.
        coefficients: Number of coefficients per color channel in a row: 3, 8 or 15.
    """

    path: Path
    stamp: tuple[int, int]
    offset: int
    rows: int
    row_bytes: int
    column: int
    coefficients: int


class RowFile:
    """File that several readers share; it is closed once nothing refers to it any more.

    Raises:
        SceneError: If it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with reading_scene(path):
            self._file = path.open("rb", buffering=0)
        self._reading = threading.Lock()
        weakref.finalize(self, self._file.close)

    @property
    def stamp(self) -> tuple[int, int]:
        """Size in bytes and modification time in ns."""
        status = os.fstat(self._file.fileno())
        return status.st_size, status.st_mtime_ns

    def check_unchanged(self, stamp: tuple[int, int]) -> None:
        """Raise SceneError if the file's size or modification time differs from an earlier `stamp`."""
        if self.stamp != stamp:
            raise changed(self.path)

    def read(self, offset: int, buffer: NDArray[np.uint8]) -> None:
        """Fill a buffer with the bytes of the file from `offset` on.

        Raises:
            SceneError: If the file is too short or cannot be read.
        """
        left = buffer.data
        while left:
            try:
                count = self._read(left, offset)
            except OSError as error:
                raise SceneError(f"{self.path}: cannot be read: {error.strerror}. Run again.") from error
            if not count:
                raise changed(self.path)
            left, offset = left[count:], offset + count

    def _read(self, buffer: memoryview, offset: int) -> int:
        if hasattr(os, "preadv"):
            return os.preadv(self._file.fileno(), [buffer], offset)
        with self._reading:  # Windows reads only at the position, which all threads share
            self._file.seek(offset)
            return self._file.readinto(buffer)


def changed(path: Path) -> SceneError:
    """Return the error for a file that was changed after it was read."""
    return SceneError(
        f"{path}: was changed after it was read; the new colors may belong to other Gaussians. "
        "Put the original file back and run again."
    )


class StoredHarmonics:
    """Coefficients [N, K, 3] float32 of degree 1 to 3 in a file, as a replacement for a tensor of that shape.

    Args:
        chosen: [N] int32, ascending row numbers of the scene's Gaussians, possibly with repetitions; None for all rows.
        coefficients: K, number of leading coefficients to use; None for all.
        file: The file if it is already open; None to open it.
        factor: Factor of the coefficients, rounded to float32 and applied on reading.

    Raises:
        SceneError: If the file cannot be opened or does not match the layout.
    """

    dtype = torch.float32
    device = torch.device("cpu")

    def __init__(
        self,
        layout: RowLayout,
        chosen: NDArray[np.int32] | None = None,
        coefficients: int | None = None,
        file: RowFile | None = None,
        factor: float = 1.0,
    ) -> None:
        self.layout = layout
        self._factor = factor
        self._chosen = chosen
        self._file = file or RowFile(layout.path)
        self._file.check_unchanged(layout.stamp)
        count = layout.rows if chosen is None else len(chosen)
        self.shape = torch.Size((count, layout.coefficients if coefficients is None else coefficients, 3))

    @property
    def arguments(self) -> tuple[Any, ...]:
        """Constructor arguments with which another process opens the same coefficients."""
        return self.layout, self._chosen, self.shape[1], None, self._factor

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the constructor arguments; the process that unpickles them opens the file itself."""
        return StoredHarmonics, self.arguments

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: Tensor) -> StoredHarmonics | Tensor:
        """Select Gaussians by mask [N] bool or by indices, which may repeat.

        Ascending selections stay in the file; others are returned as a tensor.
        """
        if rows.dtype == torch.bool:
            rows = rows.nonzero()[:, 0]
        if len(rows) > 1 and not bool((rows[1:] >= rows[:-1]).all()):
            ascending, inverse = rows.unique(return_inverse=True)
            return held(self[ascending])[inverse]
        indices = rows.to("cpu", torch.int32).numpy()
        chosen = indices if self._chosen is None else self._chosen[indices]
        return StoredHarmonics(self.layout, chosen, self.shape[1], self._file, self._factor)

    def first(self, coefficients: int) -> StoredHarmonics:
        """Return only the first `coefficients` of each color channel."""
        return StoredHarmonics(self.layout, self._chosen, coefficients, self._file, self._factor)

    def times(self, factor: float) -> StoredHarmonics:
        """Return the coefficients multiplied by a factor, in float32 as for a tensor in memory."""
        return StoredHarmonics(self.layout, self._chosen, self.shape[1], self._file, self._factor * factor)

    def to(self, device: torch.device | str) -> StoredHarmonics | Tensor:
        """Return `self` for the CPU, and a tensor [N, K, 3] for a GPU."""
        return self if torch.device(device).type == "cpu" else self.tensor(device)

    def tensor(self, device: torch.device | str = "cpu") -> Tensor:
        """Load all coefficients, [N, K, 3], without a second copy in CPU memory."""
        values = torch.empty(self.shape, device=device)

        def copy(start: int, block: NDArray[np.float32], rows: NDArray[np.int32]) -> None:
            values[start : start + len(rows)] = torch.from_numpy(block[rows])

        self.for_blocks(copy, threads=None if values.device.type == "cpu" else 1)
        return values

    def for_blocks(self, work: BlockWork, threads: int | None = None) -> None:
        """Call a function on all coefficients, block by block, on as many cores as PyTorch uses.

        Args:
            work: Callback, called by several threads at once and with blocks in any order.
            threads: Number of threads; None for PyTorch's. A single thread processes the blocks in order.

        Raises:
            SceneError: If the file was changed after it was first read.
        """
        step = self._rows_at_a_time()
        bounds = list(range(0, self.layout.rows, step))
        threads = min(threads or torch.get_num_threads(), len(bounds))
        if threads <= 1:
            self._work_through(work, bounds)
        else:
            with ThreadPoolExecutor(threads, thread_name_prefix="harmonics") as pool:
                # Blocks are interleaved, so that threads read neighboring parts of a file that may be on a disk.
                for future in [pool.submit(self._work_through, work, bounds[i::threads]) for i in range(threads)]:
                    future.result()
        self._file.check_unchanged(self.layout.stamp)

    def _rows_at_a_time(self) -> int:
        return max(1, BLOCK_BYTES // self.layout.row_bytes)

    def _work_through(self, work: BlockWork, bounds: list[int]) -> None:
        """Call `work` for the blocks that start at the file rows `bounds`."""
        layout, step = self.layout, self._rows_at_a_time()
        buffer = np.empty(step * layout.row_bytes, np.uint8)
        consecutive = np.arange(step, dtype=np.int32)
        first, last = layout.column // 4, layout.column // 4 + 3 * layout.coefficients
        table = buffer.view("<f4").reshape(step, -1)[:, first:last].reshape(step, 3, -1)
        values = table.transpose(0, 2, 1)[:, : self.shape[1]]
        for row in bounds:
            count = min(step, layout.rows - row)
            start, rows = row, consecutive[:count]
            if self._chosen is not None:
                start, stop = np.searchsorted(self._chosen, np.array((row, row + count), np.int32)).tolist()
                rows = self._chosen[start:stop] - np.int32(row)
            if len(rows):
                self._file.read(layout.offset + row * layout.row_bytes, buffer[: count * layout.row_bytes])
                if self._factor != 1:
                    values[:count] *= np.float32(self._factor)
                work(start, values, rows)


def held(sh_rest: Tensor | StoredHarmonics) -> Tensor:
    """Return coefficients [N, K, 3] as a tensor on their present device."""
    return sh_rest.tensor() if isinstance(sh_rest, StoredHarmonics) else sh_rest
