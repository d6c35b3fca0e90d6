"""Benchmark of a GPU in one command: `python -m benchmarks.gpu`.

Each module except `inputs`, `part` and `clock` is a part: a function `run(sizes, found)`. It runs in a process of its
own, so that a part that fails, hangs or breaks the device does not affect the others, and peaks of memory do not mix.
"""
