"""Numba configuration of this package: the kernel decorator, and the lock and thread count under which kernels run."""

import functools
import hashlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
import numba.core.caching
import numba.core.registry
import torch
from numba.core.event import Listener, install_listener

#: Lock that is held while a kernel runs. Numba's `workqueue` threading layer, the only one that is always available,
#: aborts the process if two Python threads run parallel kernels at once. Little is lost by running kernels one at a
#: time, because each uses every core.
_LOCK = threading.RLock()


#: Source files whose functions and constants are compiled into kernels of other modules.
_COMPILED_IN = ("constants.py", "rasterizer/kernels.py")


#: Folders in which Numba caches compiled kernels.
_folders: set[Path] = set()


def kernel_folders() -> set[Path]:
    """Return the folders in which Numba caches compiled kernels."""
    return set(_folders)


def cache_in_memory(report: Callable[[], None]) -> None:
    """Cache newly compiled kernels only in memory, for a process that may read but not write the cache folders.

    Args:
        report: Callback, called for each kernel that is compiled because the cache folders do not contain it.
    """
    numba.core.caching.Cache.save_overload = lambda self, sig, data: report()  # type: ignore[method-assign]


def load_registries() -> None:
    """Load Numba's registries, as the first kernel would, without compiling one or starting threads.

    A process that forks for each task calls this once, because it takes longer than loading the kernels of a task.
    """
    numba.core.registry.cpu_target.typing_context.refresh()
    numba.core.registry.cpu_target.target_context.refresh()


class _Compilations(Listener):
    """Listener that calls a function at the start of each compilation."""

    def __init__(self, report: Callable[[], None]) -> None:
        self._report = report

    def on_start(self, *_: object) -> None:
        """Call the function."""
        self._report()

    def on_end(self, *_: object) -> None:
        """Do nothing."""


@contextmanager
def compilations_reported(report: Callable[[], None]) -> Iterator[None]:
    """Call a function whenever a `with` block compiles a kernel because the cache folders do not contain it."""
    with install_listener("numba:compile", _Compilations(report)):
        yield


@functools.cache
def _digest() -> str:
    """Return a hash of the source files that are compiled into kernels of other modules."""
    folder = Path(__file__).parent
    content = b"".join((folder / name).read_bytes() for name in _COMPILED_IN)
    return hashlib.sha256(content).hexdigest()[:12]


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a `numba.njit` decorator that caches machine code on disk, or only in memory if no folder is writable.

    Numba recompiles a cached kernel only if the kernel's own source file has changed. The cached name therefore
    contains a hash of the other source files that kernels use (`_COMPILED_IN`). A kernel may call compiled functions
    only from its own file and from these. Multiplications and additions may be fused, but sums are not reordered, so
    results do not depend on the number of threads.
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
    """Run parallel kernels in a `with` block, in one Python thread at a time and on as many cores as PyTorch uses.

    Kernels use the thread count of `torch.set_num_threads`, so this one setting divides a machine's cores among ranks.
    If Numba and PyTorch use the same OpenMP library, Numba's first kernel resets PyTorch's thread count to all cores,
    so the count is restored.
    """
    with _LOCK:
        threads = torch.get_num_threads()
        available: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
        numba.set_num_threads(max(1, min(threads, available)))
        if torch.get_num_threads() != threads:
            torch.set_num_threads(threads)
        yield
