"""Storage of benchmark results together with a description of the machine."""

from __future__ import annotations

import json
import os
import platform
import socket
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil
import torch

from sgsst_core.files.atomic import atomic_path

RESULTS = Path(__file__).parent / "results"
_PACKAGES = ("torch", "numpy", "numba")


def describe_machine() -> dict[str, Any]:
    """Describe processor, memory, GPU, software versions and current load of this machine."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {
        "processor": _processor(),
        "cores": psutil.cpu_count(logical=False) or os.cpu_count(),
        "threads": torch.get_num_threads(),
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "gpu": gpu,
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: version(name) for name in _PACKAGES},
        "load_average": [round(load, 2) for load in psutil.getloadavg()],
    }


def write_result(name: str, figures: dict[str, Any], folder: Path = RESULTS) -> Path:
    """Write figures, machine and date to `NAME.json` in `folder`, and return the path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    content = {"date": datetime.now(UTC).isoformat(timespec="seconds"), "machine": describe_machine(), **figures}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return path


def add_pair(name: str, pair: str, description: dict[str, Any], rows: dict[str, Any]) -> None:
    """Add rows to the results of one pair of scene and style in `NAME.json`; other rows and pairs stay."""
    path = RESULTS / f"{name}.json"
    pairs = json.loads(path.read_text(encoding="utf-8"))["pairs"] if path.exists() else {}
    earlier = pairs.get(pair, {}).get("rows", {})
    pairs[pair] = {**description, "rows": {**earlier, **rows}}
    write_result(name, {"pairs": pairs})


def free_address() -> str:
    """Return an address on this machine whose port is free, as HOST:PORT."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{listener.getsockname()[1]}"


def _processor() -> str:
    """Return the processor's name, or its architecture if the name is unknown."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
