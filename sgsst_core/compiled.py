"""Numba configuration of this package: the kernel decorator, and the lock and thread count under which kernels run."""

from __future__ import annotations

import functools
import hashlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
import numba.core.caching
import torch

#: Lock of the kernels of this process. Numba's `workqueue` threading layer, the only one that is always available,
#: aborts the process if two Python threads run parallel kernels at once. A kernel uses every core anyway.
_TURN = threading.RLock()


#: Sources of this package that are compiled into kernels of other modules.
_COMPILED_IN = ("constants.py", "rasterizer/vectors.py", "rasterizer/kernels.py")


#: Folders that hold the machine code of the kernels.
_folders: set[Path] = set()


def kernel_folders() -> set[Path]:
    """Return the folders that hold machine code."""
    return set(_folders)


def keep_in_memory(report: Callable[[], None]) -> None:
    """Do not write newly compiled kernels to disk, because this process may only read the folders.

    Args:
        report: Callback for each kernel that the folders lack.
    """
    numba.core.caching.Cache.save_overload = lambda self, sig, data: report()  # type: ignore[method-assign]


@functools.cache
def _digest() -> str:
    """Return a hash of the sources that are compiled into kernels of other modules."""
    folder = Path(__file__).parent
    content = b"".join((folder / name).read_bytes() for name in _COMPILED_IN)
    return hashlib.sha256(content).hexdigest()[:12]


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a `numba.njit` decorator that caches machine code on disk, or only in memory if no folder is writable.

    Numba validates a cached kernel only against its own source file. A hash of the other sources in its machine code is
    therefore part of its cached name. A kernel may call compiled functions only from these modules (`_COMPILED_IN`).
    Multiply-adds are contracted, but nothing is reordered, so results do not depend on the number of threads.
    """
    settings: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}, **options}

    def decorate(function: Callable[..., Any]) -> Any:
        function.__qualname__ = f"{function.__qualname__}_{_digest()}"
        try:
            kernel = numba.njit(cache=True, **settings)(function)
            _folders.add(Path(kernel.stats.cache_path))
            return kernel
        except RuntimeError:  # "no locator available": neither the package's folder nor the user's cache is writable
            return numba.njit(**settings)(function)

    return decorate


@contextmanager
def kernel_threads() -> Iterator[None]:
    """Run parallel kernels in a `with` block: one Python thread at a time, with the number of cores that PyTorch uses.

    Following `torch.set_num_threads` lets several ranks share the cores of a machine with one setting. If both use the
    same OpenMP library, Numba's first kernel resets PyTorch to all cores, so the setting is restored.
    """
    with _TURN:
        threads = torch.get_num_threads()
        available: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
        numba.set_num_threads(max(1, min(threads, available)))
        if torch.get_num_threads() != threads:
            torch.set_num_threads(threads)
        yield
