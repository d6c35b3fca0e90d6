"""Shared scene: read once on each machine, and mapped by all ranks there.

The lowest rank of a machine reads the scene and copies its arrays to an anonymous memory file (memfd). The other ranks
open that file through the /proc entry of the reader and map it copy-on-write: ranks share the pages, but cannot change
each other's data. The system frees the memory when the last process that uses it ends, so it cannot leak.
Where there are no such files (Windows, macOS), every rank reads the scene.

The spherical harmonics of a large scene stay in its file, which every rank opens. The system's page cache holds them
once for all ranks.
"""

from __future__ import annotations

import mmap
import os
import socket
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sgsst_core import container
from sgsst_core.errors import SceneTooLargeError, SgsstError
from sgsst_core.files.formats import read_scene_header
from sgsst_core.files.formats.spz import SpzAxes
from sgsst_core.files.scene_file import HELD_BYTES, SceneFile, read_scene, stays_in_file
from sgsst_core.parallel.collectives import Collectives
from sgsst_core.planning.plan import OPTIMIZER_BYTES
from sgsst_core.scene.gaussians import TENSORS
from sgsst_core.scene.stored_harmonics import StoredHarmonics
from worker.processes import home

#: Bytes per Gaussian that a rank needs in addition to the scene and the optimizer: projection to a view (center, conic,
#: depth, extent, sorting keys), color in the view, and gradients of the view's color and of the optimized color.
VIEW_BYTES = 96
#: Arrays start at multiples of this many bytes, so that every dtype is aligned.
_ALIGNMENT = 64

_Layout = dict[str, tuple[int, tuple[int, ...], str]]  # offset, shape and numpy dtype by name


@dataclass(frozen=True)
class _Shared:
    """Location of a shared scene: the memory file of a process, and the layout of its arrays."""

    process: int
    descriptor: int
    size: int
    layout: _Layout
    file: SceneFile  # with empty arrays
    harmonics: tuple[Any, ...] | None  # arguments of StoredHarmonics, whose file must not be opened on other machines


def read_shared_scene(
    path: Path,
    collectives: Collectives,
    *,
    drop_invalid: bool = False,
    growth: float = 1.0,
    spz_axes: SpzAxes = "auto",
) -> tuple[SceneFile, bool]:
    """Read a scene once on each machine. Every rank must call this function.

    Args:
        drop_invalid: Whether to drop invalid Gaussians; see `read_scene`.
        growth: Factor by which refinement may increase the number of Gaussians. It scales the memory requirement, and
            lowers the size up to which spherical harmonics are loaded into memory.

    Returns:
        The scene, and whether this rank read the file itself. Exactly one rank of each machine does.

    Raises:
        SceneError: If the scene cannot be read; see `read_scene`. Every rank raises the same error.
        SceneTooLargeError: If the scene does not fit into the memory of a rank's machine or GPU.
    """
    homes = collectives.all_gather(home())
    reader = homes.index(home())
    sharing = homes.count(home())
    _check_memory(path, collectives, sharing, growth)
    own: SceneFile | None = None
    error: SgsstError | None = None
    shared: _Shared | None = None
    if collectives.rank == reader:
        try:
            own = read_scene(path, drop_invalid=drop_invalid, held_bytes=_held_bytes(growth), spz_axes=spz_axes)
            if sharing > 1 and hasattr(os, "memfd_create"):
                own, shared = _share(own)
        except SgsstError as raised:
            error = raised
    try:
        offers = collectives.all_gather((shared, error))
        for _, problem in offers:
            if problem is not None:
                raise problem
        offer = offers[reader][0]
        if own is None and offer is not None:
            with suppress(OSError):  # some systems hide even the user's own processes in /proc
                own = _mapped(offer, f"/proc/{offer.process}/fd/{offer.descriptor}")
        if own is None:
            own = read_scene(path, drop_invalid=drop_invalid, held_bytes=_held_bytes(growth), spz_axes=spz_axes)
        collectives.all_gather(None)  # barrier: the reader closes its memory file after all ranks have opened it
    finally:
        if shared is not None:
            os.close(shared.descriptor)
    return own, collectives.rank == reader


def _held_bytes(growth: float) -> int | None:
    """Return the maximum bytes of spherical harmonics in memory for a scene that may grow; None for the default."""
    return None if growth == 1 else int(HELD_BYTES / growth)


