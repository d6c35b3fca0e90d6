"""Runner of a module in a process whose wall clock is wrong: `python -m tests.shifted_clock SECONDS MODULE`."""

from __future__ import annotations

import runpy
import sys
import time


def main() -> None:
    """Shift this process's wall clock, then run the module as a program."""
    seconds, module = float(sys.argv[1]), sys.argv[2]
    right, right_ns = time.time, time.time_ns
    time.time = lambda: right() + seconds
    time.time_ns = lambda: right_ns() + int(seconds * 1e9)
    sys.argv = [module]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
