"""Spherical harmonics of large scenes: they stay in the scene's file until a view asks for them.

They are three quarters of a scene of degree 3, are never changed, and a view needs each of them once. The file is read
by blocks into a buffer that stays in the processor's cache, where the system's own cache of files holds it: for that
memory is found when nobody else needs it, and it is shared by all processes that read the file.

The file is not mapped. Where somebody else shortens a mapped file, or writes it anew from its start, the next look at
its pages kills the process (SIGBUS), and a user's file may be overwritten at any time in the hours that a job takes.
A read that comes back short is an error like any other, and costs a tenth of a second more for 4 million Gaussians.
"""

from __future__ import annotations

import os
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

from sgsst_core.errors import SceneError

#: Bytes that are read at a time: they stay in one core's second-level cache until they have been used.
BLOCK_BYTES = 1 << 20

#: Takes the first of some Gaussians that follow each other, the coefficients [R, K, 3] float32 of a block's rows, and
#: the rows [n] int32 in it that are those Gaussians'. The coefficients are overwritten when it returns.
BlockWork = Callable[[int, NDArray[np.float32], NDArray[np.int32]], None]


@dataclass(frozen=True)
class RowLayout:
    """Where a file holds coefficients: rows of one length, in each all float32 coefficients of red, green, blue.

    Attributes:
        path: the file.
        stamp: its size in bytes and time of last change (ns).
        offset: byte at which the first row starts.
        rows: how many there are.
        row_bytes: length of a row, a multiple of 4.
        column: byte of a row at which its coefficients start, a multiple of 4.
        coefficients: of one color in a row: 3, 8 or 15.
    """

    path: Path
    stamp: tuple[int, int]
    offset: int
    rows: int
    row_bytes: int
    column: int
    coefficients: int