def _share(file: SceneFile) -> tuple[SceneFile, _Shared]:
    """Copy a scene to a memory file; return the scene mapped from there, and its location."""
    stored = file.scene.sh_rest if isinstance(file.scene.sh_rest, StoredHarmonics) else None
    tensors = {name: getattr(file.scene, name) for name in TENSORS}
    arrays: dict[str, NDArray[Any]] = {name: value.numpy() for name, value in tensors.items() if value is not stored}
    if file.retained is not None:
        arrays["retained"] = file.retained
    layout: _Layout = {}
    size = 0
    for name, array in arrays.items():
        layout[name] = (size, array.shape, array.dtype.str)
        size += -(-array.nbytes // _ALIGNMENT) * _ALIGNMENT
    descriptor = os.memfd_create("sgsst-scene", os.MFD_CLOEXEC)
    os.ftruncate(descriptor, size)
    with mmap.mmap(descriptor, size) as memory:
        for name, (offset, _, _) in layout.items():
            data = np.ascontiguousarray(arrays[name]).reshape(-1).view(np.uint8)
            memory[offset : offset + data.nbytes] = data.data
    nothing: dict[str, Any] = dict.fromkeys(TENSORS, torch.empty(0))
    empty = replace(file.scene, **nothing)
    in_file = None if stored is None else stored.arguments
    shared = _Shared(os.getpid(), descriptor, size, layout, replace(file, scene=empty, retained=None), in_file)
    return _mapped(shared, f"/proc/self/fd/{descriptor}"), shared


def _mapped(shared: _Shared, path: str) -> SceneFile:
    """Map the scene of a memory file."""
    with Path(path).open("rb") as file:
        memory = mmap.mmap(file.fileno(), shared.size, access=mmap.ACCESS_COPY)
    arrays = {}
    for name, (offset, shape, kind) in shared.layout.items():
        count = int(np.prod(shape))
        arrays[name] = np.frombuffer(memory, kind, count, offset).reshape(shape) if count else np.empty(shape, kind)
    retained = arrays.pop("retained", None)
    tensors: dict[str, Any] = {name: torch.from_numpy(array) for name, array in arrays.items()}
    if shared.harmonics is not None:
        tensors["sh_rest"] = StoredHarmonics(*shared.harmonics)
    return replace(shared.file, scene=replace(shared.file.scene, **tensors), retained=retained)


def _check_memory(path: Path, collectives: Collectives, sharing: int, growth: float) -> None:
    """Check that a scene, by the size in its header, fits into the free memory of each rank's machine and GPU.

    Args:
        growth: Factor of growth; see `read_shared_scene`.
    """
    problem: SgsstError | None = None
    try:
        header = read_scene_header(path)
        rest = 3 * header.coefficients
        held = 0 if stays_in_file(header, _held_bytes(growth)) else rest  # in memory
        sizes = header.count, header.count * 4 * (14 + held), header.count * 4 * (14 + rest)
        problem = _lack(collectives.rank, sharing, *(int(size * growth) for size in sizes))
    except SgsstError as error:
        problem = error
    for raised in collectives.all_gather(problem):
        if raised is not None:
            raise raised


def _lack(rank: int, sharing: int, count: int, scene_bytes: int, device_bytes: int) -> SceneTooLargeError | None:
    """Return the error if this rank lacks memory; None if the scene fits."""
    own = count * (OPTIMIZER_BYTES + VIEW_BYTES)
    each = scene_bytes + own  # every rank has its own copy of the Gaussians that its views show
    where = f"Rank {rank} on {socket.gethostname()}: the scene's {count:,} Gaussians need"
    advice = "Give a machine with more memory, fewer --workers on each, or a smaller scene."
    needed, free = scene_bytes + sharing * each, container.memory().available
    if needed > free:
        ranks = f"{sharing} ranks share it" if sharing > 1 else "there is one rank"
        return SceneTooLargeError(
            f"{where} {needed / 1e9:.2f} GB of memory ({ranks}), but {free / 1e9:.2f} GB are free. {advice}"
        )
    if torch.cuda.is_available():
        free, total = torch.cuda.mem_get_info()
        needed = device_bytes + own
        if needed > free:
            return SceneTooLargeError(
                f"{where} {needed / 1e9:.2f} GB on its GPU ({torch.cuda.get_device_name()}, {total / 1e9:.1f} GB), but "
                f"{free / 1e9:.2f} GB are free. {advice}"
            )
    return None
