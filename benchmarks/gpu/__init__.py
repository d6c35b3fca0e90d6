"""Benchmark of a GPU in one command: `python -m benchmarks.gpu`.

Each module except `inputs`, `part` and `clock` is one part of the benchmark, with a function `run(sizes, findings)`.
Each part runs in a separate process, so that one that fails, hangs or breaks the device does not affect other parts,
and each has its own memory peak.
"""