class RowFile:
    """A file that is read by many at once, open until the last of them is gone.

    Raises:
        SceneError: it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))
        except OSError as error:
            raise SceneError(f"{path}: cannot be read: {error.strerror}. Check the path.") from error
        weakref.finalize(self, os.close, self._descriptor)

    @property
    def stamp(self) -> tuple[int, int]:
        """Size in bytes and time of last change (ns)."""
        status = os.fstat(self._descriptor)
        return status.st_size, status.st_mtime_ns

    def check_unchanged(self, stamp: tuple[int, int]) -> None:
        """Raise SceneError where the file is no longer what it was when its stamp was taken."""
        if self.stamp != stamp:
            raise changed(self.path)

    def read(self, offset: int, buffer: NDArray[np.uint8]) -> None:
        """Fill a buffer from some byte on.

        Raises:
            SceneError: the file ends before, or cannot be read.
        """
        left = buffer.data
        while left:
            try:
                count = os.preadv(self._descriptor, [left], offset)
            except OSError as error:
                raise SceneError(f"{self.path}: cannot be read: {error.strerror}. Run again.") from error
            if not count:
                raise changed(self.path)
            left, offset = left[count:], offset + count


def changed(path: Path) -> SceneError:
    """The error of a file that is no longer the one that was read."""
    return SceneError(
        f"{path}: was changed after it was read; the new colors may belong to other Gaussians. "
        "Put the original file back and run again."
    )


class StoredHarmonics:
    """Coefficients [N, K, 3] float32 of degree 1 to 3 in a file, in place of a tensor of that shape.

    Args:
        layout: where they are.
        chosen: [N] int32, ascending: the rows that are the scene's Gaussians, some perhaps of several; None for all.
        coefficients: K, the first ones of the file's; None for all.
        file: the file, if it is open already.
        factor: by which they are multiplied when they are read; rounded to float32.

    Raises:
        SceneError: the file cannot be opened, or is no longer what the layout says.
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
        return StoredHarmonics, self.arguments

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: Tensor) -> StoredHarmonics | Tensor:
        """Those of some Gaussians ([N] bool, or indices; some several times); only ascending ones stay in the file."""
        if rows.dtype == torch.bool:
            rows = rows.nonzero()[:, 0]
        if len(rows) > 1 and not bool((rows[1:] >= rows[:-1]).all()):
            ascending, places = rows.unique(return_inverse=True)
            return self._of(ascending).tensor()[places]
        return self._of(rows)

    def _of(self, rows: Tensor) -> StoredHarmonics:
        """Those of Gaussians whose indices ascend."""
        indices = rows.to("cpu", torch.int32).numpy()
        chosen = indices if self._chosen is None else self._chosen[indices]
        return StoredHarmonics(self.layout, chosen, self.shape[1], self._file, self._factor)

    def first(self, coefficients: int) -> StoredHarmonics:
        """The first coefficients of each color alone."""
        return StoredHarmonics(self.layout, self._chosen, coefficients, self._file, self._factor)

    def times(self, factor: float) -> StoredHarmonics:
        """All of them multiplied by a factor, as a tensor in memory would be: in float32."""
        return StoredHarmonics(self.layout, self._chosen, self.shape[1], self._file, self._factor * factor)

    def to(self, device: torch.device | str) -> StoredHarmonics | Tensor:
        """Themselves where they are used from the CPU; on a GPU a tensor [N, K, 3]."""
        return self if torch.device(device).type == "cpu" else self.tensor(device)

    def tensor(self, device: torch.device | str = "cpu") -> Tensor:
        """All of them, [N, K, 3]; never twice in the CPU's memory."""
        values = torch.empty(self.shape, device=device)

        def copy(start: int, block: NDArray[np.float32], rows: NDArray[np.int32]) -> None:
            values[start : start + len(rows)] = torch.from_numpy(block[rows])

        self.for_blocks(copy, threads=None if values.device.type == "cpu" else 1)
        return values

    def largest(self) -> Tensor:
        """[N] float32, the largest magnitude among each Gaussian's coefficients."""
        found = torch.empty(len(self))

        def look(start: int, block: NDArray[np.float32], rows: NDArray[np.int32]) -> None:
            found[start : start + len(rows)] = torch.from_numpy(np.abs(block[rows]).max(axis=(1, 2)))

        self.for_blocks(look)
        return found

    def used_coefficients(self) -> int:
        """How many of the first coefficients are not 0 in all Gaussians together; looks no further than it must."""
        step, used = self._rows_at_a_time() * 16, 0
        for start in range(0, len(self), step):
            values = self._of(torch.arange(start, min(start + step, len(self)))).tensor()[:, used:]
            found = (values != 0).any(dim=2).any(dim=0).nonzero()
            used += int(found[-1]) + 1 if len(found) else 0
            if used == self.shape[1]:
                break
        return used

    def for_blocks(self, work: BlockWork, threads: int | None = None) -> None:
        """Do some work on all coefficients, block by block, on as many cores as PyTorch was told to use.

        Args:
            work: called by several threads at once, with blocks in any order.
            threads: how many, in place of PyTorch's; blocks come in order to a single one.

        Raises:
            SceneError: the file was changed since it was first read.
        """
        step = self._rows_at_a_time()
        bounds = list(range(0, self.layout.rows, step))
        threads = min(threads or torch.get_num_threads(), len(bounds))
        if threads <= 1:
            self._work_through(work, bounds)
        else:
            with ThreadPoolExecutor(threads, thread_name_prefix="harmonics") as pool:
                # Neighboring parts of the file to all threads at the same time: it may have to come from a disk.
                for done in [pool.submit(self._work_through, work, bounds[i::threads]) for i in range(threads)]:
                    done.result()
        self._file.check_unchanged(self.layout.stamp)

    def _rows_at_a_time(self) -> int:
        return max(1, BLOCK_BYTES // self.layout.row_bytes)

    def _work_through(self, work: BlockWork, bounds: list[int]) -> None:
        """Do the work on the blocks that begin at some rows of the file."""
        layout, step = self.layout, self._rows_at_a_time()
        buffer = np.empty(step * layout.row_bytes, np.uint8)
        every = np.arange(step, dtype=np.int32)
        first, last = layout.column // 4, layout.column // 4 + 3 * layout.coefficients
        table = buffer.view("<f4").reshape(step, -1)[:, first:last].reshape(step, 3, -1)
        values = table.transpose(0, 2, 1)[:, : self.shape[1]]
        for row in bounds:
            count = min(step, layout.rows - row)
            start, rows = row, every[:count]
            if self._chosen is not None:
                start, stop = np.searchsorted(self._chosen, np.array((row, row + count), np.int32)).tolist()
                rows = self._chosen[start:stop] - np.int32(row)
            if len(rows):
                self._file.read(layout.offset + row * layout.row_bytes, buffer[: count * layout.row_bytes])
                if self._factor != 1:
                    values[:count] *= np.float32(self._factor)
                work(start, values, rows)


def held(sh_rest: Tensor | StoredHarmonics) -> Tensor:
    """Coefficients [N, K, 3] as a tensor on the device where they are."""
    return sh_rest.tensor() if isinstance(sh_rest, StoredHarmonics) else sh_rest
