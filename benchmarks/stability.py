"""The hard cases against their measured errors: a table, and JSON.

python -m benchmarks.stability [--quick] [--only TEXT]
"""

from __future__ import annotations

import argparse
import sys

from rich.console import Console
from rich.table import Table

from benchmarks.machine import write_result
from sgsst_core.stability import Case, Measurement, all_cases, measure


def main() -> int:
    """Measure, print and store; 1 where a case misses its bound."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the sizes of the test suite: minutes less")
    parser.add_argument("--only", default="", metavar="TEXT", help="cases or groups whose name holds this")
    arguments = parser.parse_args()
    chosen = [case for case in all_cases() if arguments.only in case.name or arguments.only == case.group]
    found = []
    for case in chosen:
        print(f"{case.group}: {case.name}", file=sys.stderr)
        found.append((case, measure(case, full=not arguments.quick)))
    Console(width=180).print(table(found))
    if not arguments.only:
        path = write_result("stability", {"full": not arguments.quick, "cases": [row(*pair) for pair in found]})
        print(path)
    return int(not all(measured.result.passed for _, measured in found))


def table(found: list[tuple[Case, Measurement]]) -> Table:
    """Cases against errors."""
    result = Table("case", "measure", "error", "bound", "", "note", title="Numerical stability")
    group = ""
    for case, measured in found:
        if case.group != group:
            group = case.group
            result.add_section()
            result.add_row(f"[bold]{group}[/bold]")
        outcome = measured.result
        mark = "ok" if outcome.passed else "[red]MISSED[/red]"
        numbers = (f"{outcome.error:.1e}" if outcome.error else "0", f"{outcome.bound:.0e}" if outcome.bound else "0")
        result.add_row(case.name, case.measure, *numbers, mark, outcome.note)
    return result


def row(case: Case, measured: Measurement) -> dict[str, object]:
    """One case for JSON; errors that are not finite are words there."""
    outcome = measured.result
    return {
        "group": case.group,
        "case": case.name,
        "measure": case.measure,
        "error": outcome.error if outcome.error < float("inf") else str(outcome.error),
        "bound": outcome.bound,
        "passed": outcome.passed,
        "note": outcome.note,
        "seconds": round(measured.seconds, 3),
        "peak_growth": measured.peak_growth,
    }


if __name__ == "__main__":
    sys.exit(main())
