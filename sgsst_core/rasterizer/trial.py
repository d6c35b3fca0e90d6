"""Test whether a GPU rasterizer works on this machine, by rendering a single Gaussian.

A package that can be imported may still lack compiled kernels, or contain kernels for another CUDA version. Such errors
appear only when a kernel is first used, which would otherwise be in the middle of a job. gsplat compiles its kernels at
first use. Processes that compile at the same time delete each other's files, so a lock serializes them.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from sgsst_core.constants import RASTER_TILE
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene


def drawing_problem(name: str, device: torch.device | str = "cuda") -> str | None:
    """Return the reason why a rasterizer cannot render on a device, as a short text; None if it can.

    Takes minutes if this or another process has to compile kernels. The compiled kernels are cached.
    """
    gaussian = Scene(
        torch.tensor([[0.0, 0.0, 2.0]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.zeros(1, 3),
        torch.zeros(1),
        torch.zeros(1, 3),
        torch.zeros(1, 0, 3),
    )
    camera = Camera("trial", RASTER_TILE, RASTER_TILE, 16.0, 16.0, 8.0, 8.0, torch.eye(4, dtype=torch.float64))
    try:
        with one_at_a_time(build_folder()):
            rasterizer = make_rasterizer(name, gaussian, device=device)
            image = rasterizer.render(torch.ones(1, 3), camera)
            gradient = rasterizer.color_gradient(torch.ones_like(image), camera)
            drawn = float(image.sum()) > 0 and float(gradient.sum()) > 0
    except Exception as error:  # whatever the exception, the rasterizer is unusable
        return (str(error).strip().splitlines() or [type(error).__name__])[0]
    return None if drawn else "it draws nothing"


def build_folder() -> Path:
    """Return the folder in which PyTorch compiles extensions."""
    from torch.utils.cpp_extension import get_default_build_root  # importing it searches for compilers

    return Path(os.environ.get("TORCH_EXTENSIONS_DIR") or get_default_build_root())


@contextmanager
def one_at_a_time(folder: Path) -> Iterator[None]:
    """Hold an exclusive lock of a folder, which all processes respect, inside a `with` block.

    The operating system releases the lock of a process that dies. If the folder is not writable, do not lock it:
    nothing can be compiled there either.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(folder / "sgsst.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError:
        yield
        return
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)
