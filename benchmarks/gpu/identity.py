"""Identity of the device: clocks, driver, versions, topology, and the rates of copies and matrix products."""

from __future__ import annotations

from benchmarks.gpu.part import Findings, Sizes, device
from sgsst_core.bench.device_identity import identity


def run(sizes: Sizes, findings: Findings) -> None:
    """Add all names and values."""
    del sizes  # the same for all sizes
    for name, value in identity(device()):
        findings.add(name, value)
