"""Triton driver that executes compiled kernels on CPU tensors in the PTX interpreter.

Triton specializes, compiles and launches as on a GPU: block sizes, divisibility hints and the generated code are those
of production. Only the last step, the launch, is replaced.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.runtime.driver import driver

from sgsst_core.rasterizer.triton import TritonRasterizer
from tests.ptx.machine import GlobalMemory, Kernel, parse


class PtxDriver:
    """Driver of a pretended NVIDIA GPU.

    Args:
        capability: Compute capability, 10 * major + minor.

    Attributes:
        kernels: Kernel launched last of each name.
        utils: Loader of binaries and device properties, as Triton expects them.
    """

    def __init__(self, capability: int) -> None:
        self.target = GPUTarget("cuda", capability, 32)
        self.kernels: dict[str, Kernel] = {}
        self.utils = SimpleNamespace(
            load_binary=self._load, get_device_properties=lambda device: {"max_shared_mem": 160 << 10}
        )
        self._files: dict[str, str] = {}

    def get_current_target(self) -> GPUTarget:
        """Return the target of the compiler."""
        return self.target

    def get_current_device(self) -> int:
        """Return the index of the device, by which Triton caches compiled kernels: one per target."""
        return int(self.target.arch)

    def get_current_stream(self, device: int) -> int:
        """Return the only stream."""
        return 0

    def launcher_cls(self, source: Any, metadata: Any) -> Any:
        """Return a function that launches a loaded kernel with the arguments of the Python call."""
        is_passed = [type_ != "constexpr" for type_ in source.signature.values()]

        def launch(x: int, y: int, z: int, stream: int, kernel: Kernel, *rest: Any) -> None:
            arguments = [value for value, passed in zip(rest[4:], is_passed, strict=True) if passed]
            memory = GlobalMemory(value for value in arguments if isinstance(value, torch.Tensor))
            values = [value.data_ptr() if isinstance(value, torch.Tensor) else int(value) for value in arguments]
            self.kernels[kernel.program.name] = kernel
            kernel.launch((x, y, z), [*values, 0, 0], memory)  # Triton appends two pointers to scratch memory

        return launch

    def before_load(self, module: Any, function: Any, name: str, files: dict[str, str], key: str) -> None:
        """Note the files of the kernel that Triton is about to load."""
        self._files = files

    def _load(self, name: str, binary: bytes, shared: int, device: int) -> tuple[Kernel, Kernel, int, int, int]:
        ptx = next(path for file, path in self._files.items() if file.endswith(".ptx"))
        kernel = Kernel(parse(Path(ptx).read_text()), shared)
        return kernel, kernel, 0, 0, 1024


@functools.cache
def _driver(capability: int) -> PtxDriver:
    return PtxDriver(capability)


@contextmanager
def compiled_kernels(capability: int) -> Iterator[PtxDriver]:
    """Execute Triton kernels in the PTX interpreter within this block; TRITON_INTERPRET must not be set."""
    device = _driver(capability)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(triton.knobs.runtime, "kernel_load_start_hook", device.before_load)
        patch.setattr(TritonRasterizer, "usable_device", classmethod(lambda cls, device: torch.device("cpu")))
        patch.setattr(driver, "_active", device)
        yield device
