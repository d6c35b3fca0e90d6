"""Report of the hard cases against their float64 references: `make stability`.

python -m benchmarks.stability [--only TEXT] [--quick] [--out FILE.json]
python -m benchmarks.stability --search SECONDS [--first NUMBER]
python -m benchmarks.stability --figure FILE.jpg

Each case is printed with its error and bound, and stored with them; the exit status is 1 if a case exceeds its bound.
The search runs random jobs and prints those that exceed theirs; the figure shows ten cases as images.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.common import RESULTS, parse, write_result
from benchmarks.stability import Case, Measurement, all_cases, measure
from benchmarks.stability.figure import compute_images, write_figure
from benchmarks.stability.search import search

#: Width in characters of the table, which a narrower terminal would truncate.
_WIDTH = 180


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the chosen cases, store and print them, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="TEXT", help="only cases whose name contains TEXT, or group TEXT")
    parser.add_argument("--quick", action="store_true", help="smaller sizes; minutes faster")
    parser.add_argument("--out", type=Path, default=RESULTS / "stability.json", help="JSON file to write")
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
    measurements = []
    for case in cases:
        measurements.append((case, measure(case, full=not chosen.quick)))
        result = measurements[-1][1].result
        mark = "" if result.passed else f" MISSED: {result.error:.1e}, bound {result.bound:.1e}; {result.note}"
        print(f"{case.group}: {case.name}, {case.way}{mark}", file=sys.stderr, flush=True)
    figures = {"full": not chosen.quick, "cases": [_row(*pair) for pair in measurements]}
    write_result(chosen.out.stem, figures, chosen.out.parent)
    Console(width=_WIDTH).print(_table(measurements))
    return int(not all(measured.result.passed for _, measured in measurements))


def _table(measurements: Sequence[tuple[Case, Measurement]]) -> Table:
    """Return a table of the error of each case."""
    table = Table("case", "way", "measure", "error", "bound", "", "note", title="Numerical stability")
    group = ""
    for case, measured in measurements:
        if case.group != group:
            group = case.group
            table.add_section()
            table.add_row(f"[bold]{group}[/bold]")
        result = measured.result
        mark = "ok" if result.passed else "[red]MISSED[/red]"
        numbers = (f"{result.error:.1e}" if result.error else "0", f"{result.bound:.0e}" if result.bound else "0")
        table.add_row(case.name, case.way, case.measure, *numbers, mark, result.note)
    return table


def _row(case: Case, measured: Measurement) -> dict[str, object]:
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
