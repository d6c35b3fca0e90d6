"""Report of the hard cases against their float64 references: `make stability`.

python -m benchmarks.stability [--only TEXT] [--quick]
python -m benchmarks.stability --search SECONDS [--first NUMBER]
python -m benchmarks.stability --figure FILE.jpg

Each case is printed with its error and bound; the exit status is 1 if a case exceeds its bound. All of them are stored.
The search runs random jobs and prints those that exceed theirs; the figure shows ten cases as images.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.common import parse, write_result
from benchmarks.stability import Case, Measurement, all_cases, measure
from benchmarks.stability.figure import compute_images, write_figure
from benchmarks.stability.search import search


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the chosen cases, store and print them, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="TEXT", help="only cases whose name contains TEXT, or group TEXT")
    parser.add_argument("--quick", action="store_true", help="smaller sizes; minutes faster")
    parser.add_argument("--search", type=float, metavar="SECONDS", help="search random jobs instead, for some time")
    parser.add_argument("--first", type=int, default=0, metavar="NUMBER", help="number of the first random job")
    parser.add_argument("--figure", type=Path, metavar="FILE.jpg", help="draw ten cases as images instead")
    chosen = parse(parser, arguments)
    if chosen.figure:
        write_figure(chosen.figure, compute_images())
        return 0
    if chosen.search is not None:
        ended, failures = search(chosen.search, chosen.first)
        print("\n".join(f"{count} {how}" for how, count in sorted(ended.items())))
        return int(bool(failures))
    cases = [case for case in all_cases() if chosen.only in case.name or chosen.only == case.group]
    if not cases:
        parser.error(f"no case or group is called {chosen.only!r}, or contains it in its name")
    rows = []
    for case in cases:
        row = _row(case, measure(case, full=not chosen.quick))
        rows.append(row)
        mark, numbers = "ok" if row["passed"] else "MISSED", f"{float(row['error']):.1e}, bound {row['bound']:.0e}"
        print(f"{mark}: {case.group}: {case.name}, {case.way}: {numbers}; {row['note']}", flush=True)
    if not chosen.only:
        print(write_result("stability", {"full": not chosen.quick, "cases": rows}))
    return int(not all(row["passed"] for row in rows))


def _row(case: Case, measured: Measurement) -> dict[str, Any]:
    """Return one case as a JSON object, with non-finite errors as strings."""
    result = measured.result
    return {
        "group": case.group,
        "case": case.name,
        "way": case.way,
        "measure": case.measure,
        "error": result.error if result.error < float("inf") else str(result.error),
        "bound": result.bound,
        "passed": result.passed,
        "note": result.note,
        "seconds": round(measured.seconds, 3),
        "peak_growth": measured.peak_growth,
    }


if __name__ == "__main__":
    sys.exit(main())
