"""Memory and processor cores that this process may use: those of the machine, or fewer if its container has limits.

Limits of containers are those of control groups (cgroups) of Linux, of version 1 or 2. Limits of a group also apply to
the groups in it.
"""

import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import psutil

#: Folder of all control groups, and file with those of this process.
_ROOT, _OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
#: Files with a limit of memory and with its use, in bytes: two limits of version 2, and the one of version 1.
_LIMITS = (
    ("memory.max", "memory.current"),
    ("memory.high", "memory.current"),
    ("memory.limit_in_bytes", "memory.usage_in_bytes"),
)


class Memory(NamedTuple):
    """Memory in bytes that this process may use: in total, and what is free of it now."""

    total: int
    available: int


def memory() -> Memory:
    """Return the memory of the machine, within the limits of this process's container."""
    machine = psutil.virtual_memory()
    total, available = machine.total, machine.available
    for group in _groups("memory"):
        for limit, used in ((_numbers(group / limit), _numbers(group / used)) for limit, used in _LIMITS):
            if limit and used:
                total = min(total, limit[0])
                available = min(available, limit[0] - used[0] + _reclaimable(group))
    return Memory(total, max(available, 0))


def cores() -> int:
    """Return the number of processor cores that this process may use; a quota of 1.5 counts as 2."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for group in _groups("cpu"):
        quota = [*_numbers(group / "cpu.max"), *_numbers(group / "cpu.cfs_quota_us")]
        period = [*quota[1:], *_numbers(group / "cpu.cfs_period_us")]
        if quota and quota[0] > 0 and period:
            count = min(count, math.ceil(quota[0] / period[0]))
    return count


def _groups(controller: str) -> Iterator[Path]:
    """Yield the folders of the control groups that this process is in, the innermost first.

    In a container, the names of the innermost ones may be those outside of it: their folders then do not exist.
    """
    try:
        lines = _OWN.read_text().splitlines()
    except OSError:  # not Linux
        return
    for line in lines:
        _, controllers, name = line.split(":", 2)
        if not controllers or controller in controllers.split(","):
            root = _ROOT / controller if controllers else _ROOT
            own = root / name.strip("/")
            yield from (folder for folder in (own, *own.parents) if folder.is_relative_to(root))


def _numbers(file: Path) -> list[int]:
    """Return the numbers in a file; an empty list if there is no such file, or if it says "max", which is no limit."""
    try:
        return [int(word) for word in file.read_text().split()]
    except (OSError, ValueError):
        return []


def _reclaimable(group: Path) -> int:
    """Return the bytes of files in a group's memory that have not been used lately, which Linux drops if necessary."""
    try:
        values = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
    except (OSError, ValueError):
        return 0
    return int(values.get("total_inactive_file", values.get("inactive_file", 0)))
