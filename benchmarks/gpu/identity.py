"""Identity of the device: clocks, driver, versions, topology, and the rates of copies and matrix products."""

from __future__ import annotations

import platform
import re
import time
from collections.abc import Callable, Iterator
from typing import Any

import torch

from benchmarks.gpu.part import Findings, Sizes
from benchmarks.gpu.part import device as chosen_device
from sgsst_core.bench.doctor import nvidia_smi, output_of, package_version
from sgsst_core.devices import wait_for
from sgsst_core.features.vgg import has_bfloat16, has_tf32

#: Fields of `nvidia-smi --query-gpu`, by their names in results.
_QUERIED = {
    "driver": "driver_version",
    "clock_sm": "clocks.sm",
    "clock_sm_max": "clocks.max.sm",
    "clock_memory": "clocks.mem",
    "clock_memory_max": "clocks.max.mem",
    "power_limit": "power.limit",
    "temperature": "temperature.gpu",
    "pcie_generation": "pcie.link.gen.current",
    "pcie_width": "pcie.link.width.current",
    "mig": "mig.mode.current",
}
#: Bytes of a timed copy, and side of timed matrices, by type of device.
_COPIED = {"cpu": 1 << 26, "cuda": 1 << 30}
_SIDE = {"cpu": 1024, "cuda": 8192}
_REPEATS = 5


def run(sizes: Sizes, findings: Findings) -> None:
    """Add all names and values."""
    del sizes  # the same for all sizes
    for name, value in identity(chosen_device()):
        findings.add(name, value)


def identity(device: torch.device) -> Iterator[tuple[str, Any]]:
    """Yield names and values, those that take no time first.

    Args:
        device: GPU with its index, or the CPU.
    """
    yield "device", torch.cuda.get_device_name(device) if device.type == "cuda" else platform.machine()
    for package in ("torch", "triton", "numba", "numpy"):
        yield package, package_version(package)
    yield "threads", torch.get_num_threads()
    if device.type == "cuda":
        yield from _gpu(device)
    for name, gigabytes in copies(device):
        yield f"copy/{name}_gigabytes_per_second", gigabytes
    for precision, tflops in matrix_products(device):
        yield f"matrix_product/{precision}_tflops", tflops


def _gpu(device: torch.device) -> Iterator[tuple[str, Any]]:
    properties = torch.cuda.get_device_properties(device)
    free, total = torch.cuda.mem_get_info(device)
    yield "compute_capability", ".".join(map(str, torch.cuda.get_device_capability(device)))
    yield "multiprocessors", properties.multi_processor_count
    yield "memory_bytes", total
    yield "free_bytes", free
    yield "cuda", torch.version.cuda or torch.version.hip
    yield "cudnn", torch.backends.cudnn.version()
    yield "nccl", nccl_version()
    yield from zip(_QUERIED, nvidia_smi(device, *_QUERIED.values()), strict=False)  # none without nvidia-smi
    topology = output_of("nvidia-smi", "topo", "-m")
    if topology:
        plain = re.sub(r"\x1b\[\d*m", "", topology)
        yield "topology", [line.rstrip() for line in plain.splitlines() if line.startswith(("GPU", "NIC", "\t"))]


def nccl_version() -> str | None:
    """Return the version of NCCL; None if PyTorch was built without it."""
    if not torch.distributed.is_available() or not torch.distributed.is_nccl_available():
        return None
    return ".".join(map(str, torch.cuda.nccl.version()))


def copies(device: torch.device) -> Iterator[tuple[str, float]]:
    """Yield the rates of copies in GB/s: within the device (bytes read and written), and from and to the host."""
    size = _COPIED[device.type]
    source, target = (torch.ones(size // 4, device=device) for _ in range(2))
    yield "device", 2 * size / _seconds(lambda: target.copy_(source), device) / 1e9
    if device.type == "cuda":
        host = torch.ones(size // 4).pin_memory()
        yield "from_host", size / _seconds(lambda: target.copy_(host, non_blocking=True), device) / 1e9
        yield "to_host", size / _seconds(lambda: host.copy_(source, non_blocking=True), device) / 1e9


def matrix_products(device: torch.device) -> Iterator[tuple[str, float]]:
    """Yield the rates of square matrix products in TFLOP/s, in every precision of the device."""
    side, before = _SIDE[device.type], torch.backends.cuda.matmul.fp32_precision
    precisions = {"float32": True, "tf32": has_tf32(device), "bfloat16": has_bfloat16(device)}
    for precision in [name for name, there in precisions.items() if there]:
        dtype = torch.bfloat16 if precision == "bfloat16" else torch.float32
        a = torch.ones((side, side), dtype=dtype, device=device)
        torch.backends.cuda.matmul.fp32_precision = "tf32" if precision == "tf32" else "ieee"
        try:
            yield precision, 2 * side**3 / _seconds(lambda a=a: a @ a, device) / 1e12  # type: ignore[misc]
        finally:
            torch.backends.cuda.matmul.fp32_precision = before


def _seconds(action: Callable[[], object], device: torch.device) -> float:
    """Return the seconds of one call, from several calls after a warm-up call."""
    action()
    wait_for(device)
    started = time.perf_counter()
    for _ in range(_REPEATS):
        action()
    wait_for(device)
    return (time.perf_counter() - started) / _REPEATS
