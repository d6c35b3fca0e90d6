"""Benchmark of a GPU in one command: `python -m benchmarks.gpu`.

Each part is a function of sizes and findings in `correctness`, `job` or `speed`. It runs in a process of its own, so
that one that fails, hangs or breaks the device does not affect the others, and each has its own memory peak.
"""
