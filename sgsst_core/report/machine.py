"""Program version, hardware and memory use, as stated in reports."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

import psutil
import torch

from sgsst_core.stylizing.checkpoint import versions


def program_version() -> str:
    """Return the version of the installed distribution; "unknown" for a source tree that is not installed."""
    return versions()["program"]


def machine(device: torch.device) -> dict[str, Any]:
    """Describe the machine that ran the job."""
    return {
        "system": platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "memory_bytes": psutil.virtual_memory().total,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):  # not Linux, or a processor that does not name itself
        return platform.processor() or platform.machine()
