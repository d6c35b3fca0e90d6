"""What a GPU does, in one command: `python -m benchmarks.gpu`. Each module but `inputs`, `part` and `clock` is a part.

A part is a function `run(sizes, found)`. It runs in a process of its own, so that one that fails, hangs or poisons the
device leaves the others alone, and peaks of memory do not mix.
"""
