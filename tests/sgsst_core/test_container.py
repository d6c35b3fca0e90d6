"""Tests of memory and cores of a container, with the files of control groups in a folder."""

import os
from pathlib import Path

import psutil
import pytest

from sgsst_core import container

GB = 10**9
#: Unlimited memory of version 1.
NO_LIMIT = 9223372036854771712


@pytest.fixture(autouse=True)
def membership(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Replace the system's folder of groups by an empty one, and return the file with the groups of this process."""
    monkeypatch.setattr(container, "_ROOT", tmp_path / "cgroup")
    monkeypatch.setattr(container, "_OWN", tmp_path / "own")
    return tmp_path / "own"


@pytest.mark.parametrize(
    ("own", "files", "total", "available"),
    [
        ("0::/", {"memory.max": "2000000000", "memory.current": "500000000"}, 2 * GB, 3 * GB // 2),
        ("0::/", {"memory.max": "max", "memory.high": "2000000000", "memory.current": "0"}, 2 * GB, 2 * GB),
        ("0::/", {"memory.max": "2000000000", "memory.current": "3000000000"}, 2 * GB, 0),
        (
            "0::/",
            {
                "memory.max": "2000000000", "memory.current": "1500000000",
                "memory.stat": "file 9\ninactive_file 1000000000",
            },
            2 * GB,
            3 * GB // 2,
        ),
        (
            "0::/pod/job",  # the limit of the outer group is the smaller one, but less of the inner one is left
            {
                "pod/memory.max": "2000000000", "pod/memory.current": "500000000",
                "pod/job/memory.max": "3000000000", "pod/job/memory.current": "2500000000",
            },
            2 * GB,
            GB // 2,
        ),
        (
            "5:cpu,memory:/docker/12\n0::/",  # version 1; the container sees its own group as the root
            {
                "memory/memory.limit_in_bytes": "2000000000", "memory/memory.usage_in_bytes": "1500000000",
                "memory/memory.stat": "inactive_file 0\ntotal_inactive_file 500000000",
            },
            2 * GB,
            GB,
        ),
    ],
)  # fmt: skip
def test_memory_is_that_of_the_container(
    own: str, files: dict[str, str], total: int, available: int, membership: Path
) -> None:
    write(own, files, membership)
    assert container.memory() == (total, min(available, psutil.virtual_memory().available))


@pytest.mark.parametrize(
    ("own", "files", "count"),
    [
        ("0::/", {"cpu.max": "50000 100000"}, 1),
        ("0::/a", {"a/cpu.max": "max 100000", "cpu.max": "100000 100000"}, 1),
        ("1:cpu,cpuacct:/a", {"cpu/a/cpu.cfs_quota_us": "100000", "cpu/a/cpu.cfs_period_us": "100000"}, 1),
        ("1:cpu,cpuacct:/a", {"cpu/a/cpu.cfs_quota_us": "-1", "cpu/a/cpu.cfs_period_us": "100000"}, None),
        ("0::/", {"cpu.max": "99900000 100000"}, None),
    ],
)
def test_quota_limits_the_cores(own: str, files: dict[str, str], count: int | None, membership: Path) -> None:
    write(own, files, membership)
    assert container.cores() == (count or len(os.sched_getaffinity(0)))


@pytest.mark.parametrize(
    "files", [{}, {"memory/memory.limit_in_bytes": f"{NO_LIMIT}", "memory/memory.usage_in_bytes": "1"}, {"cpu.max": ""}]
)
def test_without_limits_the_machine_counts(files: dict[str, str], membership: Path) -> None:
    write("4:memory:/\n0::/", files, membership)
    assert container.memory().total == psutil.virtual_memory().total
    assert container.memory().available > 0
    assert container.cores() == len(os.sched_getaffinity(0))


def write(own: str, files: dict[str, str], membership: Path) -> None:
    membership.write_text(own + "\n")
    for name, text in files.items():
        path = membership.with_name("cgroup") / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
